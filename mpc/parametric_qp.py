"""Parametric QP of an MPC step."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from mpc.checks import Array, Immutable, as_array, as_floats
from mpc.exceptions import InputError


class Constraint(NamedTuple):
    """Origin of a row of the QP.

    kind : "state", "input", "rate", "terminal" or "slack"; step : k; row : row of the user's set.
    """

    kind: str
    step: int
    row: int

    def __str__(self) -> str:
        return f"{self.kind} constraint {self.row} at step {self.step}"


@dataclass(frozen=True, eq=False, repr=False)
class ParametricQP(Immutable):
    """Minimise ½ z'Hz + (Fθ + f)'z + ½ θ'Yθ + y'θ + c, Gz <= w + Sθ.

    Attributes
    ----------
    H : (nz, nz) array
        Hessian, symmetric positive definite.
    F, f : (nz, nt) and (nz,) array
        Linear cost, affine in the parameter θ.
    Y, y, c : (nt, nt), (nt,) array and float
        The part of the cost that does not depend on z.
    G, w, S : (m, nz), (m,) and (m, nt) array
        Constraints.
    Lz, Lt, l : (N nu, nz), (N nu, nt) and (N nu,) array
        Stacked inputs u_0 … u_{N-1} = Lz z + Lt θ + l.
    Xz, Xt, x : ((N + 1) nx, nz), ((N + 1) nx, nt) and ((N + 1) nx,) array
        Stacked states x_0 … x_N = Xz z + Xt θ + x.
    nu : int
        Number of inputs.
    parameters : tuple of (name, size)
        Layout of θ; the first is always the state, ("x", nx).
    labels : tuple of Constraint
        Origin of each row of G.
    """

    H: Array
    F: Array
    f: Array
    Y: Array
    y: Array
    c: float
    G: Array
    w: Array
    S: Array
    Lz: Array
    Lt: Array
    l: Array
    Xz: Array
    Xt: Array
    x: Array
    nu: int
    parameters: tuple[tuple[str, int], ...]
    labels: tuple[Constraint, ...]

    @property
    def nz(self) -> int:
        """Number of decision variables."""
        return len(self.H)

    @property
    def nt(self) -> int:
        """Number of parameters."""
        return int(self.F.shape[1])

    @property
    def horizon(self) -> int:
        """Number of steps N."""
        return len(self.l) // self.nu

    @property
    def m(self) -> int:
        """Number of constraints."""
        return len(self.w)

    def theta(self, **values: ArrayLike) -> Array:
        """Stack named parameters into θ, in the order of `parameters`."""
        if set(values) != {name for name, _ in self.parameters}:
            raise InputError("theta", f"parameters {sorted(values)}", f"{sorted(dict(self.parameters))}")
        return np.concatenate(
            [as_array(name, as_floats(name, values[name]).ravel(), (size,)) for name, size in self.parameters]
        )

    def __repr__(self) -> str:
        names = ", ".join(f"{name}: {size}" for name, size in self.parameters)
        return f"ParametricQP({self.nz} variables, {self.m} constraints, parameters {names})"

    def at(self, theta: Array) -> tuple[Array, Array]:
        """Linear cost q and right-hand side b of the QP at θ."""
        theta = _vector("theta", theta, self.nt)
        return self.F @ theta + self.f, self.S @ theta + self.w

    def cost(self, z: Array, theta: Array) -> float:
        """Value of the objective."""
        z = _vector("z", z, self.nz)
        q, _ = self.at(theta)
        return float(0.5 * z @ self.H @ z + q @ z + 0.5 * theta @ self.Y @ theta + self.y @ theta + self.c)

    def inputs(self, z: Array, theta: Array) -> Array:
        """Input sequence (N, nu) that belongs to z."""
        z = _vector("z", z, self.nz)
        theta = _vector("theta", theta, self.nt)
        return (self.Lz @ z + self.Lt @ theta + self.l).reshape(-1, self.nu)

    def states(self, z: Array, theta: Array) -> Array:
        """State sequence (N + 1, nx) that belongs to z."""
        z = _vector("z", z, self.nz)
        theta = _vector("theta", theta, self.nt)
        return (self.Xz @ z + self.Xt @ theta + self.x).reshape(self.horizon + 1, -1)

    def fix(self, **values: ArrayLike) -> ParametricQP:
        """Problem with some parameters set to numbers."""
        sizes = dict(self.parameters)
        unknown = set(values) - set(sizes)
        if unknown:
            raise InputError("fix", f"parameters {sorted(unknown)}", f"some of {list(sizes)}")
        T = np.zeros((self.nt, 0))
        t = np.zeros(self.nt)
        for name, rows in places(sizes).items():
            if name in values:
                t[rows] = as_array(name, as_floats(name, values[name]).ravel(), (sizes[name],))
            else:
                T = np.hstack([T, np.eye(self.nt)[:, rows]])
        left = tuple(p for p in self.parameters if p[0] not in values)
        return replace(  # θ = T θ' + t
            self, F=self.F @ T, f=self.f + self.F @ t, S=self.S @ T, w=self.w + self.S @ t, Lt=self.Lt @ T,
            l=self.l + self.Lt @ t, Xt=self.Xt @ T, x=self.x + self.Xt @ t,
            Y=T.T @ self.Y @ T, y=T.T @ (self.y + self.Y @ t),
            c=self.c + float(self.y @ t + 0.5 * t @ self.Y @ t), parameters=left,
        )  # fmt: skip

    def without(self, rows: Iterable[int]) -> ParametricQP:
        """Problem without some of its constraints."""
        if not isinstance(rows, Iterable):
            raise InputError("rows", repr(rows), "the numbers of constraints")
        dropped = list(rows)
        for i in dropped:
            if isinstance(i, (bool, np.bool_)) or not isinstance(i, (int, np.integer)) or not 0 <= i < self.m:
                raise InputError("rows", repr(i), f"numbers of constraints in 0 … {self.m - 1}")
        kept = sorted({*range(self.m)} - {*dropped})
        return replace(self, G=self.G[kept], w=self.w[kept], S=self.S[kept], labels=tuple(self.labels[i] for i in kept))


def places(sizes: dict[str, int]) -> dict[str, slice]:
    """Place of each part in a vector of parts of these sizes."""
    ends = np.cumsum([0, *sizes.values()])
    return {name: slice(int(first), int(last)) for name, first, last in zip(sizes, ends[:-1], ends[1:])}


def _vector(name: str, value: ArrayLike, n: int) -> Array:
    """Value as a float array (n,), not copied if already one."""
    if isinstance(value, np.ndarray) and value.dtype == np.float64 and value.shape == (n,):
        return value
    return as_array(name, value, (n,))
