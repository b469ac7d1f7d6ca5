"""Status of how a calculation ended, with advice."""

from enum import Enum


class Outcome(Enum):
    """Status whose value says what to do about it."""

    @property
    def advice(self) -> str:
        """Advice on what to do about it."""
        return str(self.value)
