"""What an experiment compares, in words."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from typing import Any

from ccdtools.arrays import Array
from ccdtools.scenario import Scenario
from ccdtools_ground.door import brief, shown

Line = tuple[str, ...]


def conditions_in_words(
    scenarios: Mapping[tuple[str, str], Scenario], designs: Mapping[str, Array], objective: Any,
    limits: Mapping[str, Mapping[str, Sequence[Any]]], seeds: Sequence[int],
) -> tuple[Line, ...]:  # fmt: skip
    """Lines (what, which, in words) on plants, scenarios, designs, objective, limits and seeds.

    Parameters
    ----------
    scenarios : mapping of (name, name of a plant) to Scenario
        Those of the first seed.
    designs : mapping of name to (np,) array
    objective : QuadraticObjective or CustomObjective
    limits : mapping of "X", and "U" where inputs count, to mapping of name of a design to sequence
        The sets of the scenarios.
    seeds : sequence of int
    """
    plants = {plant: scenario.plant for (_, plant), scenario in scenarios.items()}
    runs = {name: scenario for (name, _), scenario in scenarios.items()}
    space = next(iter(plants.values())).design
    told = space.describe if space is not None else shown
    whole = list(seeds) == list(range(len(seeds)))
    return (
        *(("plant", name, described(plant)) for name, plant in plants.items()),
        *(("scenario", name, _of_scenario(scenario)) for name, scenario in runs.items()),
        *(("design", name, told(p)) for name, p in designs.items() if len(p)),
        ("objective", "", described(objective)),
        *(line for kind, sets in limits.items() for line in _boxes(kind, sets)),
        *(() if "U" in limits else [("U", "", "not given: any input counts as what the plant can do")]),
        ("seeds", "", f"0 to {len(seeds) - 1}" if whole and len(seeds) > 1 else ", ".join(map(str, seeds))),
    )  # fmt: skip


def _boxes(kind: str, sets: Mapping[str, Sequence[Any]]) -> tuple[Line, ...]:
    """Lines on boxes about limits, for each design where they are others there."""
    told = {
        name: tuple(dict.fromkeys(" to ".join(str(side.tolist()) for side in one.bounding_box()) for one in own))
        for name, own in sets.items()
    }  # fmt: skip
    alike = len(set(told.values())) == 1
    return tuple(dict.fromkeys((kind, "" if alike else name, box) for name, boxes in told.items() for box in boxes))


def described(value: Any) -> str:
    """Text of an object on one line, without its place in memory."""
    try:
        text = getattr(value, "__qualname__", None) or repr(value)
    except Exception:  # of a class of the user's
        text = type(value).__name__
    return brief(" ".join(re.sub(r" at 0x[0-9a-f]+", "", text).split()), 240)  # characters


def _of_scenario(scenario: Scenario) -> str:
    """Runs, steps and sensors."""
    n, dt = len(scenario.x0), scenario.plant.dt
    sensors = "" if scenario.output is None else f", {described(scenario.output)}"
    followed = "" if scenario.reference is None else ", with a reference"
    return f"{n} run{'s'[: n - 1]} of {scenario.steps} steps of {dt:g} s{followed}{sensors}"
