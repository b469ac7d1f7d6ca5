"""Entries of the design that change nothing: whatever value they end at would be no result."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import casadi as ca
import numpy as np

from ccdtools.arrays import Array
from ccdtools.design_limits import DesignLimits, Limits, widest
from ccdtools.exceptions import InputError
from ccdtools.output_limits import OutputLimits
from ccdtools.plants.design_space import DesignSpace
from ccdtools.plants.models import Model
from ccdtools.plants.sampled_model import SampledModel

POINTS = (8, 500)  # states, inputs and disturbances that a term is looked at: a few, and where nothing changes many
ROUNDING = 1e-12  # of the largest value of a term: a change this small is rounding
EXPECTED = "entries that change the dynamics, a cost, a limit or a constraint"
CURE = "Remove it from the DesignSpace, or state what it acts on."


def check_every_entry_acts(
    model: Model, X: Limits, U: Limits, objective: Any, output_limits: OutputLimits | None
) -> None:
    """Raise an `InputError` that names the entries of the design that are not fixed and change nothing.

    An entry acts if a term depends on it by its expression and takes another value at another design, at one of 500
    states within ten times X, with inputs within ten times U.
    """
    space = model.design
    assert space is not None
    idle = np.flatnonzero(space.free)
    extents = {"x": _extent(X), "u": _extent(U)}
    for term in _terms(model, X, U, objective, output_limits):
        idle = idle[~_acting(term, space, idle, extents)] if len(idle) else idle
    if len(idle):
        names = ", ".join(space.names[int(i)] for i in idle)
        kind = "entry" if len(idle) == 1 else "entries"
        raise InputError("model.design", f"the {kind} {names}, which nothing depends on", EXPECTED, CURE)


def _terms(model: Model, X: Limits, U: Limits, objective: Any, outputs: OutputLimits | None) -> Iterator[ca.Function]:
    """The functions that the design may enter; its argument is called p, or is the only one."""
    nx, nu, dim = model.nx, model.nu, model.design.dim  # type: ignore[union-attr]
    yield model.plant.right_hand_side if isinstance(model, SampledModel) else model.step
    for limits in (X, U):
        if isinstance(limits, DesignLimits):
            yield limits.both.function(dim)
    for name, sizes in (("design_cost", (dim,)), ("stage_cost", (nx, nu, dim)), ("terminal_cost", (nx, dim))):
        if getattr(objective, name, None) is not None:
            yield getattr(objective, name).function(*sizes)
    if outputs is not None:
        yield outputs.outputs.function(nx, nu, dim)
    if model.design.constraints is not None:  # type: ignore[union-attr]
        yield model.design.constraints  # type: ignore[union-attr]


def _acting(term: ca.Function, space: DesignSpace, entries: Any, extents: dict[str, Array]) -> Any:
    """Whether each of some entries changes a term."""
    names = term.name_in() if term.n_in() > 1 else ["p"]
    place = names.index("p")
    acting = np.isin(entries, term.jac_sparsity(0, place).get_triplet()[1])
    rng = np.random.default_rng(0)
    for count in POINTS:
        designs = space.latin_hypercube(count, rng)
        others = space.latin_hypercube(count, rng)
        sizes = [extents.get(name, np.ones(term.size1_in(i))) for i, name in enumerate(names)]
        given = [designs.T if name == "p" else 10.0 * rng.uniform(0, 1, count) * size[:, None]
                 * rng.uniform(-1, 1, (len(size), count)) for name, size in zip(names, sizes)]  # fmt: skip
        before = np.asarray(term(*given), dtype=float)
        size = ROUNDING * np.max(np.abs(before), axis=1, initial=0.0, where=np.isfinite(before), keepdims=True)
        found = np.zeros(len(entries), dtype=bool)
        for k in np.flatnonzero(acting):
            moved = designs.copy()
            moved[:, entries[k]] = others[:, entries[k]]
            after = np.asarray(term(*given[:place], moved.T, *given[place + 1 :]), dtype=float)
            found[k] = not (np.abs(after - before) <= size).all()  # also where one is not a number
        if (found == acting).all():
            break
    return found


def _extent(limits: Limits) -> Array:
    """Largest size of each coordinate within limits."""
    return np.max(np.abs(widest(limits).bounding_box()), axis=0)
