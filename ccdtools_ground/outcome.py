"""How a calculation ended, as a status with advice."""

from enum import Enum


class Outcome(Enum):
    """A status whose value says what to do about it."""

    @property
    def advice(self) -> str:
        """What to do about it."""
        return str(self.value)
