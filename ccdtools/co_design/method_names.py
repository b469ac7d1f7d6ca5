"""The methods of co-design by their names."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

from ccdtools.checks import shown
from ccdtools.co_design.codesign import METHODS, Method, as_method
from ccdtools.co_design.configuration import METHODS as LEARNING
from ccdtools.co_design.methods.learned import Learned
from ccdtools.co_design.methods.nested import NAMES as INNER
from ccdtools.co_design.methods.nested import Nested
from ccdtools.co_design.methods.search import LIBRARIES, Search
from ccdtools.co_design.methods.sequential import Sequential
from ccdtools.co_design.methods.simultaneous import UNKNOWNS, Simultaneous
from ccdtools.exceptions import InputError
from learning.networks import ActorCritic

ALL = (
    "sequential", "nested Riccati", "nested LQR", "nested MPC", "nested trajectory", "simultaneous",
    "simultaneous gain", "CMA-ES", "Bayesian search", "pathwise",
)  # fmt: skip


def named_methods(methods: Any, agent: ActorCritic | None = None) -> dict[str, Method]:
    """Methods by name, as `compare_methods` takes them.

    Raises
    ------
    InputError
        If there is none of a name, none at all, or one twice.
    """
    if isinstance(methods, Mapping):
        if not all(isinstance(name, str) and name for name in methods):
            raise InputError("methods", shown(methods), "a mapping of names to methods")
        chosen = {name: _named(one, agent) if isinstance(one, str) else as_method(one) for name, one in methods.items()}
    else:
        names = ALL if methods == "all" else (methods,) if isinstance(methods, str) else methods
        if not isinstance(names, list | tuple) or not all(isinstance(name, str) for name in names):
            raise InputError("methods", shown(methods), '"all", a list of names, or a mapping of names to methods')
        found = [_named(name, agent) for name in names]
        chosen = {method.name: method for method in found}
        if len(chosen) < len(found):
            raise InputError("methods", shown(list(names)), "every method once", "Name them in a mapping.")
    if not chosen:
        raise InputError("methods", "none", "at least one method")
    return chosen


def known_methods() -> dict[str, Method]:
    """Every method that has a name, with its usual settings."""
    searches = [Search(library) for library in LIBRARIES]
    programs = [Simultaneous(unknowns) for unknowns in UNKNOWNS]
    learners = [Learned(by=by) for by in LEARNING]
    every: list[Any] = [Sequential(), *(Nested(inner) for inner in INNER), *programs, *searches, *learners]
    return {method.name: method for method in every}


def _named(name: str, agent: ActorCritic | None) -> Method:
    """The method of a name, whatever its capitals and hyphens."""
    known = {_key(one): method for one, method in known_methods().items()}
    if _key(name) in known:
        found = known[_key(name)]
        learns = isinstance(found, Learned) or (isinstance(found, Nested) and found.inner == "rl")
        return replace(found, agent=agent) if learns else found  # type: ignore[type-var]
    if name in METHODS:
        return as_method(name)
    raise InputError("methods", shown(name), f"one of {', '.join(known_methods())}")


def _key(name: str) -> str:
    """A name as it is looked up."""
    return " ".join(name.lower().replace("-", " ").replace("_", " ").split())
