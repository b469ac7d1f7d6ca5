"""The independent optima, as `gallery.oracle` has computed them."""

from __future__ import annotations

import json
from functools import cache
from pathlib import Path
from typing import Any

from gallery.oracle import mechanical, other
from gallery.oracle.statement import Statement

STATEMENTS = {
    "mass_spring_damper": mechanical.mass_spring_damper,
    "quarter_car": mechanical.quarter_car,
    "pendulum": mechanical.pendulum,
    "platform": mechanical.platform,
    "chain_of_3": mechanical.chain_of_3,
    "chain_of_4": mechanical.chain_of_4,
    "two_unstable_modes": other.two_unstable_modes,
    "beam": other.beam,
    "rail_mass": mechanical.rail_mass,
    "servo": mechanical.servo,
    "heated_room": other.heated_room,
}
STUDIES = tuple(STATEMENTS)
CLIPPED = ("two_unstable_modes",)  # inputs saturate: the best clipped linear feedback, by search
LIMITED = ("rail_mass",)  # a state limit binds: MPC
OPTIMA = Path(__file__).with_name("optima.json")


def statement(study: str) -> Statement:
    """The study in plain numbers."""
    return STATEMENTS[study]()


@cache
def optima() -> dict[str, dict[str, Any]]:
    """All that `python -m gallery.oracle` has found, by study."""
    return json.loads(OPTIMA.read_text())


def reference(study: str) -> dict[str, Any]:
    """Optima, worst corner and worth of the truth of one study."""
    return optima()[study]
