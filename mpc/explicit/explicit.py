"""MPC laws as piecewise affine functions."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from mpc.checks import Array, as_floats, as_halfspaces
from mpc.exceptions import InfeasibleError, InputError
from mpc.explicit.partition import Ints, Laws, MPQPStatus, Partition
from mpc.explicit.search_tree import METHODS, SearchTree, build_tree, evaluate, find, region_points
from mpc.halfspaces import box_of, nearest_points
from mpc.tolerances import EQUAL_LAW, LAW_ROUNDING

if TYPE_CHECKING:
    from invariant_sets import Polytope
    from mpc.explicit.codegen.codegen import CodeReport
    from mpc.parametric_qp import ParametricQP
    from mpc.problem import MPCProblem

Flags = np.ndarray[Any, np.dtype[np.bool_]]



@dataclass(frozen=True, eq=False)
class Region:
    """Critical region with the law u = gain θ + offset."""

    polytope: Polytope
    gain: Array
    offset: Array
    active_set: tuple[int, ...]


@dataclass(frozen=True, eq=False, repr=False)
class ExplicitMPC:
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

    partition: Partition
    tree: SearchTree
    law: Array
    law_number: Ints
    input_rows: tuple[Array, Array]

    def __post_init__(self) -> None:
        for name in ("law", "law_number"):
            object.__setattr__(self, name, _read_only(getattr(self, name)))
        H, h = self.input_rows
        object.__setattr__(self, "input_rows", (_read_only(H), _read_only(h)))

    def __getstate__(self) -> dict[str, Any]:
        """Fields without the cached regions."""
        return {name: value for name, value in self.__dict__.items() if name != "regions"}

    def __setstate__(self, state: dict[str, Any]) -> None:
        for name, value in state.items():
            object.__setattr__(self, name, value)
        self.__post_init__()

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
        rows = (np.zeros((0, nu)), np.zeros(0)) if input_rows is None else _as_rows(input_rows, nu)
        tree = build_tree(partition, number, points, method=method, time_limit=tree_time_limit)
        return cls(partition, tree, law, number, rows)

    @property
    def status(self) -> MPQPStatus:
        """Whether the partition is complete."""
        return self.partition.status

    @property
    def nu(self) -> int:
        """Number of inputs."""
        return int(self.law.shape[1])

    @property
    def nt(self) -> int:
        """Number of parameters."""
        return int(self.law.shape[2] - 1)

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

    def locate(self, theta: ArrayLike, *, method: str = "tree") -> Ints:
        """Region of each parameter (n, nt) -> (n,) or (nt,) -> (); -1 outside."""
        points, single = self._points(theta)
        found = find(self.tree, self.partition, points, scan=_is_scan(method))
        region = np.where(found.outside, -1, found.region)
        return region[0] if single else region

    def evaluate(self, theta: ArrayLike, *, method: str = "tree") -> tuple[Array, Flags]:
        """First input, and whether the parameter lies outside.

        Parameters
        ----------
        theta : (n, nt) or (nt,) array
            States, with further parameters behind them where the law has some.
        method : "tree" or "sequential"
            By the search tree, or by a scan of all regions; the same inputs.

        Returns
        -------
        u : (n, nu) or (nu,) array
            Outside a complete partition, the input where the straight line to `tree.centre` enters it; outside an
            incomplete one, the law of the nearest region, projected onto the input set.
        outside : (n,) or () bool array
            True where no region holds the parameter: there the problem is infeasible, or not of interest.

        Raises
        ------
        InputError
            Wrong shape, NaN, or an unknown method.
        """
        points, single = self._points(theta)
        H, h = self.input_rows
        box = box_of(H, h)
        limits = np.array(box or (np.full(self.nu, -np.inf), np.full(self.nu, np.inf)))
        laws = Laws(self.law, self.law_number, limits)
        u, outside = evaluate(self.tree, self.partition, points, laws, scan=_is_scan(method))
        if box is None:
            u[outside] = nearest_points(u[outside], H, h)
        return (u[0], outside[0]) if single else (u, outside)

    def __call__(self, theta: ArrayLike) -> Array:
        """First input: (nt,) -> (nu,) or (n, nt) -> (n, nu)."""
        return self.evaluate(theta)[0]

    def value(self, theta: ArrayLike) -> Array:
        """Optimal cost (n,) or (), infinite outside the partition."""
        points, single = self._points(theta)
        region, outside = find(self.tree, self.partition, points)
        p = self.partition.problem
        law = self.partition.law[region]
        with np.errstate(over="ignore", invalid="ignore"):  # parameters far outside
            z = np.einsum("nij,nj->ni", law[:, :, :-1], points) + law[:, :, -1]
            free = np.sum(points @ p.Y * points, axis=1) / 2 + points @ p.y + p.c
            cost = np.sum(z @ p.H * z, axis=1) / 2 + np.sum((points @ p.F.T + p.f) * z, axis=1) + free
        cost = np.where(outside, np.inf, cost)
        return cost[0] if single else cost

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

    def _points(self, theta: ArrayLike) -> tuple[Array, bool]:
        """Parameters as new rows, and whether a single one was given."""
        points = as_floats("theta", theta)
        single = points.ndim == 1
        points = points[None] if single else points
        if points.ndim != 2 or points.shape[1] != self.nt:
            raise InputError("theta", f"shape {np.shape(theta)}", f"({self.nt},) or (n, {self.nt})")
        if not np.isfinite(points).all():
            row = int(np.argwhere(~np.isfinite(points))[0, 0])
            raise InputError("theta", f"NaN or infinity in row {row}", "finite numbers")
        return points, single


def _is_scan(method: str) -> bool:
    """Whether all regions are to be scanned."""
    if method not in METHODS:
        raise InputError("method", repr(method), "'tree' or 'sequential'")
    return method == "sequential"


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
        rows = np.block([[HX, np.zeros((len(HX), HU.shape[1]))], [np.zeros((len(HU), HX.shape[1])), HU]])
        known = Polytope(rows, np.concatenate([hX, hU]))
    n = known.dim
    rows = np.block([[-problem.S, problem.G], [known.A, np.zeros((len(known.A), problem.G.shape[1]))]])
    joint = Polytope(rows, np.concatenate([problem.w, known.b]))
    directions = np.hstack([np.vstack([np.eye(n), -np.eye(n)]), np.zeros((2 * n, problem.G.shape[1]))])
    reach = joint.support(directions)
    if not np.isfinite(reach).all():
        return known
    room = 1e-3 * (reach[:n] + reach[n:])  # no side of the box touches the feasible parameters
    return known.intersection(Polytope.from_bounds(-reach[n:] - room, reach[:n] + room))


def _as_rows(rows: Any, nu: int) -> tuple[Array, Array]:
    """Rows (H, h) of the input set, checked."""
    if not isinstance(rows, tuple) or len(rows) != 2:
        raise InputError("input_rows", type(rows).__name__, "a pair (H, h) with Hu <= h")
    return as_halfspaces("input_rows", _Halfspaces(*rows), nu)


@dataclass(frozen=True)
class _Halfspaces:
    """Set with `.A` and `.b`."""

    A: Any
    b: Any


def _read_only(array: Any) -> Any:
    """Read-only copy."""
    array = np.array(array, order="C")
    array.flags.writeable = False
    return array


def _law_numbers(law: Array, partition: Partition, centres: Array) -> Ints:
    """Equal numbers for equal laws, in units of the inputs' values."""
    scaled = law.copy()
    scaled[:, :, :-1] *= partition.half
    scaled[:, :, -1] += law[:, :, :-1] @ partition.centre
    values = np.einsum("rij,rj->ri", scaled[:, :, :-1], centres) + scaled[:, :, -1]
    step = np.maximum(EQUAL_LAW * np.abs(values).max(axis=0), LAW_ROUNDING * np.abs(scaled).max(axis=(0, 2)))
    step = np.where(step > 0, step, 1.0)
    _, number = np.unique(np.round(scaled / step[:, None] / 2).reshape(len(law), -1) + 0.0, axis=0, return_inverse=True)
    return number.astype(np.int64).ravel()
