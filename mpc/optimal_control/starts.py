"""Places that a plan begins at besides its guess."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np

from ccdtools_ground.door import brief
from mpc.checks import Array, as_count
from mpc.exceptions import InputError
from mpc.optimal_control.bounds import as_guess
from mpc.optimal_control.interval import first_guess, placed
from mpc.optimal_control.ipopt import Found, Settings, once
from mpc.optimal_control.phase import evaluated, interpolated
from mpc.optimal_control.planning import Clock
from mpc.optimal_control.program import NonlinearProgram, PhasePart, shaken
from mpc.optimal_control.schemes import runge_kutta


def as_starts(starts: Any) -> int | list[Any]:
    """Number of starts, or guesses, checked as far as that goes without a program."""
    if not isinstance(starts, list | tuple):
        return as_count("starts", starts)
    if not starts:
        raise InputError("starts", "no guess", "a number, or a list of guesses")
    return list(starts)


def with_guess(program: NonlinearProgram, guess: Any) -> NonlinearProgram:
    """Program that begins at states and inputs (times, x, u) of its one phase."""
    part, count = program.parts[0], len(program.parts)
    expected = "a Solution of these phases" + ", or (times, x, u) as Phase(guess=…) takes it" * (count == 1)
    if count > 1 or not isinstance(guess, list | tuple):
        raise InputError("starts", brief(repr(guess)), expected)
    phase = replace(part.phase, guess=as_guess(guess, part.phase.states, part.phase.inputs))
    v = program.guess.copy()
    v[part.first : part.last] = placed(part.layout, part.mesh, first_guess(phase))
    return replace(program, guess=np.clip(v, program.lower, program.upper))


def without_limits(program: NonlinearProgram) -> NonlinearProgram:
    """Program without the limits along its phases, itself where there are none; equations stay."""
    lower, upper = program.row_lower.copy(), program.row_upper.copy()
    for part in program.parts:
        free = part.path.start + np.flatnonzero(lower[part.path] < upper[part.path])
        lower[free], upper[free] = -np.inf, np.inf
    same = np.array_equal(lower, program.row_lower) and np.array_equal(upper, program.row_upper)
    return program if same else replace(program, row_lower=lower, row_upper=upper)


def promising(program: NonlinearProgram, about: Array, count: int, settings: Settings, clock: Clock, *,
              each: int = 4, iterations: int = 10) -> tuple[list[Array], int]:  # fmt: skip
    """Unknowns (n,) to begin at, and the iterations that finding them took.

    Of several times as many places every other one lies about a plan, the rest where inputs drawn at random lead. After
    a few iterations those go on that are best and apart from one another (successive halving): by their cost, beside
    how much the costs differ, and the sum of violations, in sizes of their rows.

    References
    ----------
    Jamieson and Talwalkar, "Non-stochastic best arm identification and hyperparameter optimization", AISTATS 2016.
    """
    short = replace(settings, iterations=min(iterations, settings.iterations), seconds=np.inf)
    found: list[Found] = []
    for seed in range(each * count):
        if clock.late:
            break
        near = shaken(program, seed, about=about, size=(1 + seed) / (each * count), waves=3)
        found.append(once(program, _rolled(program, seed) if seed % 2 else near, None, short))
    costs = np.array([float(program.derivatives.values(one.v)[0]) for one in found])
    apart = float(np.std(costs[np.isfinite(costs)])) if np.isfinite(costs).any() else 0.0
    worth = costs / (apart if apart > 0 else 1.0) + [one.violations.sum() for one in found]
    order = np.argsort(np.where(np.isfinite(worth), worth, np.inf), kind="stable")
    places = np.array([found[i].v / program.scale for i in order])
    return [found[order[i]].v for i in _apart(places)[:count]], sum(one.iterations for one in found)


def _apart(places: Array) -> list[int]:
    """Numbers of places (k, n), those far apart first."""
    away = np.linalg.norm(places[:, None] - places, axis=-1)
    near = np.median(away[np.triu_indices(len(places), 1)]) / 2 if len(places) > 1 else 0.0
    chosen: list[int] = []
    for i in range(len(places)):
        chosen += [i] * bool((away[i, chosen] >= near).all())
    return chosen + [i for i in range(len(places)) if i not in chosen]


def _rolled(program: NonlinearProgram, seed: int) -> Array:
    """Unknowns where slow waves of inputs lead."""
    v = shaken(program, seed, size=1.0, waves=3)
    for part, clock in zip(program.parts, program.times(v)):
        nodes, _, _, inputs = part.unknowns(v)
        u, mesh = inputs[0].T, part.mesh
        x = _led_to(part, nodes[: part.layout.nx, 0], u, clock, v[program.parameters])
        if np.isfinite(x).all():
            path = partial(_between, mesh, x, u)
            v[part.first : part.last] = placed(part.layout, mesh, path)
    return np.clip(v, program.lower, program.upper)


def _led_to(part: PhasePart, first: Array, u: Array, clock: tuple[float, float], p: Array) -> Array:
    """States (N + 1, nx) that inputs (N, nu) lead to by one Runge–Kutta step an interval, within their bounds."""
    phase, (start, length), x = part.phase, clock, [first]

    def rate(z: Array, t: float, held: Array) -> Any:
        """dx/dt, or the next state, at one state, time and input."""
        return evaluated(part.functions.dynamics, phase, z[None], held[None], np.array([t]), p)[0]

    for at, h, held in zip(part.mesh, np.diff(part.mesh), u):
        t = start + length * at
        z = rate(x[-1], t, held) if phase.discrete else runge_kutta(rate, x[-1], t, length * h, [held] * 3)
        x.append(np.clip(z, *phase.x_bounds))
    return np.array(x)


def _between(mesh: Array, x: Array, u: Array, at: Array) -> tuple[Array, Array]:
    """States and inputs at fractions of a phase."""
    return interpolated(at, mesh, x), interpolated(at, mesh[:-1], u)
