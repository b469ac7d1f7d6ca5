"""Discrete models of plants, exact if linear and integrated otherwise."""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import casadi as ca
import numpy as np

from ccdtools.arrays import Array
from ccdtools.exceptions import InputError, JumpWarning, SamplingWarning
from ccdtools.plants.budgets import DEAR_PARTS, MOST_PARTS
from ccdtools.plants.integration_error import IntegrationError, Region, measured_error
from ccdtools.plants.jumps import SMOOTHER, Jump
from ccdtools.plants.linear_model import LinearModel
from ccdtools.plants.matrix_exponential import zero_order_hold
from ccdtools.plants.plant import Plant, linear_matrices
from ccdtools.plants.sampled_model import METHODS, SampledModel
from ccdtools.plants.sampling_guard import warn_of_aliasing, warn_of_growth
from ccdtools.plants.tolerances import ACCURACY
from ccdtools_ground.door import as_choice, as_flag, as_instance, as_positive
from invariant_sets.system_checks import as_set


def discretise(
    plant: Plant,
    dt: float | None = None,
    *,
    method: str = "auto",
    accuracy: float = ACCURACY,
    X: Any = None,
    U: Any = None,
    W: Any = None,
    sampling_guard: str = "warn",
    compiled: bool = False,
) -> LinearModel | SampledModel:
    """Discrete model of a plant, inputs and disturbances held over a sample.

    A plant that is linear in x, u and w, with or without a constant term, has an exact one, symbolic in its design. Any
    other is integrated: by as few Runge–Kutta steps a sample as keep the accuracy over the limits X, U and W and all
    designs, or by collocation where these are not enough. Without X nothing is measured, and a sample is
    `plant.substeps` Runge–Kutta steps.

    A plant whose right-hand side jumps (sign, floor, if_else) is integrated, too, but a sample in which the state
    crosses the jump to first order only, and derivatives leave it out: a `JumpWarning` says so if one is found.

    Parameters
    ----------
    plant : Plant
        Any smooth dependence on p. A discrete plant is taken as it is.
    dt : float, optional
        Sampling time [s]; the plant's own by default.
    method : {"auto", "rk4", "collocation"}
        Of a nonlinear plant: explicit Runge–Kutta of order 4, or Radau IIA collocation of order 5 for stiff ones.
    accuracy : float
        Of a nonlinear plant: largest error of a sample, relative to half the range of each state in X.
    X, U, W : Polytope, or bounds (lower, upper), optional
        Of a nonlinear plant: where the accuracy is asked for. U and W are 0 by default. Each bound is a number for all
        coordinates, or one number each. X and U that depend on the design, functions of p or those of a problem or
        study (`problem.X`), are taken at every design as they are there.
    sampling_guard : {"warn", "ignore"}
        Whether a `SamplingWarning` says that some design has an oscillation near or beyond half the sampling rate, that
        unmeasured Runge–Kutta steps grow what the plant damps, or that the accuracy costs more than a hundred of them.
    compiled : bool
        Of a nonlinear plant: whether steps of many runs are compiled, which takes some seconds once and makes them many
        times as fast.

    Returns
    -------
    LinearModel or SampledModel

    Raises
    ------
    InputError
        If the dynamics of a linear plant are not finite over the whole box of designs, a discrete plant is given
        another `dt`, a set is unbounded or of another dimension, or the accuracy is not reached.

    References
    ----------
    Van Loan, "Computing integrals involving the matrix exponential", IEEE TAC 23(3), 1978, eq. (1.1);
    Moler and Van Loan, "Nineteen dubious ways …, twenty-five years later", SIAM Review 45, 2003, method 3
    (scaling and squaring), after balancing; Hairer and Wanner, "Solving ordinary differential equations II",
    2nd ed., 1996, section IV.5 (Radau IIA).
    """
    as_instance("plant", plant, Plant, "a Plant")
    as_choice("sampling_guard", sampling_guard, ("warn", "ignore"))
    as_choice("method", method, ("auto", *METHODS))
    as_flag("compiled", compiled)
    accuracy = as_positive("accuracy", accuracy)
    dt = as_positive("dt", plant.dt if dt is None else dt, unit="s")
    if not plant.continuous and not math.isclose(dt, plant.dt):
        raise InputError("dt", dt, f"{plant.dt} or nothing", f"The plant is discrete, sampled at {plant.dt} s.")
    region = _region(plant, X, U, W)
    if plant.continuous and sampling_guard == "warn":
        warn_of_aliasing(plant, dt, None if region is None else region.centre)
    if plant.linear:
        return _exact(plant, dt)
    boxes = () if region is None else region.boxes[:3]
    jump = plant.switches.within(boxes, (plant.design.lower, plant.design.upper))
    if not plant.continuous:
        model = SampledModel(plant, dt)
    elif region is None:
        chosen = "rk4" if method == "auto" else method
        if chosen == "rk4" and sampling_guard == "warn":
            warn_of_growth(plant, dt)
        model = SampledModel(plant, dt, chosen, plant.substeps)
    else:
        model = _accurate(plant, dt, METHODS if method == "auto" else (method,), accuracy, region, jump)
        if model.parts > DEAR_PARTS and sampling_guard == "warn":
            warnings.warn(_cost_text(model, accuracy, region), SamplingWarning, stacklevel=2)
    model = replace(model, compiled=compiled)
    if jump is not None:
        model = replace(model, jump=_jump_text(plant, jump))
        warnings.warn(f"{model.jump}. {SMOOTHER}", JumpWarning, stacklevel=2)
    return model


