"""Effects of inputs on the model: states, cost and violation."""

from __future__ import annotations

import math
from bisect import bisect_right
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from mpc.checks import Array, Flags, as_array, as_floats
from mpc.exceptions import InputError
from mpc.feedback import block_lengths
from mpc.problem import MPCProblem

Given = dict[str, Array]


def simulated(problem: MPCProblem, x: Array, push: Array, law: Callable[[int, Array], Array]) -> tuple[Array, Array]:
    """Inputs and states under a law, with pushes.

    x : (n, nx); push : (N, nx), or (n, N, nx); law : of the step and states (n, nx).
    """
    inputs = np.empty((len(x), problem.horizon, problem.nu))
    states = np.empty((len(x), problem.horizon + 1, problem.nx))
    states[:, 0] = x
    for k in range(problem.horizon):
        u = inputs[:, k] = law(k, x)
        x = states[:, k + 1] = finite(x @ problem.A.T + u @ problem.B.T + push[..., k, :])
    return inputs, states


def rollout(problem: MPCProblem, x: Array, inputs: Array, given: Given) -> Array:
    """States (N + 1, nx) of the model under inputs and disturbance."""
    return np.asarray(simulated(problem, x[None], pushes(problem, given), lambda k, _: inputs[None, k])[1][0])


def rollout_with_feedback(
    problem: MPCProblem, x: Array, deviations: Array, feedback: Array, given: Sequence[Given]
) -> tuple[Array, Array, Array]:
    """Inputs u = v - Kx in U, states, relative violations (n,).

    Computed forwards, each input from the state before it, so that rounding does not grow with the plant.
    """
    starts = np.cumsum([0, *block_lengths(problem)])[:-1].tolist()
    wanted = np.empty(deviations.shape)
    held = np.empty(deviations.shape)

    def law(k: int, state: Array) -> Array:
        """Input of a block, from the state at its start."""
        b = bisect_right(starts, k) - 1
        if k == starts[b]:
            wanted[:, b] = finite(deviations[:, b] - state @ feedback[b].T)
            held[:, b] = problem.nearest_inputs(wanted[:, b])
        return np.asarray(held[:, b])

    inputs, states = simulated(problem, x, np.array([pushes(problem, each) for each in given]), law)
    extent = np.where(problem.input_extent > 0, problem.input_extent, np.inf)
    missed = np.abs((held - wanted) / extent).max(axis=(1, 2), initial=0.0)
    rates = [rate_violation(problem, *each) for each in zip(inputs, given)]
    return inputs, states, np.maximum(missed, rates)


def admissible(problem: MPCProblem, inputs: Array, given: Given) -> Array:
    """Inputs within U and the rate limit that follow `inputs`."""
    followed = problem.nearest_inputs(np.nan_to_num(inputs))
    if problem.rate_limit is None:
        return followed
    return no_faster(followed, given["u_prev"], problem.rate_limit, np.zeros(len(followed), dtype=bool))


def no_faster(inputs: Array, last: Array, rate_limit: Array, held: Flags) -> Array:
    """Inputs (N, nu) of U that follow these within the rate limit, the same where they are held."""
    followed = np.empty_like(inputs)
    for k, wanted in enumerate(inputs):
        move = 0.0 if held[k] else wanted - last
        share = np.max(np.abs(move) / rate_limit, initial=1.0)
        last = followed[k] = last + move / share  # between two inputs of U, so in U
    return followed


def rate_violation(problem: MPCProblem, inputs: Array, given: Given) -> float:
    """Largest relative excess of the rate limit [-]."""
    if problem.rate_limit is None:
        return 0.0
    moves = np.diff(np.vstack([given["u_prev"], inputs]), axis=0)
    return float(np.max(np.abs(moves) / problem.rate_limit - 1.0, initial=0.0))


def disturbance(problem: MPCProblem, given: Given) -> Array:
    """Disturbance (N, nw) over the horizon, zero where none is given."""
    shape = (problem.horizon, problem.nw)
    return given["w"].reshape(shape) if "w" in given else np.zeros(shape)


def pushes(problem: MPCProblem, given: Given) -> Array:
    """Move (N, nx) of each next state by the previewed disturbance."""
    if "w" not in given:
        return np.zeros((problem.horizon, problem.nx))
    return np.asarray(disturbance(problem, given) @ problem.E.T)


def references(problem: MPCProblem, given: Given) -> tuple[Array, Array]:
    """Reference states (N + 1, nx) and inputs (N, nu); zero without one."""
    states, inputs = (problem.signal_shapes[name] for name in ("x_ref", "u_ref"))
    return given.get("x_ref", np.zeros(states)).reshape(states), given.get("u_ref", np.zeros(inputs)).reshape(inputs)


