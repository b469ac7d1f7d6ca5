"""Solution of a multiparametric QP, and its status."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from ccdtools_ground.outcome import Outcome
from mpc.checks import Array, Immutable, Ints
from mpc.parametric_qp import ParametricQP
from mpc.tolerances import ROUNDED_SUM


class MPQPStatus(Outcome):
    """Outcome of an exploration; the value is the advice."""

    COMPLETE = "Complete: every region behind every facet was explored, and no feasible parameter found outside them."
    INFEASIBLE = "No parameter of the set is feasible, or only a flat part. Ask `LinearMPC.explain` what conflicts."
    REGION_LIMIT = "Stopped at `max_regions`: the partition has holes. Raise the limit, shorten N or block moves."
    TIME_LIMIT = "Stopped at `time_limit`: the partition may have holes. Raise the limit, shorten N or block moves."
    INACCURATE = (
        "In some regions, left out, rounding decides the law. Raise the smallest weights of the cost; leave out rows "
        "that nearly repeat others; choose a `theta_set` in which the limits of the inputs are not nothing."
    )


@dataclass(frozen=True, eq=False, repr=False)
class Partition(Immutable):
    """Solution of a multiparametric QP; its arrays are read-only.

    Attributes
    ----------
    problem : ParametricQP
        What was solved.
    status : MPQPStatus
        Whether the whole parameter set was explored.
    active_sets : tuple of tuple of int
        Rows of `problem.G` that are active in each region.
    H, h : (n_halfspaces, nt) and (n_halfspaces,) array
        Facets of all regions, Hθ <= h in the units of θ.
    offsets : (n_regions + 1,) int array
        Region r owns the rows offsets[r] : offsets[r + 1].
    law : (n_regions, nz, nt + 1) array
        Minimiser z = law[r] [θ; 1].
    centre, half : (nt,) arrays
        Scaling θ = centre + half * t that takes the parameter set into [-1, 1]; H * half has unit rows.
    solve_time : float
        Wall time [s].
    uncovered : int
        Feasible parameters met that lie in no region explored: 0 unless the status is INACCURATE or a limit was met.
        What regions leave out whose law failed its check is not counted.
    """

    problem: ParametricQP
    status: MPQPStatus
    active_sets: tuple[tuple[int, ...], ...]
    H: Array
    h: Array
    offsets: Ints
    law: Array
    centre: Array
    half: Array
    solve_time: float
    uncovered: int = 0

    @cached_property
    def scaled_rows(self) -> Array:
        """Facets [H, h] in the scaled parameter t, unit normals: (n_halfspaces, nt + 1)."""
        rows = np.hstack([self.H * self.half, (self.h - self.H @ self.centre)[:, None]])
        rows.flags.writeable = False
        return rows

    def __len__(self) -> int:
        return len(self.active_sets)

    def __repr__(self) -> str:
        holes = f", {self.uncovered} feasible parameters in no region" if self.uncovered else ""
        return f"Partition({len(self)} regions, {self.status.name}{holes}, {1e3 * self.solve_time:.1f} ms)"

    def multipliers(self, region: int) -> Array:
        """Multiplier law (m, nt + 1) of one region, zero for inactive rows.

        Of two rows that make an equality the first carries the multiplier, of either sign. λ = law [θ; 1].
        """
        problem = self.problem
        active = list(self.active_sets[region])
        law = np.zeros((problem.m, problem.nt + 1))
        if active:
            size = 1 / np.sqrt(np.diag(problem.H))  # variables with a Hessian of unit diagonal
            H = problem.H * np.outer(size, size)
            G = problem.G[active] * size
            length = 1 / np.linalg.norm(G, axis=1)[:, None]  # rows of unit length
            G = G * length
            right = length * np.hstack([problem.S[active], problem.w[active, None]])
            cost = size[:, None] * np.hstack([problem.F, problem.f[:, None]])
            right = right + G @ np.linalg.solve(H, cost)
            # least squares: rows of equalities may repeat each other
            law[active] = -length * np.linalg.lstsq(G @ np.linalg.solve(H, G.T), right, rcond=ROUNDED_SUM)[0]
        return law