def _jump_text(plant: Plant, jump: Jump) -> str:
    """Text on the accuracy lost at a jump, and where."""
    parts = {"x": jump.x, "u": jump.u, "w": jump.w}
    place = ", ".join(f"{name} = {(value.round(6) + 0.0).tolist()}" for name, value in parts.items())
    first = "a sample in which the state crosses it is integrated to first order only, and " if plant.continuous else ""
    return (
        f"the dynamics of {plant.state_names[jump.row]} jump ({', '.join(jump.names)}), such as at {place}: {first}"
        "derivatives, and with them the linearisation that LQR and MPC use, leave the jump out"
    )


def _exact(plant: Plant, dt: float) -> LinearModel:
    """Model of a linear plant."""
    A, B, E, constant = linear_matrices(plant)
    if plant.continuous:
        A, B, both = zero_order_hold(A, B, ca.horzcat(E, constant), dt, symbols=plant.p, design=plant.design)
        E, constant = both[:, :-1], both[:, -1]
    return LinearModel(plant.p, A, B, E, dt, plant.design, constant, plant.state_names, plant.input_names)


def _region(plant: Plant, X: Any, U: Any, W: Any) -> Region | None:
    """Region where a nonlinear plant is to be accurate; None if unstated."""
    if X is None:
        if U is not None or W is not None:
            raise InputError("X", "nothing, beside limits of u or w", "limits of the states too")
        return None
    X, U = (_of_design(name, value, plant) for name, value in (("X", X), ("U", U)))
    boxes = [_box("X", X, plant.nx), _box("U", U, plant.nu), _box("W", W, plant.nw)]
    of_design = tuple(value if _narrows(value) else None for value in (X, U))
    region = Region.of(*boxes, (plant.design.lower, plant.design.upper), of_design=of_design)  # type: ignore[arg-type]
    flat = np.flatnonzero(region.extent <= 0)
    if len(flat):
        raise InputError("X", f"no width in {plant.state_names[flat[0]]}", "limits with a width for every state")
    return region


@dataclass(frozen=True, eq=False)
class _OfDesign:
    """Bounds of a function of p, as numbers."""

    function: Callable[[Array], Any]
    box: tuple[Array, Array]  # the widest that were seen over the box of designs

    def bounds(self, p: Array) -> tuple[Array, Array]:
        """Bounds (m, n) or (m, 1) at designs (m, np)."""
        pairs = [[np.asarray(ca.DM(end), dtype=float).ravel() for end in self.function(design)] for design in p]
        lower, upper = zip(*pairs, strict=True)
        return np.stack(lower), np.stack(upper)


def _of_design(name: str, value: Any, plant: Plant) -> Any:
    """Bounds at each design of a function of p; others as given."""
    if not callable(value) or isinstance(value, type):
        return value
    try:
        lower, upper = _OfDesign(value, (np.empty(0), np.empty(0))).bounds(plant.design.spread())
        return _OfDesign(value, (lower.min(axis=0), upper.max(axis=0)))
    except (TypeError, ValueError, IndexError, AttributeError, NotImplementedError) as error:
        expected = "a function of p that returns (lower, upper)"
        raise InputError(name, f"a function that fails: {error}", expected) from error


