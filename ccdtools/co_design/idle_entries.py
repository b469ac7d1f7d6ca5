"""Design entries without effect, alone or together.

Whatever value they end at would be no result.

References
----------
Jacquez and Greif, "Numerical parameter identifiability and estimability", Mathematical Biosciences 77, 1985 (the rank
of the sensitivities at random parameters).
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import casadi as ca
import numpy as np

from ccdtools.arrays import Array
from ccdtools.co_design.budgets import DISTURBED_RUNS, TERM_POINTS
from ccdtools.co_design.tolerances import ACT_TOGETHER, IDLE_PART, MAGNITUDES, TERM_ROUNDING
from ccdtools.design_limits import DesignLimits
from ccdtools.exceptions import InputError
from ccdtools.plants.design_space import DesignSpace
from ccdtools.plants.plant import Plant
from ccdtools.plants.sampled_model import SampledModel
from ccdtools.plants.simulated_model import SimulatedModel

EXPECTED = "entries that change the dynamics, a cost, a limit, a constraint or a measured output"
CURE = "Remove it from the DesignSpace, or state what it acts on."
UNDISTURBED = "Give the scenarios a disturbance, or remove it from the DesignSpace."


def check_every_entry_acts(problem: Any) -> None:
    """Raise an `InputError` that names free entries without effect.

    An entry acts if a term depends on it by its expression and takes another value at another design, at one of 500
    states within ten times X, with inputs within ten times U. One that scales nothing but a disturbance does not act
    where that is always zero. Of a simulator or with a Python function as sensor nothing is said.
    """
    sensed = callable(getattr(problem.measurement, "output", None))
    if sensed or isinstance(problem.model, SimulatedModel):  # what it does with an entry is not known
        return
    free = np.flatnonzero(problem.design.free)
    undisturbed = _idle(problem, free, disturbance=0.0)
    idle = _idle(problem, undisturbed, disturbance=1.0)
    if len(idle):
        raise InputError("model.design", f"{_named(problem, idle)}, which nothing depends on", EXPECTED, CURE)
    if len(undisturbed) and problem.discrepancy is None and not _disturbance(problem, DISTURBED_RUNS).any():
        got = f"{_named(problem, undisturbed)}, which nothing depends on but what a disturbance of zero does"
        raise InputError("model.design", got, EXPECTED, UNDISTURBED)


def acting_together(problem: Any) -> str:
    """Design entries that can change together without effect; empty if none.

    Slopes of the dynamics, costs, limits and constraints by the design are compared at random states, inputs and
    disturbances. Of a problem with learned errors nothing is said.
    """
    space = problem.design
    if np.sum(space.free) < 2 or problem.discrepancy is not None or isinstance(problem.model, SimulatedModel):
        return ""
    rng = np.random.default_rng(0)
    width = space.upper - space.lower  # of a fixed entry zero
    extents = _extents(problem, np.abs(_disturbance(problem, DISTURBED_RUNS)).max(axis=(0, 1), initial=0.0))
    slopes = [_slopes(term) for term in _terms(problem, extents)]
    designs = space.latin_hypercube(3, rng)  # the one where fewest entries act together tells
    rows = ([_rows(one, p, extents, rng) for one in slopes] for p in designs)
    fewest = min((_without_effect(np.concatenate(found) * width) for found in rows), key=len)
    part = np.flatnonzero(np.abs(fewest).max(axis=0, initial=0.0) > IDLE_PART)
    if not len(part):
        return ""
    free = len(fewest)
    return (f"{', '.join(space.names[i] for i in part)} act only together, in {len(part) - free} of {len(part)} "
            f"directions: other values of them are as good. Fix {free} of them, or let each have a price.")  # fmt: skip


def _idle(problem: Any, entries: Any, *, disturbance: float) -> Any:
    """Given entries that change no term, with disturbances of one size."""
    extents = _extents(problem, disturbance)
    for term in _terms(problem, extents):
        entries = entries[~_acting(term, problem.design, entries, extents)] if len(entries) else entries
    return entries


def _terms(problem: Any, extents: dict[str, Any]) -> Iterator[ca.Function]:
    """Functions that the design may enter as `p` or alone; of a linear model [A B E], columns times extents."""
    model = problem.model
    nx, nu, dim = model.nx, model.nu, model.design.dim
    if isinstance(model, SampledModel):
        yield model.plant.right_hand_side
    else:
        p = ca.MX.sym("p", dim)
        scale = np.r_[extents["x"], extents["u"], np.broadcast_to(extents["w"], model.nw)]
        yield ca.Function("matrices", [p], [model.function(p) @ ca.diag(ca.DM(scale))])
    for limits in (problem.X, problem.U):
        if isinstance(limits, DesignLimits):
            yield limits.both.function(dim)
    for name, sizes in (("design_cost", (dim,)), ("stage_cost", (nx, nu, dim)), ("terminal_cost", (nx, dim))):
        if getattr(problem.objective, name, None) is not None:
            yield getattr(problem.objective, name).function(*sizes)
    if problem.output_limits is not None:
        yield problem.output_limits.outputs.function(nx, nu, dim)
    if isinstance(getattr(problem.measurement, "output", None), Plant):
        yield problem.measurement.output.output
    if model.design.constraints is not None:
        yield model.design.constraints


def _acting(term: ca.Function, space: DesignSpace, entries: Any, extents: dict[str, Any]) -> Any:
    """Whether each entry changes a term."""
    place = _names(term).index("p")
    acting = np.isin(entries, term.jac_sparsity(0, place).get_triplet()[1])
    rng = np.random.default_rng(0)
    for count in TERM_POINTS:
        designs = space.latin_hypercube(count, rng)
        others = space.latin_hypercube(count, rng)
        given = _drawn(term, designs, extents, rng)
        before = np.asarray(term(*given), dtype=float)
        size = TERM_ROUNDING * np.max(np.abs(before), axis=1, initial=0.0, where=np.isfinite(before), keepdims=True)
        found = np.zeros(len(entries), dtype=bool)
        for k in np.flatnonzero(acting):
            moved = designs.copy()
            moved[:, entries[k]] = others[:, entries[k]]
            after = np.asarray(term(*given[:place], moved.T, *given[place + 1 :]), dtype=float)
            found[k] = not (np.abs(after - before) <= size).all()  # also where one is not a number
        if (found == acting).all():
            break
    return found


def _slopes(term: ca.Function) -> ca.Function:
    """Function for the slopes (rows, np) of a term by the design."""
    names = _names(term)
    given = [ca.MX.sym(name, term.size1_in(i)) for i, name in enumerate(names)]
    slopes = ca.jacobian(ca.vec(term(*given)), given[names.index("p")])
    return ca.Function("slopes", given, [ca.densify(slopes)], names, ["slopes"])


def _rows(slopes: ca.Function, p: Array, extents: dict[str, Any], rng: np.random.Generator) -> Array:
    """Slopes (n, np) of a term at a design (np,) and random points."""
    count = 100 if slopes.n_in() > 1 else 1
    found = np.asarray(slopes(*_drawn(slopes, np.tile(p, (count, 1)), extents, rng)), dtype=float)
    rows = np.concatenate(np.split(found, count, axis=1))
    rows = rows[np.isfinite(rows).all(axis=1)]
    size = np.abs(rows).max(axis=1, initial=0.0)
    return np.asarray(rows[size > TERM_ROUNDING * size.max(initial=0.0)])


def _without_effect(rows: Array) -> Array:
    """Unit directions (k, np) of zero slope in slopes (n, np)."""
    acting = np.flatnonzero(rows.any(axis=0))
    scaled = rows[:, acting] / np.abs(rows).max(axis=1, keepdims=True)
    scaled /= np.linalg.norm(scaled, axis=0)
    sizes, directions = np.linalg.eigh(scaled.T @ scaled)
    found = np.zeros((int(np.sum(sizes <= ACT_TOGETHER**2)), rows.shape[1]))
    found[:, acting] = directions[:, : len(found)].T
    return found


def _drawn(term: ca.Function, designs: Array, extents: dict[str, Any], rng: np.random.Generator) -> list[Array]:
    """Random arguments of a term, one column per design, within ten times their extents."""
    given = []
    for i, name in enumerate(_names(term)):
        size = np.broadcast_to(extents.get(name, 1.0), term.size1_in(i))[:, None]
        shape = (len(size), len(designs))
        random = size * 10.0 ** rng.uniform(*MAGNITUDES, shape) * rng.choice([-1.0, 1.0], shape)
        given.append(designs.T if name == "p" else random)
    return given


def _names(term: ca.Function) -> list[str]:
    """Names of the arguments of a term."""
    return list(term.name_in()) if term.n_in() > 1 else ["p"]


def _named(problem: Any, entries: Any) -> str:
    """Entries of a design by their names."""
    return f"the entr{'y' if len(entries) == 1 else 'ies'} {', '.join(problem.design.names[int(i)] for i in entries)}"


def _disturbance(problem: Any, runs: int) -> Array:
    """Disturbance (runs, steps, nw) of some runs."""
    return np.asarray(problem.scenarios.sample(runs, problem.steps, np.random.default_rng(0))[1])


def _extents(problem: Any, disturbance: Any) -> dict[str, Any]:
    """Largest size of each state, input and disturbance, without errors that are added to states."""
    model = problem.model
    entering = np.atleast_1d(disturbance)[: model.plant.nw] if isinstance(model, SampledModel) else disturbance
    return {"x": problem.state_scale, "u": np.max(np.abs(problem.input_bounds), axis=0), "w": entering}
