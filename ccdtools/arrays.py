"""Array types and values for JSON."""

from __future__ import annotations

import math
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from ccdtools_ground.door import Immutable as Immutable, frozen as frozen

Array: TypeAlias = NDArray[np.float64]
Indices: TypeAlias = NDArray[np.integer[Any]]
Mask: TypeAlias = NDArray[np.bool_]
ArrayField: TypeAlias = Any
"""A dataclass field that takes any array_like and holds an `Array` once the object exists."""


def jsonable(value: Any) -> Any:
    """`value` with plain Python types only; non-finite numbers become None."""
    if isinstance(value, dict):
        return {str(key): jsonable(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [jsonable(item) for item in value]
    if isinstance(value, np.longdouble):
        return jsonable(float(value))
    if isinstance(value, np.ndarray | np.generic):
        return jsonable(value.tolist())
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    return value
