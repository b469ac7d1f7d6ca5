"""MPC laws as piecewise affine functions."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.linalg import block_diag

from mpc.checks import Array, Ints, as_halfspaces
from mpc.exceptions import InfeasibleError, InputError
from mpc.explicit.partition import Partition
from mpc.explicit.piecewise_law import PiecewiseLaw
from mpc.explicit.search_tree import build_tree, region_points
from mpc.tolerances import PRIMAL, ROUNDED_SUM

if TYPE_CHECKING:
    from invariant_sets import Polytope
    from mpc.explicit.codegen.codegen import CodeReport
    from mpc.parametric_qp import ParametricQP
    from mpc.problem import MPCProblem


@dataclass(frozen=True, eq=False)
class Region:
    """Critical region with the law u = gain θ + offset."""

    polytope: Polytope
    gain: Array
    offset: Array
    active_set: tuple[int, ...]


@dataclass(frozen=True, eq=False, repr=False)
class ExplicitMPC(PiecewiseLaw):
    """Piecewise affine control law u(θ); see `LinearMPC.explicit`.

    Attributes
    ----------
    partition : Partition
        Regions and the law of the whole input sequence.
    tree : SearchTree
        Finds the region of a parameter.
    law : (n_regions, nu, nt + 1) array
        First input u = law[r] [θ; 1].
    law_number : (n_regions,) int array
        Regions of equal number share their law.
    input_rows : (H, h)
        Input set {u : Hu <= h}; inputs outside the partition are projected onto it.
    """

    @classmethod
    def from_partition(
        cls, partition: Partition, input_rows: tuple[Array, Array] | None = None, *, method: str = "tree",
        tree_time_limit: float | None = None,
    ) -> ExplicitMPC:  # fmt: skip
        """Explicit law of a solved multiparametric QP.

        Parameters
        ----------
        partition : Partition
            Result of `solve_mpqp`; an incomplete one gives a law with holes, which count as outside.
        input_rows : (H, h), optional
            Input set, for inputs outside the partition.
        method : "tree" or "sequential"
            How regions are found: by a search tree, or by a scan of all regions, which needs no preparation.
        tree_time_limit : float
            Wall time for the search tree [s]. A tree that is stopped gives the same law; leaves that hold many regions
            are scanned. See `tree.status`.

        Raises
        ------
        InfeasibleError
            The partition has no region.
        InputError
            Not a partition, an unknown method, or a limit that is not positive.
        """
        if not isinstance(partition, Partition):
            raise InputError("partition", type(partition).__name__, "the Partition that solve_mpqp returns")
        if not len(partition):
            raise InfeasibleError(f"the partition has no region: {partition.status.advice}")
        problem = partition.problem
        nu = problem.nu
        law = problem.Lz[:nu] @ partition.law
        law[:, :, :-1] += problem.Lt[:nu]
        law[:, :, -1] += problem.l[:nu]
        points = region_points(partition)
        number = _law_numbers(law, partition, points.points[points.starts[:-1]])
        _, first = np.unique(number, return_index=True)
        law = law[first][number]  # laws that agree up to rounding become one
        if input_rows is not None and (not isinstance(input_rows, tuple) or len(input_rows) != 2):
            raise InputError("input_rows", type(input_rows).__name__, "a pair (H, h) with Hu <= h")
        inputs = None if input_rows is None else SimpleNamespace(A=input_rows[0], b=input_rows[1])
        tree = build_tree(partition, number, points, method=method, time_limit=tree_time_limit)
        return cls(partition, tree, law, number, as_halfspaces("input_rows", inputs, nu))

    @cached_property
    def regions(self) -> tuple[Region, ...]:
        """All regions as polytopes with their laws."""
        from invariant_sets import Polytope

        p = self.partition
        return tuple(
            Region(Polytope(p.H[a:b], p.h[a:b]), law[:, :-1], law[:, -1], active)
            for a, b, law, active in zip(p.offsets[:-1], p.offsets[1:], self.law, p.active_sets)
        )

    def save(self, path: str | Path) -> tuple[Path, Path]:
        """Write `path`.npz (arrays) and `path`.json (the rest)."""
        from mpc.explicit.storage import save_explicit

        return save_explicit(self, as_path("path", path))

    @classmethod
    def load(cls, path: str | Path) -> ExplicitMPC:
        """Read what `save` wrote, executing nothing; damaged or mixed files are refused."""
        from mpc.explicit.storage import load_parts

        return cls(*load_parts(as_path("path", path)))

    def to_c(self, folder: str | Path, **options: Any) -> CodeReport:
        """Write the law as self-contained C99; see `codegen.write_c`."""
        from mpc.explicit.codegen.codegen import write_c

        return write_c(self, as_path("folder", folder), **options)

    def plot(self, what: str = "regions", **style: Any) -> Any:
        """Draw "regions", "law" or "value" over two parameters; see `plotting.plot_explicit`."""
        from mpc.explicit.plotting import plot_explicit

        return plot_explicit(self, what, **style)


def as_path(name: str, value: Any) -> Path:
    """Path on disk."""
    try:
        path = Path(value)
    except TypeError:
        raise InputError(name, type(value).__name__, "a path") from None
    if not path.name:
        raise InputError(name, repr(str(value)), "a path that ends in a name")
    return path


def default_parameters(mpc: MPCProblem, problem: ParametricQP) -> Polytope:
    """Feasible parameters of X, or X × U with the last input.

    A box around the feasible ones is intersected, so that a bound that means "no limit" has no part in their sizes.
    """
    names = [name for name, _ in problem.parameters]
    HX, hX = mpc.state_rows
    HU, hU = mpc.input_rows
    if mpc.X is None or set(names) - {"x", "u_prev"} or ("u_prev" in names and not len(hU)):
        raise InputError("theta_set", "None", f"a bounded Polytope of the parameters {names}")
    from invariant_sets import Polytope

    known = Polytope(HX, hX)
    if names != ["x"]:
        known = Polytope(block_diag(HX, HU), np.concatenate([hX, hU]))
    n = known.dim
    rows = np.block([[-problem.S, problem.G], [known.A, np.zeros((len(known.A), problem.G.shape[1]))]])
    joint = Polytope(rows, np.concatenate([problem.w, known.b]))
    directions = np.hstack([np.vstack([np.eye(n), -np.eye(n)]), np.zeros((2 * n, problem.G.shape[1]))])
    reach = joint.support(directions)
    if not np.isfinite(reach).all():
        return known
    room = 1e-3 * (reach[:n] + reach[n:])  # no side of the box touches the feasible parameters
    return known.intersection(Polytope.from_bounds(-reach[n:] - room, reach[:n] + room))


def _law_numbers(law: Array, partition: Partition, centres: Array) -> Ints:
    """Equal numbers for equal laws, in units of the inputs' values."""
    scaled = law.copy()
    scaled[:, :, :-1] *= partition.half
    scaled[:, :, -1] += law[:, :, :-1] @ partition.centre
    values = np.einsum("rij,rj->ri", scaled[:, :, :-1], centres) + scaled[:, :, -1]
    step = np.maximum(PRIMAL * np.abs(values).max(axis=0), ROUNDED_SUM * np.abs(scaled).max(axis=(0, 2)))
    step = np.where(step > 0, step, 1.0)
    _, number = np.unique(np.round(scaled / step[:, None] / 2).reshape(len(law), -1) + 0.0, axis=0, return_inverse=True)
    return number.astype(np.int64).ravel()
