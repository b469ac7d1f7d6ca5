"""Tables and phrases on the gains and where they hold."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from ccdtools.evidence.percent import number, percent_interval, signed_percent, with_minus
from ccdtools.studies.names import SOURCES
from ccdtools.studies.report.formatting import generation_name
from ccdtools.studies.report.verdicts import on_same_runs, reference_of, saw_fewer_runs, size_of, verdict

Values = Mapping[str, Any]
WORDS = {
    "design": "design (LQR there against LQR at the start design)", "policy": "policy, as first designed, against LQR",
    "updates": "updates while deployed", "redesign": "redesign on the updated model", "total": "together",
}  # fmt: skip


def gain_percent(place: Values, source: str) -> tuple[float, float | None, float | None] | None:
    """Gain and its interval in per cent.

    Of what control costs LQR at the start design; None where there is none.

    Parameters
    ----------
    place : mapping
        An element of ``gains`` in results.json.
    source : {"design", "policy", "updates", "redesign", "total"}
    """
    gain = place[source]
    if gain["mean"] is None or not place["start"]:
        return None
    size = abs(place["start"] + place.get("design_cost", 0.0)) or abs(place["start"])
    percent = [None if value is None else 100 * value / size for value in (gain["mean"], *gain["ci95"])]
    return (percent[0] or 0.0, percent[1], percent[2])


def gain_text(place: Values, source: str) -> str:
    """Gain in per cent with its interval, such as "+23 % [+22, +24]"."""
    percent = gain_percent(place, source)
    if percent is None:
        return "n/a"
    mean, low, high = percent
    if low == high == 0:
        return "0 %"
    return f"{signed_percent(mean)} [no interval]" if low is None else percent_interval(mean, (low, high), 100)


def gain_rows(results: Values) -> list[list[str]]:
    """Table of the gains, by source and in total, a column per place."""
    sources = (*SOURCES[1:], "total")
    return [[WORDS[source], *(gain_text(place, source) for place in results["gains"])] for source in sources]


def gain_headings(results: Values) -> list[str]:
    """Headings of the places: name, runs, steps, part left out."""
    return _headings(results["gains"])


def _headings(places: Sequence[Values]) -> list[str]:
    """Headings of places."""
    headings = []
    for place in places:
        runs = "one run" if place["runs"] == 1 else f"{place['runs']} runs"
        lost = f", {signed_percent(100 * place['left_out'])[1:]} left out" if place["left_out"] else ""
        headings.append(f"{place['place']} ({runs} of {place['steps']} steps{lost})")
    return headings


def service_table(results: Values) -> list[list[str]]:
    """What was in service, a row per place."""
    rows = results["in_service"]
    return [[heading, *_service_cells(row)] for heading, row in zip(_headings(rows), rows)]


def _service_cells(row: Values) -> list[str]:
    """Returns, each with the change from the one before."""
    cells = []
    for mean, change, paid in zip(row["means"], [None, *row["changes"]], [0.0, *row["design_costs"]]):
        shown = "n/a" if mean is None else with_minus(number(mean))
        if mean is not None and change is not None:
            before = mean - change["mean"]
            shown += f", {gain_text({'start': before, 'design_cost': paid, 'of': change}, 'of')}"
        cells.append(shown)
    return cells


def held_out_rows(results: Values, steps: int) -> list[dict[str, Any]]:
    """Table of the start and last design, a column per place.

    Parameters
    ----------
    steps : int
        Returns are scaled to so many, because the places have runs of different lengths.
    """
    lengths = {place["place"]: place["steps"] for place in results["gains"]}
    names = list(lengths)
    by_place = {names[0]: [row for row in results["comparison"] if row["plant"] == "real"]}
    by_place |= {name: [row for row in results["held_out"] if row["model"] == name] for name in names[1:]}
    shown = {(row["generation"], row["controller"]): None for name in names[1:] for row in by_place[name]}
    return [
        {"generation": generation_name(g), "controller": controller,
         "cells": [_cell(by_place[name], g, controller, steps / lengths[name]) for name in names]}
        for g, controller in shown
    ]  # fmt: skip


def held_out_phrase(results: Values) -> str:
    """Phrase for the change of cost on held-out disturbances; empty if none."""
    changes = []
    places = results.get("gains", ())[1:]
    for place in places:
        percent = gain_percent(place, "total")
        changes.append(f"{'n/a' if percent is None else signed_percent(-percent[0])} ({place['place']})")
    return f"elsewhere: {', '.join(changes)}" if changes else ""


def console_lines(results: Values) -> list[str]:
    """Lines of plain text with the gains by source, one per place."""
    lines = ["gain in return, in % of what control costs LQR at the start design, by source [95 % interval]"]
    for heading, place in zip(gain_headings(results), results["gains"], strict=True):
        parts = [f"{source} {gain_text(place, source)}" for source in (*SOURCES[1:], "total")]
        lines.append(f"  {heading}: {'; '.join(parts)}")
    lines += ["", "in service at the start and after each generation: return, change from the one before"]
    return lines + [f"  {heading}: {'; '.join(cells)}" for heading, *cells in service_table(results)]


def _cell(rows: Sequence[Values], generation: int, controller: str, scale: float) -> dict[str, str] | None:
    """Scaled return, difference to LQR and verdict; None without such a row."""
    own = next((row for row in rows if (row["generation"], row["controller"]) == (generation, controller)), None)
    if own is None:
        return None
    reference = reference_of(rows, own)
    gain = own["paired_to_lqr"]["mean"]
    size = 0.0 if own is reference or gain is None else size_of(own, "lqr_mean")
    against = signed_percent(100 * gain / size) if size else ""
    mean = on_same_runs(own, reference)["mean"]
    shown = "n/a" if mean is None else with_minus(number(scale * mean))
    word = "reference" if own is reference else verdict(own, reference)
    return {"mean": shown + " *" * saw_fewer_runs(own, reference), "against": against, "verdict": word}
