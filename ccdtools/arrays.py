"""Array types of the package."""

from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

Array: TypeAlias = NDArray[np.float64]
Given: TypeAlias = Any
"""A dataclass field that takes any array_like and holds an `Array` once the object exists."""
