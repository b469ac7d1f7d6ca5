"""Numbers and names for report, figures and console."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

PLACES = {"nominal": "nominal model", "real": "real plant"}


def capitalised(text: str) -> str:
    """Text with its first letter in upper case."""
    return text[:1].upper() + text[1:]


def limits_of(results: Mapping[str, Any]) -> str:
    """Name of the limits: "X", or "the limits" with outputs."""
    return str(results.get("limits", "X"))


def duration(seconds: float) -> str:
    """Minutes and seconds."""
    minutes, rest = divmod(round(seconds), 60)
    return f"{minutes} min {rest} s" if minutes else f"{seconds:.1f} s"


def place(row: Mapping[str, Any]) -> str:
    """Place where a row's or a generation's returns were measured."""
    return str(PLACES.get(row["model"], row["model"]))


def generation_name(generation: int) -> str:
    """Name of a generation by its number; "start" for 0."""
    return "start" if generation == 0 else f"generation {generation}"


def active_bounds_text(active: Mapping[str, str]) -> str:
    """Active design bounds, such as "k_s lower, c_s upper", or "none"."""
    return ", ".join(f"{name} {side}" for name, side in active.items()) or "none"


def holding_text(row: Mapping[str, Any]) -> str:
    """Active bounds and constraints of a row's design.

    Runs of versions that knew no constraints have none.
    """
    names = ", ".join(row.get("active_constraints", {}))
    return active_bounds_text(row["active_bounds"]) + (f"; active constraints: {names}" if names else "")


def design_text(results: Mapping[str, Any], design: Mapping[str, float]) -> str:
    """Text of a design with its units."""
    units = dict(zip(results["design_space"]["names"], results["design_space"]["units"]))
    return ", ".join(f"{name} = {value:.6g} {units[name]}".removesuffix(" -") for name, value in design.items())