def deviations(states: Array, inputs: Array, given: Given) -> tuple[Array, Array]:
    """Deviations of states and inputs from their references."""
    error = states - given["x_ref"].reshape(states.shape) if "x_ref" in given else states
    return error, inputs - given["u_ref"].reshape(inputs.shape) if "u_ref" in given else inputs


def cost_of(problem: MPCProblem, inputs: Array, states: Array, given: Given) -> float:
    """Cost of inputs and states, soft constraints included."""
    error, effort = deviations(states, inputs, given)
    Q = np.asarray(problem.Q)
    R = np.asarray(problem.R)
    P = np.asarray(problem.P)
    cost = np.vdot(error[:-1] @ Q, error[:-1]) + np.vdot(effort @ R, effort) + error[-1] @ P @ error[-1]
    cost += 2 * np.vdot(error[:-1] @ problem.cross, effort)
    if problem.soft is not None:
        linear, quadratic = problem.soft
        s = relative_violations(problem, states, problem.price_units)
        cost += linear * s.sum() + quadratic * np.sum(s**2)
    return float(cost)


def violation_of(problem: MPCProblem, states: Array) -> float:
    """Largest violation of a state or terminal constraint, in bound units."""
    excess = np.concatenate([part.ravel() for part in _excesses(problem, states)])
    return _largest(excess) if len(excess) else 0.0


def _excesses(problem: MPCProblem, states: Array) -> tuple[Array, Array]:
    """Excess over limits (…, N, rows), and at the end (…, rows)."""
    end, at_end = problem.rows_at("terminal", problem.horizon)
    along = finite(states[..., 1:, :] @ problem.state_rows[0].T) - problem.bounds["state"][1:]
    return along, finite(states[..., -1, :] @ end.T) - at_end


def _largest(excess: Array) -> float:
    """Largest entry, at least 0; finite on overflow."""
    largest = float(excess.max())
    return max(largest, 0.0) if np.isfinite(largest) else float(np.finfo(float).max)


def relative_violations(problem: MPCProblem, states: Array, units: dict[str, Array] | None = None) -> Array:
    """Largest relative violation (…, N) of each step [-]."""
    excess, at_end = _excesses(problem, states)
    units = problem.row_units if units is None else units
    along = np.max(excess / units["state"], axis=-1, initial=0.0)
    along[..., -1] = np.maximum(along[..., -1], np.max(at_end / units["terminal"], axis=-1, initial=0.0))
    return np.asarray(along)


def finite(v: Array) -> Array:
    """Numbers with overflow replaced by large ones and NaN by 0."""
    if math.isfinite(np.vdot(v, v)):  # half the time of looking at each entry
        return v
    largest = float(np.finfo(float).max) / 4
    return np.nan_to_num(v, nan=0.0, posinf=largest, neginf=-largest)


def spread_signals(problem: MPCProblem, signals: dict[str, ArrayLike | None]) -> dict[str, Array]:
    """Each signal as a flat array, single rows held over the horizon.

    Raises
    ------
    InputError
        An unknown name, a wrong shape, NaN, or a signal the controller was not built for.
    """
    shapes = problem.signal_shapes
    given: dict[str, Array] = {}
    stated = {name: value for name, value in signals.items() if value is not None}
    for name, value in (problem.lasting_beside(stated) | stated).items():
        if name == "w" and name not in shapes:
            raise InputError("w", "a disturbance", "none", "The controller has no disturbance matrix E.")
        if name not in shapes:
            raise InputError(name, f"unknown signal {name!r}", f"some of {sorted(shapes)}")
        rows, n = shapes[name]
        array = as_floats(name, value)
        held = array.reshape(1, -1).repeat(rows, axis=0) if array.ndim <= 1 else array
        given[name] = as_array(name, held, (rows, n)).ravel()
    if problem.rate_limit is not None and "u_prev" not in given:
        raise InputError("u_prev", "nothing", "the last input", "The controller has a rate limit: pass u_prev.")
    if problem.rate_limit is None and "u_prev" in given:
        raise InputError("u_prev", "a last input", "none", "The controller has no rate limit: leave u_prev out.")
    return given


def for_each_state(problem: MPCProblem, signals: dict[str, Any], n: int) -> list[dict[str, Array]]:
    """Signals of n solves, common or one entry for each."""
    each = {
        name: as_array(name, value, (n, *((problem.nu,) if name == "u_prev" else problem.signal_shapes[name])))
        for name, value in signals.items()
        if name in problem.signal_shapes and value is not None
        and as_floats(name, value).ndim == (2 if name == "u_prev" else 3)
    }  # fmt: skip
    if not each:
        return [spread_signals(problem, signals)] * n
    return [spread_signals(problem, signals | {name: rows[i] for name, rows in each.items()}) for i in range(n)]
