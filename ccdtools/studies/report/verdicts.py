"""A controller beside LQR, in one word and in per cent."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from ccdtools.studies.report.formatting import number

Row = Mapping[str, Any]
NOT_WORSE = 0.5  # per cent: a controller whose interval lies above −0.5 % of |LQR| is not worse
EQUAL = 1e-4  # per cent: two returns this close differ by rounding and the tolerances of the solvers


def reference_of(rows: Sequence[Row], row: Row) -> Row | None:
    """The row of LQR for the same generation and plant."""
    same = (other for other in rows if (other["generation"], other["plant"]) == (row["generation"], row["plant"]))
    return next((other for other in same if other["controller"] == "LQR"), None)


def saw_fewer_runs(row: Row, reference: Row | None) -> bool:
    """Whether a controller was tried on only some of the runs that LQR was tried on."""
    return reference is not None and _tried(row) < _tried(reference) - 0.5


def _tried(row: Row) -> float:
    """Runs that a row was measured on, diverged ones included; infinite where all diverged, and nobody can tell."""
    finished = 1 - (row["diverged"] or 0.0)
    return row["n"] / finished if finished > 0 else float("inf")


def percent_of_reference(row: Row, reference: Row | None) -> tuple[float, float, float] | None:
    """Paired difference of a row and its interval in per cent of |LQR| on the same runs; None where there is none."""
    gain = row["paired_to_lqr"]
    if reference is None or gain["mean"] is None or None in gain["ci95"] or not row["lqr_mean"]:
        return None
    size = abs(row["lqr_mean"])
    return (100 * gain["mean"] / size, 100 * gain["ci95"][0] / size, 100 * gain["ci95"][1] / size)


def verdict(row: Row, reference: Row | None) -> str:
    """Return "equal", "better", "not worse", "worse" or "open", as the interval of the paired difference to LQR says.

    An interval within ±1e-4 % of zero is "equal": such differences are rounding, and no verdict rests on them.
    """
    percent = percent_of_reference(row, reference)
    if percent is None:
        return _verdict_on_nothing(row, reference)
    _, low, high = percent
    if low >= -EQUAL and high <= EQUAL:
        return "equal"
    if low > EQUAL:
        return "better"
    if low > -NOT_WORSE:
        return "not worse"
    return "worse" if high < -EQUAL else "open"


def _verdict_on_nothing(row: Row, reference: Row | None) -> str:
    """The verdict where the return of LQR is zero, or there are no pairs."""
    if reference is None or row["lqr_mean"] != 0 or row["paired_to_lqr"]["mean"] is None:
        return "no pairs"
    return "equal" if row["paired_to_lqr"]["mean"] == 0 else "worse"  # no return is above zero


def difference_text(row: Row) -> tuple[str, str]:
    """The paired difference of a row and its interval as text; differences of rounding are zero."""
    gain = row["paired_to_lqr"]
    if gain["mean"] is None or None in gain["ci95"]:
        return number(gain["mean"], 3), "n/a"
    floor = EQUAL / 100 * abs(row["mean"] or 0.0)
    mean, low, high = (number(v if abs(v) >= floor else 0.0, 3) for v in (gain["mean"], *gain["ci95"]))
    return mean, f"[{low}, {high}]"
