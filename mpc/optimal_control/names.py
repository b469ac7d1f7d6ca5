"""Names as a user states them, for messages and figures."""

from __future__ import annotations

from typing import Any

from mpc.exceptions import InputError
from mpc.optimal_control.functions import brief


def as_names(name: str, value: Any, usual: str, size: int) -> tuple[str, ...]:
    """So many names; `usual` and a number each where none are given."""
    if isinstance(value, str) or not isinstance(value, list | tuple):
        raise InputError(name, brief(repr(value)), f"a list of {size} names")
    names = tuple(value) or tuple(f"{usual}{i + 1}" for i in range(size))
    strange = next((entry for entry in names if not isinstance(entry, str)), None)
    if strange is not None:
        raise InputError(name, brief(repr(strange)), "names, which are text")
    if len(names) != size:
        raise InputError(name, f"{len(names)} names", f"{size}, one each")
    if len(set(names)) < size:
        double = next(entry for entry in names if names.count(entry) > 1)
        raise InputError(name, f"{double!r} twice", "names that differ")
    return names
