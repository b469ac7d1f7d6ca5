"""What the physical parameters of every plant have in common."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields
from typing import Any, ClassVar, TypeVar

from ccdtools.checks import as_instance, as_number, as_positive

P = TypeVar("P", bound="Parameters")


@dataclass(frozen=True)
class Parameters:
    """Base of the physical parameters of a plant: finite numbers, positive unless one of these names them.

    Attributes
    ----------
    may_be_zero : tuple of str
        Fields that are at least 0.
    shares : tuple of str
        Fields from 0 to below 1.
    """

    may_be_zero: ClassVar[tuple[str, ...]] = ()
    shares: ClassVar[tuple[str, ...]] = ()

    def __post_init__(self) -> None:
        for field in fields(self):
            object.__setattr__(self, field.name, self._checked(field.name, getattr(self, field.name)))

    def _checked(self, name: str, value: Any) -> float:
        """The value of a field as a number, if it is one that the field can have."""
        if name in self.shares:
            return as_number(name, value, expected="a share, from 0 to below 1", low=0.0, high=math.nextafter(1.0, 0.0))
        if name in self.may_be_zero:
            return as_number(name, value, expected="a finite number, at least 0", low=0.0)
        return as_positive(name, value)


def given_or_default(argument: str, given: P | None, kind: type[P]) -> P:
    """The parameters that were given, checked; those of the source where there are none."""
    return kind() if given is None else as_instance(argument, given, kind, f"a {kind.__name__} or nothing")
