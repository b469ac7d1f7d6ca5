"""Evaluation of piecewise affine control laws."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from ccdtools_ground.door import frozen
from mpc.checks import Array, Flags, Immutable, Ints, as_floats
from mpc.exceptions import InputError
from mpc.explicit.partition import MPQPStatus, Partition
from mpc.explicit.search_tree import SearchTree, is_scan, search
from mpc.halfspaces import box_of, nearest_points


@dataclass(frozen=True, eq=False, repr=False)
class PiecewiseLaw(Immutable):
    """Piecewise affine control law u(θ) of a partition; `ExplicitMPC` says what its parts are."""

    partition: Partition
    tree: SearchTree
    law: Array
    law_number: Ints
    input_rows: tuple[Array, Array]

    def __post_init__(self) -> None:
        super().__post_init__()
        H, h = (np.array(rows, dtype=np.float64, order="C") for rows in self.input_rows)
        self._set(input_rows=(frozen(H), frozen(h)))

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

    def locate(self, theta: ArrayLike, *, method: str = "tree") -> Ints:
        """Region of each parameter (n, nt) -> (n,) or (nt,) -> (); -1 outside."""
        points, single = self._points(theta)
        region, outside, _ = search(self.tree, self.partition, points, scan=is_scan(method))
        region = np.where(outside, -1, region)
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
        laws = self.law, self.law_number, limits
        _, outside, u = search(self.tree, self.partition, points, laws, scan=is_scan(method))
        if box is None:
            u[outside] = nearest_points(u[outside], H, h)
        return (u[0], outside[0]) if single else (u, outside)

    def __call__(self, theta: ArrayLike) -> Array:
        """First input: (nt,) -> (nu,) or (n, nt) -> (n, nu)."""
        return self.evaluate(theta)[0]

    def value(self, theta: ArrayLike) -> Array:
        """Optimal cost (n,) or (), infinite outside the partition."""
        points, single = self._points(theta)
        region, outside, _ = search(self.tree, self.partition, points)
        p = self.partition.problem
        law = self.partition.law[region]
        with np.errstate(over="ignore", invalid="ignore"):  # parameters far outside
            z = np.einsum("nij,nj->ni", law[:, :, :-1], points) + law[:, :, -1]
            free = np.sum(points @ p.Y * points, axis=1) / 2 + points @ p.y + p.c
            cost = np.sum(z @ p.H * z, axis=1) / 2 + np.sum((points @ p.F.T + p.f) * z, axis=1) + free
        cost = np.where(outside, np.inf, cost)
        return cost[0] if single else cost

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
