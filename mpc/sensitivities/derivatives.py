"""Derivatives by parameters, as a user gives them: an array for each quantity, its last axis that of the parameters."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import ArrayLike

from mpc.checks import Array, as_array, as_floats
from mpc.exceptions import InputError
from mpc.tolerances import ASYMMETRY


def as_derivatives(
    given: Mapping[str, tuple[ArrayLike | None, tuple[int, ...]]],
    *,
    symmetric: tuple[str, ...] = (),
    count: int | None = None,
) -> dict[str, Array]:
    """Arrays (*shape, np) of derivatives by name, checked; zeros for what is None.

    Parameters
    ----------
    given : dict of name to (value, shape)
        What was given, and the shape of the quantity itself.
    symmetric : tuple of str
        Those of symmetric matrices.
    count : int, optional
        np; by default what the first array says.

    Raises
    ------
    InputError
        Another shape, numbers of parameters that differ, NaN, or a derivative of a weight that is not symmetric.
    """
    checked: dict[str, Array] = {}
    for name, (value, shape) in given.items():
        if value is None:
            continue
        raw = as_floats(name, value)
        if raw.ndim == len(shape):
            expected = f"({', '.join(map(str, shape))}, np)"
            cure = f"The last axis is that of the parameters; of a single one: {name}[..., None]."
            raise InputError(name, f"shape {raw.shape}", expected, cure)
        array = as_array(name, raw, (*shape, count))
        count = array.shape[-1]
        if name in symmetric:
            gap = float(np.abs(array - array.swapaxes(0, 1)).max(initial=0.0))
            if gap > ASYMMETRY * float(np.abs(array).max(initial=0.0)):
                got = f"max |{name} - {name}'| = {gap:.3g}"
                raise InputError(name, got, "a symmetric matrix for every parameter")
        checked[name] = array
    return {name: checked.get(name, np.zeros((*shape, count or 0))) for name, (_, shape) in given.items()}
