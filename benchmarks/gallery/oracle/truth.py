"""What knowing the real plant is worth: the best clipped affine feedback and design found on the real plant itself."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.optimize import minimize

from gallery.oracle.cost import real_step, simulated
from gallery.oracle.statement import Array, Statement

RUNS = 100
SUBSTEPS = 3


@dataclass(frozen=True)
class Truth:
    """Returns on the real plant.

    Attributes
    ----------
    deployed : float
        Of the model's LQR at the model's best design.
    policy_alone : float
        Of the best feedback at that design.
    design : (np,) array
        Best design together with its best feedback.
    both : float
        Their return.
    """

    deployed: float
    policy_alone: float
    design: Array
    both: float


def truth(s: Statement, best: Array, seed: int = 11) -> Truth:
    """What the model's best design brings on the real plant, and what policy and design made for that plant bring."""
    w = s.disturbance(RUNS, seed)
    A, B, _ = s.sampled(best)
    deployed = _affine_return(s, best, s.gain(A, B), np.zeros(len(s.R)), w)
    alone, design, feedback = best_feedback(s, best, w)
    return Truth(deployed, alone, design, _around_lqr(s, design, feedback, w))


def best_feedback(s: Statement, first: Array, w: Array) -> tuple[float, Array, Array]:
    """Return of the best feedback at a design; the best design near it with its own best feedback."""
    v = (first - s.lower) / (s.upper - s.lower)
    alone = _climb(lambda z: _around_lqr(s, first, z, w), np.zeros(len(s.R) * (len(s.x0) + 1)), 0.1)
    start = np.r_[v, alone.x]
    both = _climb(lambda z: _around_lqr(s, s.from_unit(z[: len(v)]), z[len(v) :], w), start, 0.1, box=len(v))
    return -float(alone.fun), s.from_unit(both.x[: len(v)]), both.x[len(v) :]


def feedback_return(s: Statement, p: Array, feedback: Array, w: Array) -> float:
    """Mean return of what `best_feedback` has found, under other disturbances."""
    return _around_lqr(s, p, feedback, w)


def affine(s: Statement, p: Array, z: Array) -> tuple[Array, Array]:
    """K and u_0 of u = u_0 − K x, that `best_feedback` has found: parts of the LQR of the plant, and of its limits."""
    K = s.gain(*_linearised(s, p))
    relative = z.reshape(len(s.R), -1)
    return K * (1 + relative[:, :-1]), relative[:, -1] * s.u_max


def _around_lqr(s: Statement, p: Array, z: Array, w: Array) -> float:
    """Return of a feedback as `affine` reads it."""
    return _affine_return(s, p, *affine(s, p, z), w)


def _linearised(s: Statement, p: Array) -> tuple[Array, Array]:
    """A and B of the sampled real plant, from differences over some hundredths of the limits."""
    step = real_step(s, p, SUBSTEPS)
    nx = len(s.x0)
    h = np.r_[0.1 * s.x_max, 0.1 * s.u_max]
    z = np.vstack([np.diag(h), -np.diag(h)])
    moved = step(z[:, :nx], z[:, nx:], np.zeros((len(z), len(s.std))))
    J = ((moved[: len(h)] - moved[len(h) :]) / (2 * h[:, None])).T
    return J[:, :nx], J[:, nx:]


def _affine_return(s: Statement, p: Array, K: Array, offset: Array, w: Array) -> float:
    """Mean return on the real plant."""
    return float(simulated(s, real_step(s, p, SUBSTEPS), lambda x: offset - x @ K.T, w)[0].mean())


def _climb(value, start: Array, size: float, *, box: int = 0):
    """A local maximum of `value` by Nelder and Mead; the first `box` coordinates stay in [0, 1]."""
    simplex = np.vstack([start, start + size * np.eye(len(start))])
    inside = simplex[:, :box]
    simplex[:, :box] = np.where(inside > 1, inside - 2 * size, inside)
    bounds = [(0.0, 1.0)] * box + [(None, None)] * (len(start) - box)
    return minimize(
        lambda z: -value(z), start, method="Nelder-Mead", bounds=bounds,
        options={"initial_simplex": simplex, "maxfev": 40 * len(start), "xatol": 1e-3, "fatol": 1e-4, "adaptive": True},
    )  # fmt: skip
