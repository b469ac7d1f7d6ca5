"""Groups of runs that meet the same disturbance in every deployment."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from ccdtools.twin.residuals import Residuals


def is_common(numbers: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Whether runs of these numbers meet the same disturbance in every deployment."""
    common: NDArray[np.bool_] = numbers % 2 == 0  # every second run, from the first on
    return common


def groups(logs: Sequence[Residuals]) -> NDArray[np.int64]:
    """Group of every run: its number if all logs share its disturbance, else a unique one."""
    several = 1 + max(int(log.numbers.max()) for log in logs)
    own = [(k + 1) * several + log.numbers for k, log in enumerate(logs)]
    return np.concatenate([np.where(is_common(log.numbers), log.numbers, alone) for log, alone in zip(logs, own)])
