"""Stated outputs y = h(x, u, p) as functions, with slopes in x."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np

from ccdtools.arrays import Array
from ccdtools.estimation.tolerances import DIFFERENCE_STEP, LEAST_DIFFERENCE_STEP
from ccdtools.exceptions import InputError
from ccdtools.plants.casadi_arrays import Vectorised
from ccdtools.plants.plant import Plant
from ccdtools.plants.sampled_model import SampledModel
from ccdtools_ground.door import as_array, as_floats, shown
from ccdtools_ground.operations import bent_rows

FROM_STATE_AND_INPUT = ("u", "p")  # what a function may ask for by name besides the state
LINEARISED = "Linearise it: linearise(plant, equilibrium(plant, p)); or use a CubatureKalmanFilter."
EXPECTED = "a matrix C (ny, nx), a Plant with outputs, or a function h(x), which may also ask for u and p"


@dataclass(frozen=True, eq=False)
class Output:
    """Output y = h(x, u) at one design, with its slope."""

    of: Callable[[Array, Array], Array]  # outputs (n, ny) of states (n, nx) and inputs (n, nu)
    # ∂h/∂x (ny, nx) or (n, ny, nx) there, with standard deviations (n, nx) of x
    slope: Callable[[Array, Array, Array], Array]


def _of_plant(plant: Plant, p: Array) -> Output:
    """Outputs of a plant at one design, differentiated."""
    given = [plant.x, plant.u, plant.p]
    value = Vectorised(ca.Function("y", given, [ca.densify(plant.outputs)]))
    slopes = ca.vec(ca.jacobian(plant.outputs, plant.x))
    columns = Vectorised(ca.Function("H", given, [ca.densify(slopes)]))

    def slope(x: Array, u: Array, spread: Array) -> Array:
        """Slope (n, ny, nx)."""
        return np.asarray(columns(x, u, p).reshape(len(x), plant.nx, plant.ny).swapaxes(1, 2))

    return Output(lambda x, u: np.asarray(value(x, u, p)), slope)


def _of_function(function: Callable[..., Any], p: Array) -> Output:
    """Output as a function of arrays, with slopes by central differences, 0 along exactly known states."""
    asks = asked_of(function)

    def value(x: Array, u: Array) -> Array:
        """Outputs (n, ny)."""
        given = {"u": u, "p": p}
        y = as_floats("output", function(x, **{name: given[name] for name in asks}))
        if y.ndim != 2 or len(y) != len(x) or y.shape[1] == 0:
            cure = "It is called with all states at once: x[:, 0] is the first of each run."
            raise InputError("output", f"outputs of shape {y.shape} for states {x.shape}", f"({len(x)}, ny)", cure)
        return y

    def slope(x: Array, u: Array, spread: Array) -> Array:
        """Slope (n, ny, nx)."""
        n, nx = x.shape
        steps = np.where(spread > 0, np.maximum(DIFFERENCE_STEP * spread, LEAST_DIFFERENCE_STEP * np.abs(x)), 0.0)
        moved = steps[:, None, :] * np.eye(nx)
        up, down = x[:, None, :] + moved, x[:, None, :] - moved
        inputs = np.repeat(u, nx, axis=0)
        rise = value(up.reshape(-1, nx), inputs) - value(down.reshape(-1, nx), inputs)
        run = np.einsum("nii->ni", up - down)
        columns = rise.reshape(n, nx, -1) / np.where(run > 0, run, 1.0)[:, :, None]
        return np.asarray(columns.swapaxes(1, 2))

    return Output(value, slope)


def as_stated_output(value: Any) -> Any:
    """Outputs as stated: a read-only matrix, a Plant or a function.

    Raises
    ------
    InputError
        If it is none of these, a plant without outputs, or a function that asks for something else.
    """
    if isinstance(value, SampledModel):
        value = value.plant
    if isinstance(value, Plant):
        if value.ny == 0:
            raise InputError("output", "a plant without outputs", EXPECTED, "Plant(outputs=…) names them.")
        return value
    if callable(value) and not isinstance(value, type):
        asked_of(value)
        return value
    if value is None or isinstance(value, type | str):
        raise InputError("output", shown(value), EXPECTED)
    return as_array("output", value, ("ny", "nx"))


def asked_of(function: Callable[..., Any]) -> tuple[str, ...]:
    """Names, of u and p, that a function asks for besides x."""
    try:
        parameters = list(inspect.signature(function).parameters.values())
    except (TypeError, ValueError):  # a callable in C need not have a signature
        return ()
    rest = parameters[1:]
    unknown = [q for q in rest if q.name not in FROM_STATE_AND_INPUT and q.default is q.empty
               and q.kind not in (q.VAR_POSITIONAL, q.VAR_KEYWORD)]  # fmt: skip
    if not parameters or parameters[0].kind is parameters[0].KEYWORD_ONLY or unknown:
        names = ", ".join(q.name for q in parameters)
        raise InputError("output", f"a function of ({names})", "one of x, which may also ask for u and p by name")
    return tuple(q.name for q in rest if q.name in FROM_STATE_AND_INPUT)


def output_at(stated: Any, nx: int, nu: int, p: Array) -> Output:
    """Outputs of a plant at one design (np,).

    Raises
    ------
    InputError
        If the sizes disagree, or the design is none of the plant whose outputs they are.
    """
    check_sizes(stated, nx, nu)
    if isinstance(stated, Plant):
        return _of_plant(stated, stated.design.check_one(p))
    if callable(stated):
        return _of_function(stated, p)
    return Output(lambda x, u: x @ stated.T, lambda x, u, spread: stated)


def linear_outputs(plant: Plant) -> bool:
    """Whether a plant's outputs are linear in x and u."""
    z = ca.vertcat(plant.x, plant.u)
    return not bent_rows(plant.outputs, z)


def output_matrices(plant: Plant, p: Array) -> tuple[Array, Array, Array]:
    """Matrices C (ny, nx), D (ny, nu) and y0 (ny,) of linear outputs.

    Raises
    ------
    InputError
        If there are none, or they are not linear in x and u.
    """
    as_stated_output(plant)
    z = ca.vertcat(plant.x, plant.u)
    slope = ca.jacobian(plant.outputs, z)
    if not linear_outputs(plant):
        raise InputError("plant", "outputs that are not linear in x and u", "linear ones", LINEARISED)
    rest = ca.Function("rest", [z, plant.p], [ca.densify(plant.outputs)])(np.zeros(z.shape), p)
    both = np.asarray(ca.Function("both", [plant.p], [ca.densify(slope)])(p), dtype=float)
    return both[:, : plant.nx], both[:, plant.nx :], np.asarray(rest, dtype=float).ravel()


def check_sizes(stated: Any, nx: int, nu: int) -> None:
    """Raise an `InputError` unless matrix or plant sizes fit."""
    if isinstance(stated, Plant) and (stated.nx, stated.nu) != (nx, nu):
        got = f"outputs of a plant of {stated.nx} states and {stated.nu} inputs"
        raise InputError("output", got, f"those of one of {nx} states and {nu} inputs")
    if isinstance(stated, np.ndarray):
        as_array("output", stated, ("ny", nx))
