"""Numbers and names as people read them: in the report, the figures and the console."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

SUPERSCRIPT = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")
PLACES = {"nominal": "nominal model", "real": "real plant"}
FORMER = "return to "  # begins the name of a proposal that has been in service before, or is the start


def number(value: float | None, digits: int = 4) -> str:
    """A number to so many significant digits, as a power of ten only where it is very small or large."""
    if value is None or not math.isfinite(value):
        return "n/a"
    if value != 0 and not 1e-3 <= abs(value) < 1e6:
        mantissa, exponent = f"{value:.{digits - 1}e}".split("e")
        return f"{mantissa}·10{str(int(exponent)).translate(SUPERSCRIPT)}"
    shown = float(f"{value:.{digits}g}")
    if shown == 0:
        return "0"
    decimals = max(0, digits - 1 - int(f"{shown:e}".split("e")[1]))
    return f"{shown:.{decimals}f}"


def share(fraction: float | None) -> str:
    """A fraction in per cent, without false digits: "0.07 %", "12 %"; "n/a" for nothing."""
    if fraction is None:
        return "n/a"
    percent = 100 * fraction
    if percent == 0:
        return "0 %"
    return "< 0.01 %" if 0 < percent < 0.01 else f"{_rounded(percent)} %"


def signed_percent(percent: float) -> str:
    """A change in per cent with its sign: "+0.34 %", "−12 %"; what rounds to nothing is "0 %"."""
    text = _rounded(percent)
    return "0 %" if float(text) == 0 else with_minus(f"{'+' if percent > 0 else ''}{text} %")


def capitalised(text: str) -> str:
    """A text with its first letter in upper case, the others as they are."""
    return text[:1].upper() + text[1:]


def percent_interval(mean: float | None, ci95: Sequence[float | None], size: float | None) -> str:
    """A change with its 95 % interval in per cent of a size: "+0.1 % [−0.2, +0.4]"; "n/a" where there is none."""
    if not _finite(mean) or not _finite(size) or size == 0:
        return "n/a"
    values = [signed_percent(100 * value / abs(size)) for value in (mean, *ci95) if _finite(value)]  # type: ignore
    ends = f" [{', '.join(value.removesuffix(' %') for value in values[1:])}]" if len(values) == 3 else ""
    return values[0] + ends


def limits_of(results: Mapping[str, Any]) -> str:
    """What a controller of a run leaves: "X", or "the limits" where those of outputs count, too."""
    return str(results.get("limits", "X"))


def in_measure(measure: str) -> str:
    """What of the returns a change is of, behind it: " in the mean of the worst 10 %"; nothing for their mean."""
    return "" if measure == "mean" else f" in the {measure}"


def _finite(value: float | None) -> bool:
    """Whether there is a value, and a finite one."""
    return value is not None and math.isfinite(value)


def _rounded(percent: float) -> str:
    """Two decimals below 1, one below 10, none above."""
    decimals = 2 if abs(percent) < 1 else 1 if abs(percent) < 10 else 0
    text = f"{percent:.{decimals}f}"
    return text.rstrip("0").rstrip(".") if "." in text else text


def with_minus(text: str) -> str:
    """`text` with the minus sign of a printed page."""
    return text.replace("-", "−")


def duration(seconds: float) -> str:
    """Minutes and seconds."""
    minutes, rest = divmod(round(seconds), 60)
    return f"{minutes} min {rest} s" if minutes else f"{seconds:.1f} s"


def place(row: Mapping[str, Any]) -> str:
    """Where the returns of a row or a generation were measured."""
    return PLACES.get(row["model"], row["model"])


def generation_name(generation: int) -> str:
    """The start, or a generation by its number."""
    return "start" if generation == 0 else f"generation {generation}"


def active_bounds_text(active: Mapping[str, str]) -> str:
    """Active design bounds as a phrase: "k_s lower, c_s upper", or "none"."""
    return ", ".join(f"{name} {side}" for name, side in active.items()) or "none"


def holding_text(row: Mapping[str, Any]) -> str:
    """What holds the design of a row: active bounds, and active constraints where there are any.

    Runs of versions that knew no constraints have none.
    """
    names = ", ".join(row.get("active_constraints", {}))
    return active_bounds_text(row["active_bounds"]) + (f"; active constraints: {names}" if names else "")


def design_text(results: Mapping[str, Any], design: Mapping[str, float]) -> str:
    """A design with its units."""
    units = dict(zip(results["design_space"]["names"], results["design_space"]["units"]))
    return ", ".join(f"{name} = {value:.6g}{unit_text(units[name])}" for name, value in design.items())


def unit_text(unit: str) -> str:
    """A unit behind a number; nothing for a number without one."""
    return "" if unit == "-" else f" {unit}"


def axis_label(name: str, unit: str) -> str:
    """A name with its unit, for an axis or a heading."""
    return name if unit == "-" else f"{name} [{unit}]"
