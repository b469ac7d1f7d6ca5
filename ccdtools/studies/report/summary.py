"""Gains and losses from the start to the last deployed."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

from ccdtools.evidence.drift import DriftStatus
from ccdtools.evidence.percent import number, percent_interval, with_minus, word_of_change
from ccdtools.studies.report.gains import gain_percent
from ccdtools.studies.report.verdicts import in_percent
from ccdtools.studies.tolerances import NOT_WORSE_PERCENT

Values = Mapping[str, Any]
COST = "cost"


@dataclass(frozen=True)
class Change:
    """Change of one number in one place.

    Attributes
    ----------
    name : str
        "cost", or a metric with its unit.
    place : str
        The disturbance or start that it was measured with, on the real plant.
    before, after : float
    percent : (float, float, float) or None
        The change and its 95 % interval, in per cent of `before`; None where there is no interval.
    word : {"better", "worse", "same", "open"}
    steps : int
        Of every run of a cost.
    """

    name: str
    place: str
    before: float
    after: float
    percent: tuple[float, float, float] | None
    word: str
    steps: int = 0

    @property
    def label(self) -> str:
        """Label: the name of a metric, place and steps of a cost."""
        return f"cost of {self.steps} steps, {self.place}" if self.name == COST else self.name

    @property
    def text(self) -> str:
        """Change with its interval, such as "+21 % [+19, +22]"."""
        if self.percent is None:
            return "n/a"
        return percent_interval(self.percent[0], self.percent[1:], 100)

    @property
    def shown(self) -> tuple[str, str]:
        """Both values as text."""
        return with_minus(number(self.before)), with_minus(number(self.after))


def changes(results: Values) -> list[Change]:
    """Changes of cost and of every metric in every place."""
    places = results.get("gains", ())
    found = [cost for place in places for cost in _cost(place)]
    return found + [metric for place in places for metric in _metrics(place)]


def in_first_place(results: Values) -> list[Change]:
    """Changes of cost everywhere, and of metrics where deployed."""
    everything = changes(results)
    first = everything[0].place if everything else ""
    return [one for one in everything if one.name == COST or one.place == first]


def of_word(results: Values, word: str) -> dict[str, Change]:
    """Metrics that got worse (or better), each in its most changed place."""
    named = [one for one in changes(results) if one.word == word and one.name != COST]
    return {one.name: max((other for other in named if other.name == one.name), key=_by) for one in named}


def _by(change: Change) -> float:
    """Size of a change [%]; infinite from zero."""
    return math.inf if change.percent is None else abs(change.percent[0])


def decided(results: Values) -> Iterator[tuple[str, Values]]:
    """Judged changes and their verdicts in each generation."""
    for g in results["generations"]:
        generation = f"generation {g['generation']}, "
        for update in g["online_updates"]:
            yield generation + f"update after {update['after']} samples", update
        for name, decision in ((g["redesign"] or {}).get("decisions") or {}).items():
            yield generation + name, decision
        yield generation + "as deployed", g["delivery"]


def bare(name: str) -> str:
    """Name of a metric without its unit."""
    return name.split(" [")[0]


def next_steps(results: Values) -> list[str]:
    """Advice about worse numbers, and of the deployed co-design."""
    steps = []
    worse = ", ".join(bare(name) for name in of_word(results, "worse"))
    if worse:
        steps.append(f"{worse} got worse: if that matters, weigh it in the objective or limit it, and run again")
    last = len(results["generations"])
    steps += [one["drift"]["advice"].strip().removesuffix(".") for one in drifts(results) if one["generation"] == last]
    found = None if len(steps) > bool(worse) else deployed_codesign(results)  # of another plant
    advice = found["codesign"]["advice"].strip().removesuffix(".") if found else ""
    if found:
        named = [f"{name} ({side} bound)" for name, side in found["active_bounds"].items()]
        named += list(found["active_constraints"])
        general = "Widen the named bounds, or relax the named constraints"
        advice = advice.replace(general, f"Widen or relax {', '.join(named)}") if named else advice
    return [*steps, advice] if advice else steps


def drifts(results: Values) -> list[Values]:
    """Generations whose deployment showed that the plant had changed."""
    found = DriftStatus.DRIFT.value
    return [one for one in results["generations"] if one.get("drift", {}).get("status") == found]


def deployed_codesign(results: Values) -> Values | None:
    """Generation whose co-design is deployed at the end; None without one."""
    for generation in reversed(results["generations"]):
        redesign = generation["redesign"]
        if redesign is None or (redesign["chosen"] == "redesign" and generation["delivery"]["replaces"]):
            return generation  # type: ignore[no-any-return]
        if redesign["accepted"] and generation["delivery"]["replaces"]:
            return None
    return None


def _cost(place: Values) -> Iterator[Change]:
    gain = gain_percent(place, "total")
    if gain is None:
        return
    before = -place["start"]
    after = before - place["total"]["mean"]
    mean, low, high = gain
    percent = None if low is None or high is None else (-mean, -high, -low)
    word = "open" if percent is None else word_of_change(*percent, NOT_WORSE_PERCENT)
    said = {"more": "worse", "less": "better"}.get(word, word)
    yield Change(COST, place["place"], before, after, percent, said, place["steps"])


def _metrics(place: Values) -> Iterator[Change]:
    for metric in place.get("metrics", ()):
        before = metric["before"]
        percent = in_percent(metric["change"], abs(before or 0.0))
        yield Change(metric["name"], place["place"], before, metric["after"], percent, metric["word"])
