"""Status of how a calculation ended, with advice."""

from __future__ import annotations

from enum import Enum


class Outcome(Enum):
    """Status with a value and the advice what to do about it; a value alone is its own advice."""

    advice: str

    def __new__(cls, value: str, advice: str | None = None) -> Outcome:
        """Member with its advice."""
        member = object.__new__(cls)
        member._value_ = value
        member.advice = value if advice is None else advice
        return member