def _box(name: str, value: Any, size: int) -> tuple[Array, Array]:
    """Bounds (size,) of a set; zeros where there is none."""
    if value is None or size == 0:
        return np.zeros(size), np.zeros(size)
    limits = as_set(value.box if _narrows(value) else value, name, size)
    if limits.is_empty or not np.isfinite(np.concatenate(limits.bounding_box())).all():
        raise InputError(name, "an empty or unbounded set", "a bounded one with at least one point")
    return limits.bounding_box()


def _narrows(value: Any) -> bool:
    """Whether limits depend on the design."""
    return hasattr(value, "bounds") and hasattr(value, "box") and not isinstance(value, type)


def _accurate(
    plant: Plant, dt: float, methods: Any, accuracy: float, region: Region, jump: Jump | None
) -> SampledModel:
    """Cheapest of the methods that keeps the accuracy."""
    best: tuple[float, str, int] = (math.inf, "", 0)
    lost: list[str] = []
    for method in methods:
        parts = 1
        while parts <= MOST_PARTS[method]:
            error = _error(plant, dt, method, parts, region, enough=accuracy)
            if error.relative <= accuracy:
                low = parts // 2 if method == "rk4" else parts - 1
                while parts - low > max(1, parts // 64):  # about the fewest Runge–Kutta parts that keep the accuracy
                    middle = (low + parts) // 2
                    found = _error(plant, dt, method, middle, region, enough=accuracy)
                    if found.relative <= accuracy:
                        parts, error = middle, found
                    else:
                        low = middle
                return SampledModel(plant, dt, method, parts, error, region.extent)
            best = min(best, (error.relative, method, parts))
            parts *= 2
        if not math.isfinite(error.relative):
            why = "steps grow beyond all numbers" if method == "rk4" else "Newton's method does not converge"
            lost.append(f"{method}: {why} at {_place(plant, error)}")
    reached = "nothing is reached"
    cure = "Shorten dt, or narrow X, U and W to where the plant is smooth."
    error = _error(plant, dt, *best[1:], region) if best[1] else error
    if math.isfinite(error.relative):
        reached = f"{error.relative:.4g} is reached (worst at {_place(plant, error)})"
        cure = f"Take accuracy={1.1 * error.relative:.2g}. Or {cure[0].lower()}{cure[1:]}"
    got = "; ".join([f"{accuracy:g}, where {reached}", *lost])
    if jump is not None:
        got += f"; {_jump_text(plant, jump)}"
        cure = f"{SMOOTHER} Or allow a larger error."
    raise InputError("accuracy", got, "a larger error", cure)


def _cost_text(model: SampledModel, accuracy: float, region: Region) -> str:
    """Text on the parts that an accuracy takes, and the accuracy that a quarter of them has."""
    fewer = max(1, model.substeps // 4)
    coarse = _error(model.plant, model.dt, model.method, fewer, region)
    own = "" if model.method == "rk4" else f"{model.substeps} parts by collocation, as long as "
    parts = f"{model.parts} Runge–Kutta parts a sample"
    less = f"{fewer} reach {coarse.relative:.2g}" if math.isfinite(coarse.relative) else f"{fewer} do not suffice"
    return (
        f"dt = {model.dt:g} s takes {own}{parts} at accuracy={accuracy:g}; {less}. "
        f"Hardest is {_place(model.plant, coarse)}: narrow X, U and W if the plant does not go there, or shorten dt."
    )


def _error(
    plant: Plant, dt: float, method: str, parts: int, region: Region, *, enough: float = math.inf
) -> IntegrationError:
    """Integration error of a step of `parts` parts."""
    coarse, fine = (SampledModel(plant, dt, method, n, scale=region.extent) for n in (parts, 2 * parts))
    return measured_error(coarse.advance, fine.advance, region, enough=enough)


def _place(plant: Plant, error: IntegrationError) -> str:
    """Text on where an error is largest."""
    parts = {"x": error.x, "u": error.u, "w": error.w}
    return ", ".join([*(f"{name} = {v.round(6).tolist()}" for name, v in parts.items() if v.size),
                      *([plant.design.describe(error.p)] if plant.design.dim else [])])  # fmt: skip
