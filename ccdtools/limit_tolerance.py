"""How far a closed loop may leave its limits."""

from __future__ import annotations

from typing import Any

import numpy as np

from ccdtools_ground.door import as_number, shown
from ccdtools_ground.errors import InputError

TOLERANCES = ("mpc", "off")  # of the state limits, in words


def as_limit_tolerance(argument: str, value: Any) -> str | tuple[float, float]:
    """Tolerance of limits: "mpc", "off", or (fraction of states, depth in half-widths) ≥ 0."""
    expected = "mpc, off, or (fraction of the states outside X, peak depth in half-widths of X), both ≥ 0"
    if isinstance(value, str):
        if value not in TOLERANCES:
            raise InputError(argument, shown(value), expected)
        return value
    if not isinstance(value, list | tuple | np.ndarray) or len(value) != 2:
        raise InputError(argument, shown(value), expected)
    fraction = as_number(argument, value[0], expected=expected, low=0.0, high=1.0)
    return (fraction, as_number(argument, value[1], expected=expected, low=0.0))
