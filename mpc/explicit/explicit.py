"""An MPC law as a piecewise affine function: no solver in the loop."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from mpc.checks import Array, as_floats
from mpc.exceptions import InfeasibleError, InputError
from mpc.explicit.mpqp import MPQPStatus, Partition
from mpc.explicit.search_tree import Ints, SearchTree, build_tree, locate
from mpc.halfspaces import nearest_points

if TYPE_CHECKING:
    from invariant_sets import Polytope
    from mpc.explicit.codegen.codegen import CodeReport
    from mpc.parametric_qp import ParametricQP
    from mpc.problem import MPCProblem


@dataclass(frozen=True, eq=False)
class Region:
    """One critical region: where it is, u = gain θ + offset on it, and the active rows of the QP."""

    polytope: Polytope
    gain: Array
    offset: Array
    active_set: tuple[int, ...]


@dataclass(frozen=True, eq=False, repr=False)
class ExplicitMPC:
    """Piecewise affine control law u(θ), a controller like any other; see `LinearMPC.explicit`.

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
        Input set {u : Hu <= h} to which the law is saturated outside the partition.
    """

    partition: Partition
    tree: SearchTree
    law: Array
    law_number: Ints
    input_rows: tuple[Array, Array]

    @classmethod
    def from_partition(cls, partition: Partition, input_rows: tuple[Array, Array] | None = None) -> ExplicitMPC:
        """Explicit law of a solved multiparametric QP.

        Parameters
        ----------
        partition : Partition
            Result of `solve_mpqp`; an incomplete one gives a law with holes, which count as outside.
        input_rows : (H, h), optional
            Input set, for saturation outside.

        Raises
        ------
        InfeasibleError
            The partition has no region.
        """
        if not len(partition):
            raise InfeasibleError(f"the partition has no region: {MPQPStatus.INFEASIBLE.advice}")
        problem, nu = partition.problem, partition.problem.nu
        law = problem.Lz[:nu] @ partition.law
        law[:, :, :-1] += problem.Lt[:nu]
        law[:, :, -1] += problem.l[:nu]
        number = _law_numbers(law, partition)
        _, first = np.unique(number, return_index=True)
        law = law[first][number]  # laws that agree up to rounding become one
        law.flags.writeable = False
        number.flags.writeable = False
        rows = (np.zeros((0, nu)), np.zeros(0)) if input_rows is None else input_rows
        return cls(partition, build_tree(partition, number), law, number, rows)

    @property
    def status(self) -> MPQPStatus:
        """Whether the partition is complete."""
        return self.partition.status

    @property
    def nu(self) -> int:
        """Number of inputs."""
        return self.law.shape[1]

    @property
    def nt(self) -> int:
        """Number of parameters."""
        return self.law.shape[2] - 1

    def __len__(self) -> int:
        return len(self.partition)

    def __repr__(self) -> str:
        size = f"{len(self)} regions, {self.nt} parameters, {self.nu} inputs"
        return f"ExplicitMPC({size}, {self.status.name}, {self.tree!r})"

    @cached_property
    def regions(self) -> tuple[Region, ...]:
        """All regions as polytopes with their laws."""
        from invariant_sets import Polytope

        p = self.partition
        return tuple(
            Region(Polytope(p.H[a:b], p.h[a:b]), law[:, :-1], law[:, -1], active)
            for a, b, law, active in zip(p.offsets[:-1], p.offsets[1:], self.law, p.active_sets)
        )

    def locate(self, theta: ArrayLike) -> Ints:
        """Number of the region of each parameter (n, nt) -> (n,), or (nt,) -> (); -1 outside the partition."""
        points, single = self._points(theta)
        region, outside = locate(self.tree, self.partition, self._scaled(points))
        region = np.where(outside, -1, region)
        return region[0] if single else region

    def evaluate(self, theta: ArrayLike) -> tuple[Array, np.ndarray[Any, np.dtype[np.bool_]]]:
        """First input and whether the parameter lies outside the partition.

        Parameters
        ----------
        theta : (n, nt) or (nt,) array
            States, with further parameters behind them where the law has some.

        Returns
        -------
        u : (n, nu) or (nu,) array
            Outside, the law of a region near by, saturated to the input set.
        outside : (n,) or () bool array
            True where no region holds the parameter: there the problem is infeasible, or not of interest.

        Raises
        ------
        InputError
            Wrong shape, or NaN.
        """
        from mpc.explicit.kernels.search import apply

        points, single = self._points(theta)
        region, outside = locate(self.tree, self.partition, self._scaled(points))
        u = np.empty((len(points), self.nu))
        apply(points, region, self.law, u)
        u[outside] = nearest_points(u[outside], *self.input_rows)
        return (u[0], outside[0]) if single else (u, outside)

    def __call__(self, theta: ArrayLike) -> Array:
        """First input: (nt,) -> (nu,) or (n, nt) -> (n, nu), see `evaluate`."""
        return self.evaluate(theta)[0]

    def value(self, theta: ArrayLike) -> Array:
        """Optimal cost (n,) or (), infinite outside the partition."""
        points, single = self._points(theta)
        region, outside = locate(self.tree, self.partition, self._scaled(points))
        p, law = self.partition.problem, self.partition.law[region]
        z = np.einsum("nij,nj->ni", law[:, :, :-1], points) + law[:, :, -1]
        free = np.sum(points @ p.Y * points, axis=1) / 2 + points @ p.y + p.c
        cost = np.sum(z @ p.H * z, axis=1) / 2 + np.sum((points @ p.F.T + p.f) * z, axis=1) + free
        cost = np.where(outside, np.inf, cost)
        return cost[0] if single else cost

    def save(self, path: str | Path) -> tuple[Path, Path]:
        """Write `path`.npz (arrays) and `path`.json (everything else); see `load`."""
        from mpc.explicit.storage import save_explicit

        return save_explicit(self, Path(path))

    @classmethod
    def load(cls, path: str | Path) -> ExplicitMPC:
        """Read what `save` wrote; nothing is executed and nothing recomputed."""
        from mpc.explicit.storage import load_explicit

        return load_explicit(Path(path))

    def to_c(self, folder: str | Path, **options: Any) -> CodeReport:
        """Write the law as self-contained C99, see `codegen.write_c`."""
        from mpc.explicit.codegen.codegen import write_c

        return write_c(self, Path(folder), **options)

    def plot(self, what: str = "regions", **style: Any) -> Any:
        """Draw "regions", "law" or "value" of a law of two parameters, see `plotting.plot_explicit`."""
        from mpc.explicit.plotting import plot_explicit

        return plot_explicit(self, what, **style)

    def _points(self, theta: ArrayLike) -> tuple[Array, bool]:
        points = as_floats("theta", theta)
        single = points.ndim == 1
        points = points[None] if single else points
        if points.ndim != 2 or points.shape[1] != self.nt:
            raise InputError(f"theta has shape {np.shape(theta)}, expected ({self.nt},) or (n, {self.nt}).")
        if not np.isfinite(points).all():
            raise InputError(f"theta is not finite in row {int(np.argwhere(~np.isfinite(points))[0, 0])}.")
        return points, single

    def _scaled(self, points: Array) -> Array:
        return (points - self.partition.centre) / self.partition.half


def default_parameters(mpc: MPCProblem, problem: ParametricQP) -> Polytope:
    """Parameters of interest where none are named: X, or X × U when the last input is a parameter."""
    names = [name for name, _ in problem.parameters]
    if mpc.X is None or set(names) - {"x", "u_prev"} or ("u_prev" in names and mpc.U is None):
        raise InputError(f"theta_set is missing: pass a bounded Polytope of the parameters {names}.")
    if names == ["x"]:
        return mpc.X
    from invariant_sets import Polytope

    (HX, hX), (HU, hU) = mpc.state_rows, mpc.input_rows
    rows = np.block([[HX, np.zeros((len(HX), mpc.nu))], [np.zeros((len(HU), mpc.nx)), HU]])
    return Polytope(rows, np.concatenate([hX, hU]))


def _law_numbers(law: Array, partition: Partition) -> Ints:
    """Equal numbers for equal laws, compared by their values over the parameter set."""
    scaled = law.copy()
    scaled[:, :, :-1] *= partition.half
    scaled[:, :, -1] += law[:, :, :-1] @ partition.centre
    size = np.abs(scaled).max() or 1.0
    _, number = np.unique(np.round(scaled.reshape(len(law), -1) / size, 9) + 0.0, axis=0, return_inverse=True)
    return number.astype(np.int64).ravel()
