"""Numbers and changes in per cent, as people read them."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence

from ccdtools.tolerances import NOT_WORSE, SAME_RETURN

SUPERSCRIPT = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")


def number(value: float | None, digits: int = 4) -> str:
    """Number to so many significant digits, as a power of ten if extreme."""
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
    """Fraction in per cent, such as "0.07 %"; "n/a" for None or NaN."""
    if fraction is None or not math.isfinite(fraction):
        return "n/a"
    percent = 100 * fraction
    if percent == 0:
        return "0 %"
    return "< 0.01 %" if 0 < percent < 0.01 else f"{_rounded(percent)} %"


def signed_percent(percent: float, more: int = 0) -> str:
    """Signed change such as "+0.34 %" with `more` decimals; "0 %" if rounded away."""
    text = _rounded(percent, more)
    return "0 %" if float(text) == 0 else with_minus(f"{'+' if percent > 0 else ''}{text} %")


def percent_interval(mean: float | None, ci95: Sequence[float | None], size: float | None) -> str:
    """Change and 95 % interval relative to a size: "+0.1 % [−0.2, +0.4]", or "n/a"."""
    if not _finite(mean) or not _finite(size) or size == 0:
        return "n/a"
    parts = [100 * value / abs(size) for value in (mean, *ci95) if _finite(value)]  # type: ignore
    values = [signed_percent(part) for part in parts]
    if any(shown == values[0] != "0 %" and part != parts[0] for shown, part in zip(values[1:], parts[1:])):
        values = [signed_percent(part, 1) for part in parts]  # an end would stand on the estimate
    ends = f" [{', '.join(value.removesuffix(' %') for value in values[1:])}]" if len(values) == 3 else ""
    return values[0] + ends


def word_of_change(change: float, low: float, high: float, floor: float) -> str:
    """Word "more" or "less" beyond chance and a floor, "same" within it, or "open"."""
    if -floor <= low and high <= floor:
        return "same"
    if abs(change) >= floor and (low > 0 or high < 0):
        return "more" if change > 0 else "less"
    return "open"


def word_of_gain(mean: float, low: float, high: float) -> str:
    """Word for a gain and its interval, in parts of a return."""
    if low >= -NOT_WORSE and high <= NOT_WORSE:
        return "equal"
    if low > SAME_RETURN and mean >= NOT_WORSE:
        return "better"
    if low > -NOT_WORSE:
        return "not worse"
    return "worse" if high < -SAME_RETURN and mean <= -NOT_WORSE else "open"


def nothing_done(place: str) -> str:
    """Remark on a baseline whose inputs were all 0."""
    return f"does nothing on {place}: all its inputs were 0, so that a gain over it is one over the plant left alone"


def in_measure(measure: str) -> str:
    """Phrase such as " in the mean of the worst 10 %"; empty for the mean."""
    return "" if measure == "mean" else f" in the {measure}"


def with_minus(text: str) -> str:
    """Text with typographic minus signs before its numbers."""
    return re.sub(r"-(?=[\d.]|inf)", "−", text)


def _finite(value: float | None) -> bool:
    return value is not None and math.isfinite(value)


def _rounded(percent: float, more: int = 0) -> str:
    """Number with two decimals below 1, one below 10, none above, plus `more`."""
    decimals = more + (2 if abs(percent) < 1 else 1 if abs(percent) < 10 else 0)
    text = f"{percent:.{decimals}f}"
    return text.rstrip("0").rstrip(".") if "." in text else text
