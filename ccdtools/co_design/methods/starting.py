"""Where the searches of a method start from."""

from __future__ import annotations

import numpy as np

from ccdtools.arrays import Array
from ccdtools.co_design.result import Valley
from ccdtools.plants.design_space import DesignSpace

SAME_PLACE = 0.02  # of the box: two starts this close are one


def start_points(space: DesignSpace, design: Array, found: tuple[Valley, ...], most: int) -> list[Array]:
    """The given design, and the bottoms of the best valleys that lie elsewhere, in the unit box."""
    starts = [space.allowed.rounded(space.to_unit(design))]
    for valley in found:
        v = space.to_unit(valley.design)
        if len(starts) < most and all(np.abs(v - one).max() > SAME_PLACE for one in starts):
            starts.append(v)
    return starts
