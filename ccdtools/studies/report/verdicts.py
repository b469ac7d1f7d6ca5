"""Comparison of a controller with LQR."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from ccdtools.evidence.percent import number, word_of_gain
from ccdtools.studies.report.formatting import generation_name, place
from ccdtools.studies.tolerances import EQUAL_PERCENT

Row = Mapping[str, Any]


def reference_of(rows: Sequence[Row], row: Row) -> Row | None:
    """Row of LQR for the same generation and plant."""
    same = (other for other in rows if (other["generation"], other["plant"]) == (row["generation"], row["plant"]))
    return next((other for other in same if other["controller"] == "LQR"), None)


def saw_fewer_runs(row: Row, reference: Row | None) -> bool:
    """Whether a controller was tried on only some of LQR's runs."""
    return reference is not None and _tried(row) < _tried(reference) - 0.5


def on_same_runs(row: Row, reference: Row | None) -> Row:
    """Row without its means and metrics where these are of fewer runs."""
    if not saw_fewer_runs(row, reference):
        return row
    nothing = {"mean": None, "std": None, "median": None, "ci95": (None, None)}
    return {**row, **nothing, "metrics": dict.fromkeys(row.get("metrics", ()))}


def _tried(row: Row) -> float:
    """Number of runs of a row, diverged included; infinite if all diverged."""
    finished = 1 - (row["diverged"] or 0.0)
    return row["n"] / finished if finished > 0 else float("inf")


def percent_of_reference(row: Row, reference: Row | None) -> tuple[float, float, float] | None:
    """Paired difference and its interval in per cent of |LQR|; None without one.

    The cost of the design, which both pay, is no part of it.
    """
    if reference is None or not row["lqr_mean"]:
        return None
    return in_percent(row["paired_to_lqr"], size_of(row, "lqr_mean"))


def in_percent(change: Mapping[str, Any], size: float) -> tuple[float, float, float] | None:
    """Change and its interval in per cent of a size; None without one of them."""
    ends = [change["mean"], *change["ci95"]]
    if None in ends or not size:
        return None
    mean, low, high = (100 * end / size for end in ends)
    return mean, low, high


def size_of(row: Row, name: str = "mean") -> float:
    """Size of a row's return, without the cost of its design."""
    return float(abs((row[name] or 0.0) + row.get("design_cost", 0.0)))


def verdict(row: Row, reference: Row | None) -> str:
    """Verdict "equal", "better", "not worse", "worse" or "open", or that "in return only".

    "Better" and "worse" are certain and matter: the interval of the paired difference to LQR excludes zero, and its
    mean is at least 0.5 % of LQR's return. An interval within ±0.5 % is "equal", one above −0.5 % "not worse". A
    controller that leaves X further than LQR, or further than MPC where it is better than LQR, is so "in return only";
    so is one that is worse than an LQR that leaves X further. One with a remark is no baseline: "none".
    """
    if row.get("remark"):
        return "none"
    word = _verdict_on_return(row, reference)
    return f"{word} in return only" if _at_the_price_of_X(word, row, reference) else word


def _verdict_on_return(row: Row, reference: Row | None) -> str:
    percent = percent_of_reference(row, reference)
    if percent is None:
        return _verdict_on_nothing(row, reference)
    mean, low, high = (value / 100 for value in percent)
    return word_of_gain(mean, low, high)


def _at_the_price_of_X(word: str, row: Row, reference: Row | None) -> bool:
    """Whether a verdict on the return hides a violation of X."""
    if reference is None or row is reference:
        return False
    if word == "worse":
        return row["controller"] in further_than(reference)
    named = further_than(row)
    return word in ("better", "not worse", "equal") and ("LQR" in named or (word == "better" and "MPC" in named))


def further_than(row: Row) -> tuple[str, ...]:
    """Controllers that leave X less than that of a row."""
    return tuple(row.get("further_outside_than", ()))


def outside_text(row: Row, rows: Sequence[Row]) -> str:
    """Text of a violation of X, such as "0.99 half-widths (v > 0.5); LQR 0.4"."""
    same = [o for o in rows if (o["generation"], o["plant"]) == (row["generation"], row["plant"])]
    others = [o for o in same if o["controller"] in ("LQR", "MPC") and o["controller"] != row["controller"]]
    beside = ", ".join(f"{o['controller']} {number(o['depth_peak'], 2)}" for o in others)
    which = f" ({row['exceeded']})" if row["exceeded"] else ""
    return f"{number(row['depth_peak'], 2)} half-widths{which}" + (f"; {beside}" if beside else "")


def limit_notes(rows: Sequence[Row], limits: str = "X") -> list[str]:
    """Notes on controllers whose verdict is on the return only."""
    notes = []
    for row in rows:
        reference = reference_of(rows, row)
        if verdict(row, reference).endswith("in return only"):
            where = f"{place(row)}, {generation_name(row['generation'])}"
            word = verdict(row, reference).removesuffix(" in return only")
            beside = "equal to" if word == "equal" else f"{word} than"
            leaves = f"it leaves {limits} by {outside_text(row, rows)}"
            notes.append(f"{where}: {row['controller']} is {beside} LQR in return only: {leaves}")
    return notes


def _verdict_on_nothing(row: Row, reference: Row | None) -> str:
    if reference is None or row["paired_to_lqr"]["mean"] is None:
        return "no pairs"
    if row["lqr_mean"] != 0:
        return "open"
    return "equal" if row["paired_to_lqr"]["mean"] == 0 else "worse"  # no return is above zero


def difference_text(row: Row) -> tuple[str, str]:
    """Paired difference and its interval as text; rounding errors are zero."""
    gain = row["paired_to_lqr"]
    if gain["mean"] is None or None in gain["ci95"]:
        return number(gain["mean"], 3), "n/a"
    floor = EQUAL_PERCENT / 100 * size_of(row)
    mean, low, high = (number(v if abs(v) >= floor else 0.0, 3) for v in (gain["mean"], *gain["ci95"]))
    return mean, f"[{low}, {high}]"
