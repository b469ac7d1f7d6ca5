"""What the costs of scenarios come to where they are not summed, as pieces."""

from __future__ import annotations

from typing import Any

import casadi as ca

from mpc.checks import Array
from mpc.optimal_control.pieces import piece_function

ROUND = 1e-12  # of the squares: where all scenarios cost the same, their spread has a slope all the same
TINY = 1e-300


def itself() -> ca.Function:
    """A number, as a piece."""
    return piece_function(lambda z, data: [z], True, {"z": 1}, 0)


def mean_and_spread(weights: Array, spread: float) -> ca.Function:
    """The weighted mean of numbers and so many times their standard deviation, as a piece."""
    parts = ca.DM(weights / weights.sum())

    def value(z: Any, data: Any) -> list[Any]:
        mean = ca.dot(parts, z)
        variance = ca.dot(parts, (z - mean) ** 2)
        return [mean + spread * ca.sqrt(variance + ROUND * ca.dot(parts, z**2) + TINY)]

    return piece_function(value, True, {"z": len(weights)}, 0)
