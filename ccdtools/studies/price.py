"""Price of a redesign: the gain that must be predicted."""

from __future__ import annotations

import math
import re
from dataclasses import dataclass
from typing import Any

from ccdtools.exceptions import InputError
from ccdtools_ground.door import shown

DEFAULT_PRICE = "0.5 %"
ACCEPTED_LOSS = "0.5 %"
PRICE = re.compile(r"\s*([+-]?(?:[0-9]+\.?[0-9]*|\.[0-9]+)(?:[eE][+-]?[0-9]+)?)\s*(%|return)\s*")
EXPECTED = "a price ≥ 0 with its unit"
CURE = 'Write "0.5 %" (of the deployed return), or "12 return" (in units of the return of an evaluation).'


@dataclass(frozen=True)
class RedesignPrice:
    """Gain in return that a redesign must exceed.

    Attributes
    ----------
    amount : float
        In per cent of the deployed return without the cost of the design, or in units of the return of an evaluation.
    relative : bool
        Whether it is in per cent.
    """

    amount: float
    relative: bool

    @classmethod
    def parse(cls, text: Any, argument: str = "redesign_price") -> RedesignPrice:
        """Price stated by a text such as "0.5 %" or "12 return".

        Raises
        ------
        InputError
            If it is negative, not finite, or has no unit.
        """
        found = PRICE.fullmatch(text) if isinstance(text, str) else None
        if found is None:
            raise InputError(argument, shown(text), EXPECTED, CURE)
        amount = float(found[1])
        if not math.isfinite(amount) or math.copysign(1.0, amount) < 0:
            raise InputError(argument, shown(text), EXPECTED, CURE)
        return cls(amount, found[2] == "%")

    def __str__(self) -> str:
        return f"{self.amount:g} %" if self.relative else f"{self.amount:g} in return"

    def needed(self, size: float, part: float) -> float:
        """Needed gain for a return of `size` over `part` of an evaluation."""
        return self.amount / 100 * size if self.relative else self.amount * part


def accepted_loss(text: Any, argument: str = "accept_loss") -> float:
    """Part of a return that a text such as "0.5 %" accepts to lose.

    Raises
    ------
    InputError
        If it is negative, more than all, or not in per cent.
    """
    expected = "a loss from 0 % to 100 %"
    try:
        loss = RedesignPrice.parse(text, argument)
    except InputError:
        loss = None
    if loss is None or not loss.relative or loss.amount > 100:
        raise InputError(argument, shown(text), expected, 'Write "1 %": of the return on each distribution.')
    return loss.amount / 100
