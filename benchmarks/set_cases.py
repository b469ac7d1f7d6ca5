"""Random constrained plants in hard units, on which sets are computed."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.linalg import block_diag

from invariant_sets import Polytope

Array = np.ndarray
Rows = tuple[Array, Array]


@dataclass(frozen=True)
class Case:
    """A plant x⁺ = A x + B u with rows of X, U and a target, as drawn; the package gets it in other units.

    Attributes
    ----------
    A, B : arrays
        Dynamics.
    X, U, target : (F, g)
        Rows F z <= g.
    state_units, input_units : arrays
        The package sees x·state_units and u·input_units.
    steps : int
        Steps of a controllable set.
    """

    A: Array
    B: Array
    X: Rows
    U: Rows
    target: Rows
    state_units: Array
    input_units: Array
    steps: int = 1

    @property
    def matrices(self) -> tuple[Array, Array]:
        """A and B in the units of the package."""
        s, t = self.state_units, self.input_units
        return self.A * s[:, None] / s, self.B * s[:, None] / t

    def states(self, rows: Rows) -> Polytope:
        """Return rows on x as a set in the units of the package."""
        return Polytope(rows[0] / self.state_units, rows[1])

    def inputs(self) -> Polytope:
        """Return U in the units of the package."""
        return Polytope(self.U[0] / self.input_units, self.U[1])

    def drawn(self, P: Polytope) -> Rows:
        """Return the rows of a set of the package in the units of the plant as drawn, of unit norm."""
        F = np.vstack([P.A, P.A_eq, -P.A_eq]) * self.state_units
        norms = np.linalg.norm(F, axis=1)
        norms[norms == 0] = 1.0
        return F / norms[:, None], np.concatenate([P.b, P.b_eq, -P.b_eq]) / norms


def box(lower: Array, upper: Array) -> Rows:
    """Return the rows of a box."""
    eye = np.eye(len(lower))
    return np.vstack([eye, -eye]), np.concatenate([upper, -np.asarray(lower)])


def spread(rng: np.random.Generator, n: int, decades: float) -> Array:
    """Return n units over the given number of decades on either side of one."""
    return 10.0 ** rng.uniform(-decades, decades, n)


def plant(rng: np.random.Generator, n: int, m: int, radius: tuple[float, float], held_out: bool) -> tuple[Array, Array]:
    """Return A with a spectral radius in the given range, and B."""
    kind = int(rng.integers(4)) if held_out else -1
    B = rng.normal(size=(n, m))
    size = rng.uniform(*radius)
    if kind == 0:  # a chain of integrators, stable or not
        A = min(size, 1.0) * np.eye(n) + 0.5 * np.eye(n, k=1)
    elif kind == 1:  # weakly damped modes
        angles = rng.uniform(0.2, 2.5, (n + 1) // 2)
        turns = [np.array([[np.cos(a), -np.sin(a)], [np.sin(a), np.cos(a)]]) for a in angles]
        mix = rng.normal(size=(n, n))
        A = mix @ (min(size, 0.97) * block_diag(*turns)[:n, :n]) @ np.linalg.inv(mix)
    elif kind == 2:  # nilpotent or singular
        A = np.triu(rng.normal(size=(n, n)), 1) + np.diag(rng.choice([0.0, 0.5 * size], n))
    elif kind == 3:  # symmetric, modes of either sign
        Q = np.linalg.qr(rng.normal(size=(n, n)))[0]
        A = Q @ np.diag(rng.uniform(-size, size, n)) @ Q.T
    else:
        A = rng.normal(size=(n, n))
        A *= size / max(np.abs(np.linalg.eigvals(A)).max(), 1e-3)
    return A, B


def input_rows(rng: np.random.Generator, m: int) -> Rows:
    """Return a box, a box with a corner off, or a simplex, with zero inside or on the border now and then."""
    lower, upper = -rng.uniform(0.2, 2, m), rng.uniform(0.2, 2, m)
    F, g = box(lower, upper)
    if m > 1 and rng.random() < 0.4:
        d = rng.uniform(0.2, 1, m)
        F, g = np.vstack([F, d]), np.append(g, 0.6 * d @ upper)
    return F, g


def dressed(rng: np.random.Generator, rows: Rows, size: float) -> Rows:
    """Return the rows with copies, weakly redundant and far ones among them, shuffled."""
    F, g = rows
    draw = rng.random()
    if draw < 0.25:
        F, g = np.vstack([F, 3 * F[:1], F[-1:]]), np.concatenate([g, 3 * g[:1], g[-1:]])
    elif draw < 0.5:
        far = rng.normal(size=F.shape[1])
        F, g = np.vstack([F, far]), np.append(g, size * 10.0 ** rng.uniform(3, 18))
    order = rng.permutation(len(g))
    return F[order], g[order]


def positive_case(seed: int, held_out: bool = False) -> tuple[Case, Array, Rows]:
    """Return a stable plant, an output matrix and rows on one or two outputs."""
    rng = np.random.default_rng([1, seed, held_out])
    n, outputs = 2 + seed % 4, 1 + (seed // 4) % 2
    A, _ = plant(rng, n, 1, (0.4, 0.98), held_out)
    A *= min(1.0, 0.98 / max(np.abs(np.linalg.eigvals(A)).max(), 1e-9))
    C = rng.normal(size=(outputs, n))
    if rng.random() < 0.25:  # a mode that no output sees
        values = np.linalg.eigvals(A.T)
        hidden = int(np.flatnonzero(np.abs(values.imag) < 1e-12)[0]) if (np.abs(values.imag) < 1e-12).any() else -1
        if hidden >= 0:
            right = np.linalg.eig(A)[1][:, np.argmin(np.abs(np.linalg.eig(A)[0] - values[hidden]))].real
            C = C - np.outer(C @ right, right) / (right @ right)
    Y = box(-rng.uniform(0.2, 2, outputs), rng.uniform(0.2, 2, outputs))
    units = spread(rng, n, 3.0 * (seed % 3))
    return Case(A, np.zeros((n, 1)), (Y[0] @ C, Y[1]), box([-1.0], [1.0]), Y, units, np.ones(1)), C, Y


def controllable_case(seed: int, held_out: bool = False) -> Case:
    """Return a plant with 1 to 3 inputs and 1 to 4 states, a target and 1 to 4 steps."""
    rng = np.random.default_rng([2, seed, held_out])
    n, m = 1 + seed % 4, 1 + (seed // 4) % 3
    A, B = plant(rng, n, m, (0.3, 1.6), held_out)
    if m > 1 and rng.random() < 0.3:
        B[:, 1] = B[:, 0] * rng.uniform(-2, 2) + (1e-6 * rng.normal(size=n) if rng.random() < 0.5 else 0.0)
    X = dressed(rng, box(-rng.uniform(1, 4, n), rng.uniform(1, 4, n)), 4.0)
    if rng.random() < 0.5:
        target = box(-rng.uniform(0.1, 1, n), rng.uniform(0.1, 1, n))
    else:
        F = rng.normal(size=(2 * n + 1, n))
        around = box(-np.ones(n), np.ones(n))
        target = np.vstack([F, around[0]]), np.append(rng.uniform(0.3, 1, 2 * n + 1), around[1])
    decades = 2.0 * (seed % 3)
    U = dressed(rng, input_rows(rng, m), 2.0)
    state_units, input_units = spread(rng, n, decades), spread(rng, m, decades)
    return Case(A, B, X, U, target, state_units, input_units, int(rng.integers(1, 5 if n < 4 else 3)))


def control_case(seed: int, held_out: bool = False) -> Case:
    """Return a plant with 1 to 6 states and 1 to 3 inputs inside boxes."""
    rng = np.random.default_rng([3, seed, held_out])
    n, m = 1 + seed % 6, 1 + (seed // 6) % 3
    A, B = plant(rng, n, m, (0.5, 1.3), held_out)
    X = dressed(rng, box(-rng.uniform(1, 3, n), rng.uniform(1, 3, n)), 3.0)
    U = dressed(rng, input_rows(rng, m), 2.0)
    decades = 2.0 * (seed % 3)
    return Case(A, B, X, U, X, spread(rng, n, decades), spread(rng, m, decades))
