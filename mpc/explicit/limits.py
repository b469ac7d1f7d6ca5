"""Limits on numbers and wall time, checked."""

from __future__ import annotations

from typing import Any

import numpy as np

from mpc.exceptions import InputError


def as_count(name: str, value: Any) -> int:
    """A whole number >= 1."""
    whole = isinstance(value, (int, float, np.integer, np.floating)) and not isinstance(value, bool)
    if not whole or not 1 <= value < 2**62 or value % 1:
        raise InputError(name, repr(value), "a whole number >= 1")
    return int(value)


def as_seconds(name: str, value: Any) -> float:
    """A wall time > 0 [s]; infinite for no limit."""
    real = isinstance(value, (int, float, np.integer, np.floating)) and not isinstance(value, bool)
    if not real or not value > 0:
        raise InputError(name, repr(value), "seconds > 0, or inf")
    return float(value)
