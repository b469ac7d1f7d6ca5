"""Names of methods in tables, without slow imports."""

from __future__ import annotations

from collections.abc import Sequence

from ccdtools.exceptions import InputError
from ccdtools_ground.door import nearest, shown

ALL = (
    "sequential", "nested Riccati", "nested LQR", "nested MPC", "nested trajectory", "simultaneous",
    "simultaneous gain", "CMA-ES", "Bayesian search", "pathwise",
)  # fmt: skip
NAMES = (*ALL, "nested gain", "nested LQG", "nested NMPC", "nested RL", "ppo", "pathwise+ppo")
EXPERTS = ("lqr", "mpc", "explicit")  # whose inputs a first policy imitates
STUDY_EXPERTS = ("auto", *EXPERTS)
SHORT = {"nested": "nested LQR", "search": "CMA-ES"}  # what `codesign` means by its short names


def as_method_names(names: Sequence[str], argument: str = "methods") -> list[str]:
    """Method names as tables write them, ignoring capitals and hyphens.

    Raises
    ------
    InputError
        If there is none of a name, none at all, or one twice.
    """
    known = {_key(name): name for name in NAMES} | SHORT
    for name in names:
        if _key(name) not in known:
            raise InputError(argument, shown(name), f"one of {', '.join(NAMES)}", nearest(name, NAMES))
    found = [known[_key(name)] for name in names]
    if len(set(found)) < len(found):
        raise InputError(argument, shown(list(names)), "every method once", "Name them in a mapping.")
    return found


def _key(name: str) -> str:
    """Name as it is looked up."""
    return " ".join(name.lower().replace("-", " ").replace("_", " ").split())
