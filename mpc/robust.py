"""Limits tightened along a horizon by what disturbances within a set can do.

References
----------
Chisci, Rossiter and Zappa, "Systems with persistent disturbances: predictive control with restricted constraints",
Automatica 37(7), 2001. Kolmanovsky and Gilbert, "Theory and computation of disturbance invariant sets for discrete-time
linear systems", Mathematical Problems in Engineering 4(4), 1998: the terminal set.
"""

from __future__ import annotations

from contextlib import suppress
from typing import Any

import numpy as np
from scipy.linalg import block_diag
from scipy.optimize import minimize

from ccdtools_ground.door import shown
from mpc.budgets import INPUT_WEIGHTS, TUBE_ACCURACY, TUBE_STEPS, TUBE_TRIALS
from mpc.checks import Array, as_set
from mpc.exceptions import InfeasibleError, InputError, NotStabilisableError
from mpc.riccati import lqr

Rows = tuple[Array, Array]
Sides = tuple[tuple[Rows, Array], tuple[Rows, Array]]  # half-spaces of X and U, with the size of each row
ADVICE = "Shrink W (a lower level, a better model), or widen X and U."


def as_disturbance_set(value: Any, E: Array) -> Any:
    """Bounded set W with a point, or what knows its room, for the columns of E."""
    own = hasattr(value, "support") or hasattr(value, "room")
    W = value if own else as_set("W", value, E.shape[1])
    if not own and not hasattr(W, "support"):
        raise InputError("W", shown(value), "a Polytope, or finite bounds (lower, upper)")
    if W.dim != E.shape[1]:
        raise InputError("W", f"a set of {W.dim} coordinates", f"one of {E.shape[1]}, one for each column of E")
    if hasattr(W, "room"):
        return W
    if W.is_empty or not W.is_bounded:
        raise InputError("W", "an empty set" if W.is_empty else "an unbounded set", "a bounded set with a point")
    return W


def tightened(rows: Array, loop: Array, E: Array, W: Any, steps: int) -> Array:
    """Room (steps + 1, m) that disturbances take along rows.

    For k = 0, 1, … steps and `rows` (m, nx) of a state, the support of ⊕_{i<k} loopⁱ E W: the error of a prediction
    under the gain that `loop` = A − B K is closed by. A W with `room` says itself what it takes.
    """
    if hasattr(W, "room"):
        return np.asarray(W.room(rows, loop, E, range(steps + 1)))
    moved = [rows]
    for _ in range(steps - 1):
        moved.append(moved[-1] @ loop)
    grown = W.support(np.concatenate(moved[:steps]) @ E) if steps * len(rows) else np.zeros(0)
    return np.vstack([np.zeros(len(rows)), grown.reshape(steps, len(rows)).cumsum(axis=0)])


def in_the_end(rows: Array, loop: Array, E: Array, W: Any) -> Array:
    """Room (m,) that disturbances take along rows after ever so many steps."""
    spans = getattr(W, "spans", (TUBE_STEPS,))
    room = W.room(rows, loop, E, spans) if hasattr(W, "room") else tightened(rows, loop, E, W, TUBE_STEPS)[-1:]
    radius = np.abs(np.linalg.eigvals(loop)).max()
    followed = 1 - radius ** np.array(spans)  # parts of the room that so many steps take, of the slowest mode
    return np.asarray((room / followed[:, None]).min(axis=0))


def tube_gain(A: Array, B: Array, weights: dict[str, Any], sides: Sides, E: Array, W: Any) -> Array:
    """Gain (nu, nx) that leaves most of the limits.

    A gain that is high for the cost's sake passes disturbances on to the inputs; one that is low, to the states. Both
    are counted in the limits' own size, and the row that is left least decides. Compared are the regulators with the
    weight of the inputs times `INPUT_WEIGHTS`; where each of these leaves nothing of some row, and so no terminal set,
    the best begins a search over all gains.
    """
    (HX, _), (HU, _) = (rows for rows, _ in sides)
    units = np.concatenate([unit for _, unit in sides])

    def left(K: Array) -> float:
        """Part left of the row that is left least."""
        loop = A - B @ K
        if np.abs(np.linalg.eigvals(loop)).max() >= 1:
            return -np.inf
        room = in_the_end(np.vstack([HX, -HU @ K]), loop, E, W)
        return float((1 - room / units).min(initial=np.inf))

    gains = [lqr(A, B, **weights)[0]]
    for by in INPUT_WEIGHTS:
        with suppress(NotStabilisableError):  # an input may become too dear for the solver's digits
            gains.append(lqr(A, B, **{**weights, "R": by * weights["R"]})[0])
    best = max(gains, key=left)
    if left(best) > 0:
        return best
    options = {"xatol": np.inf, "fatol": TUBE_ACCURACY, "maxfev": TUBE_TRIALS, "adaptive": True}
    found = minimize(lambda K: -left(K.reshape(best.shape)), best.ravel(), method="Nelder-Mead", options=options)
    return np.asarray(found.x.reshape(best.shape))


def robust_terminal_rows(
    A: Array, B: Array, K: Array, state: Rows, action: Rows, E: Array, W: Any, horizon: int
) -> Rows:
    """Half-spaces of the largest robust set under u = −K x.

    It is kept within both limits whatever w in W does. Of a W with `room` it is the largest set that no disturbance
    leads out of the limits tightened by all that it takes in the end, plus what it takes within the horizon.

    Raises
    ------
    InfeasibleError
        There is none.
    """
    from invariant_sets import Polytope, maximal_positively_invariant_set

    (HX, hX), (HU, hU) = state, action
    loop, C = A - B @ K, np.vstack([np.eye(len(A)), -K])
    rows, bounds = block_diag(HX, HU), np.concatenate([hX, hU])
    own = hasattr(W, "room")
    if own:
        bounds = bounds - in_the_end(rows @ C, loop, E, W)
    known = {} if own else {"E": E, "W": W}
    found = maximal_positively_invariant_set(loop, Polytope(rows, bounds), C=C, **known)
    if found.set.is_empty:
        raise InfeasibleError(
            f"no set of states is kept within X and U by u = -Kx whatever w in W does: {found.status.name}. {ADVICE}"
        )
    H, h = found.set.one_sided
    return (H, h + tightened(H, loop, E, W, horizon)[-1]) if own else (H, h)
