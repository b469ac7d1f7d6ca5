"""Phases with algebraic variables, stated as phases without."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import casadi as ca
import numpy as np

from ccdtools_ground.algebraic import solved
from mpc.exceptions import InputError
from mpc.optimal_control.interval import first_guess
from mpc.optimal_control.phase import Phase, PhaseFunctions
from mpc.optimal_control.pieces import kind_of


def collocated(phase: Phase, parameters: int) -> Phase:
    """Phase with z as its last inputs and g = 0 along the path."""
    f, nu, nz = PhaseFunctions(phase, parameters), phase.inputs, phase.algebraics
    columns, values = _expressions(f)
    v = type(columns["u"]).sym("u", nu + nz)
    found = ca.substitute(list(values.values()), [columns["u"], columns.pop("z")], ca.vertsplit(v, [0, nu, nu + nz]))
    values = dict(zip(values, found))
    values["path"] = ca.vertcat(*(values[name] for name in ("path", "algebraic") if name in values))
    times = np.array([0.0, 1.0]) if phase.guess is None else phase.guess[0]
    x, u = first_guess(phase)(times)
    free = np.full(nz, np.inf)
    return replace(
        phase, **_functions(columns | {"u": v}, values), inputs=nu + nz,
        path_bounds=tuple(np.append(side, 0 * phase.z_guess) for side in f.path_bounds),
        path_names=(*f.path_names, *(f"algebraic equation {i + 1}" for i in range(nz))),
        path_prices=tuple(np.append(prices, free) for prices in f.path_prices),
        u_bounds=tuple(np.append(side, far) for side, far in zip(phase.u_bounds, (-free, free))),
        input_names=(*phase.input_names, *(f"z{i + 1}" for i in range(nz))),
        guess=(times, x, np.hstack([u, np.tile(phase.z_guess, (len(times), 1))])),
    )  # fmt: skip


def eliminated(phase: Phase, parameters: int, *, looped: bool = False) -> Phase:
    """Phase in which z is an expression of the other columns; see `solved`."""
    f = PhaseFunctions(phase, parameters, looped=looped)
    columns, values = _expressions(f)
    z = columns.pop("z")
    if not isinstance(z, ca.SX):
        cure = "Collocation of a phase takes z as unknowns, whatever the functions are."
        raise InputError("algebraic", "functions without scalar instructions", "functions of SX", cure)
    found = ca.substitute(list(values.values()), [z], [solved(values["algebraic"], z, phase.z_guess)])
    return replace(phase, **_functions(columns, dict(zip(values, found))), algebraics=0, z_guess=0.0)


def _expressions(f: PhaseFunctions) -> tuple[dict[str, Any], dict[str, Any]]:
    """Symbols by name, and the values of what may know z in them."""
    stated = {"dynamics": f.dynamics, "stage_cost": f.stage_cost, "path": f.path, "algebraic": f.algebraic}
    given = {name: function for name, function in stated.items() if function is not None}
    kind, columns = kind_of(*given.values()), dict[str, Any]()
    for function in given.values():
        columns |= {name: kind.sym(name, function.numel_in(i)) for i, name in enumerate(function.name_in())}
    return columns, {
        name: function(*(columns[one] for one in function.name_in())) for name, function in given.items()
    }  # fmt: skip


def _functions(columns: dict[str, Any], values: dict[str, Any]) -> dict[str, Any]:
    """Values as functions of those columns that they depend on."""
    made: dict[str, Any] = {"algebraic": None}
    for name, value in values.items():
        own = {one: column for one, column in columns.items() if ca.depends_on(value, column)}
        if name != "algebraic":
            made[name] = ca.Function(name, list(own.values()), [value], list(own), ["value"])
    return made
