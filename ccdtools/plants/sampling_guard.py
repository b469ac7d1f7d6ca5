"""Oscillations that a sampling time does not resolve."""

from __future__ import annotations

import itertools
import math
import warnings
from collections.abc import Callable
from typing import Any

import casadi as ca
import numpy as np
from scipy.optimize import minimize

from ccdtools.arrays import Array
from ccdtools.exceptions import SamplingWarning
from ccdtools.plants.design_space import DesignSpace
from ccdtools.plants.plant import Plant
from ccdtools.plants.tolerances import EXACT, RESOLVED_SHARE


def fastest_mode(A: Callable[[Array], Any], design: DesignSpace, dt: float) -> tuple[float, Array]:
    """Frequency of the fastest oscillation, and its design.

    Damped [Hz], of ẋ = A(p) x over the box of designs; 0 where nothing oscillates.
    """

    def frequency(v: Array) -> float:
        """Fastest damped frequency [Hz] at a unit-box point."""
        matrix = np.asarray(A(design.from_unit(v)), dtype=float)
        if not np.isfinite(matrix).all():  # said elsewhere, with the design
            return 0.0
        modes = np.linalg.eigvals(matrix)
        living = modes[modes.real * dt > math.log(0.01)]  # what falls below 1 % within a sample is not aliased
        return float(np.abs(living.imag).max(initial=0.0)) / (2 * np.pi)

    points = design.to_unit(design.spread())
    values = [frequency(v) for v in points]
    fastest = points[int(np.argmax(values))]
    found = max(values)
    if design.dim:
        bounds = [(0.0, 1.0)] * design.dim
        search = minimize(lambda v: -frequency(v), fastest, method="Nelder-Mead", bounds=bounds,
                          options={"maxfev": 60 * design.dim})  # fmt: skip
        if -search.fun > found:
            fastest = search.x
            found = -float(search.fun)
    return found, design.from_unit(fastest)


def sampling_note(plant: Plant, dt: float | None = None, x: Array | None = None) -> str:
    """Note on oscillations near or beyond half the sampling rate; else empty.

    Parameters
    ----------
    plant : Plant
        A discrete one has no modes to judge.
    dt : float, optional
        Sampling time [s]; the plant's own by default.
    x : (nx,) array, optional
        State about which a nonlinear plant is linearised; 0 by default. Its input and disturbance are 0.
    """
    if not plant.continuous:
        return ""
    dt = plant.dt if dt is None else dt
    frequency, design = fastest_mode(_rates_at(plant, x), plant.design, dt)
    nyquist = 0.5 / dt
    if frequency < RESOLVED_SHARE * nyquist:
        return ""
    wanted = 1 / (10 * frequency)  # rounded down to two digits
    digit = 10.0 ** math.floor(math.log10(wanted) - 1)
    better = math.floor(wanted / digit * (1 + 1e-12)) * digit
    where = f" at {plant.design.describe(design)}" if plant.design.dim else ""
    return (
        f"dt = {dt:g} s samples at most {nyquist:.3g} Hz, but the plant oscillates at {frequency:.3g} Hz"
        f"{where}: the samples do not show that oscillation as it is. dt = {better:g} s has ten samples of a period"
    )


def _rates_at(plant: Plant, x: Array | None) -> Callable[[Array], Any]:
    """Linearisation of the rates by the states, of a design, at a state or 0."""
    given = [plant.x, plant.u, plant.w, plant.p]
    jacobian = ca.Function("A", given, [ca.densify(ca.jacobian(plant.dynamics, plant.x))])
    return lambda p: jacobian(np.zeros(plant.nx) if x is None else x, 0, 0, p)


def warn_of_growth(plant: Plant, dt: float) -> None:
    """Issue a `SamplingWarning` if Runge–Kutta parts grow what the plant damps at rest."""
    rates = _rates_at(plant, None)
    matrices = [np.asarray(rates(p), dtype=float) for p in plant.design.spread()]
    modes = np.concatenate([np.linalg.eigvals(A) for A in matrices if np.isfinite(A).all()] or [np.zeros(1)])
    damped = dt * modes[modes.real < 0]

    def growth(parts: int) -> Array:
        """Factors (n,) of the damped modes in a part."""
        z = damped / parts
        return np.asarray(np.abs(1 + z + z**2 / 2 + z**3 / 6 + z**4 / 24))

    if (growth(plant.substeps) > 1 + EXACT).any():
        fastest = damped[np.argmax(growth(plant.substeps))]
        fewest = max(plant.substeps, int(np.abs(damped).max() / 3))  # steps are stable within less than 3
        enough = next(n for n in itertools.count(fewest) if (growth(n) <= 1 + EXACT).all())
        warnings.warn(
            f"the plant has a mode that settles within {dt / -fastest.real:.2g} s, which {plant.substeps} Runge–Kutta "
            f"parts of dt = {dt:g} s do not follow: steps grow. Pass X, U and W, by which parts are chosen, or give "
            f"the plant substeps={enough}.", SamplingWarning, stacklevel=3)  # fmt: skip


def warn_of_aliasing(plant: Plant, dt: float, x: Array | None = None) -> None:
    """Issue a `SamplingWarning` if `sampling_note` is not empty."""
    note = sampling_note(plant, dt, x)
    if note:
        intended = 'If this is intended, pass sampling_guard="ignore".'
        warnings.warn(f"{note}. {intended}", SamplingWarning, stacklevel=3)
