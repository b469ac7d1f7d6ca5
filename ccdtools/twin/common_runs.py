"""Runs that meet the same disturbance in every deployment: together they are one piece of evidence."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from ccdtools.twin.residuals import Residuals


def is_common(numbers: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Whether runs of these numbers in their deployment meet the same disturbance in every one."""
    return numbers % 2 == 0  # every second run, from the first on


def groups(logs: Sequence[Residuals]) -> NDArray[np.int64]:
    """Group of every run of logs. Its number where it met the same disturbance in all of them, else its own."""
    several = 1 + max(int(log.numbers.max()) for log in logs)
    own = [(k + 1) * several + log.numbers for k, log in enumerate(logs)]
    return np.concatenate([np.where(is_common(log.numbers), log.numbers, alone) for log, alone in zip(logs, own)])
