"""Checks of a co-design problem."""

from __future__ import annotations

from typing import Any

import numpy as np

from ccdtools.design_limits import DesignLimits, Limits, as_limits_over
from ccdtools.exceptions import InputError
from ccdtools.plants.design_space import DesignSpace
from ccdtools.plants.tolerances import FEASIBLE
from ccdtools_ground.door import has_method

NARROWEST = 1e-5  # A box of designs is too narrow below this part of its bounds: float32 resolves 1e-7.


def check_inputs(problem: Any) -> None:
    """Raise an `InputError` if U is too wide."""
    (lower, upper), (low, high) = problem.input_bounds, problem.model.input_bounds
    lowest, highest = np.float32(low), np.float32(high)  # environments have them in single precision
    if (np.float32(lower) < lowest).any() or (np.float32(upper) > highest).any():
        expected = f"bounds within {low} and {high}, which the simulator takes"
        raise InputError("U", f"inputs from {lower} to {upper}", expected)


def check_over_designs(problem: Any) -> None:
    """Raise an `InputError` unless designs have finite costs and weights for LQR and MPC."""
    designs = problem.design.spread()
    designs = designs[problem.design.violation(designs) <= FEASIBLE]
    cost = np.broadcast_to(problem.objective.cost_of_design(designs, problem.steps), len(designs))
    wrong = np.flatnonzero(~np.isfinite(cost))
    if len(wrong):
        got = f"{cost[wrong[0]]:g} at {problem.design.describe(designs[wrong[0]])}"
        cure = "Move the bounds of the design."
        raise InputError("objective.design_cost", got, "a finite number over the whole design box", cure)
    for p in designs:
        problem.weights(p)


def check_discrepancy(problem: Any) -> None:
    """Raise an `InputError` unless `discrepancy` models this model's error."""
    if problem.discrepancy is None:
        return
    has_method("discrepancy", problem.discrepancy, "penalty", "a Discrepancy or None")
    size = np.shape(problem.discrepancy.weight)
    if size != (problem.model.nx, problem.model.nx):
        raise InputError("discrepancy", f"a weight of shape {size}", f"({problem.model.nx}, {problem.model.nx})")


def check_measurement(problem: Any) -> None:
    """Raise an `InputError` unless states are left to see, and a filter of the `measurement` can be made."""
    if problem.hidden >= problem.model.nx:
        raise InputError("hidden", problem.hidden, f"less than {problem.model.nx}, the states of the model")
    if problem.measurement is None:
        return
    has_method("measurement", problem.measurement, "drawn", "a Measurement(output, noise=…) or None")
    if not problem.measurement.random:
        got = "one without noise" if problem.measurement.noise is None else "recorded noise, the same in every episode"
        raise InputError("measurement", got, "Measurement(output, noise=…) of deviations or a Disturbance")
    if problem.discrepancy is not None:
        raise InputError("discrepancy", "a learned error beside a measurement", "one or the other")
    from ccdtools.co_design.measured import kalman_filter  # estimation is loaded where it is asked for

    try:
        kalman_filter(problem, problem.design.project(problem.design.centre))
    except InputError as error:
        raise InputError(f"measurement, {error.argument}", error.got, error.expected, error.cure) from None


def check_widths(design: DesignSpace) -> None:
    """Raise an `InputError` if single precision cannot tell the designs apart."""
    size = np.maximum(np.abs(design.lower), np.abs(design.upper))
    narrow = np.flatnonzero(design.free & (design.upper - design.lower < NARROWEST * size))
    if len(narrow):
        i = narrow[0]
        raise InputError(
            "model", f"{design.names[i]} in [{design.lower[i]:.10g}, {design.upper[i]:.10g}]",
            f"a box of designs at least {NARROWEST:g} times as wide as its bounds are large",
            "Let the parameter be the deviation from its lower bound.",
        )  # fmt: skip


def bounded_limits(name: str, value: Any, size: int, of: str, space: DesignSpace) -> Limits:
    """Bounded limits of that dimension, else an `InputError`."""
    limits = as_limits_over(name, value, size, of, space)
    if isinstance(limits, DesignLimits):
        return limits
    if limits.is_empty:
        raise InputError(name, "an empty set", "one with at least one point")
    if not np.isfinite(np.concatenate(limits.bounding_box())).all():
        raise InputError(name, "an unbounded set", "a bounded one")
    return limits
