"""What test_combinations.py claims, seen from inside."""

import numpy as np
import pytest

from ccdtools import Gaussian, Recorded
from ccdtools.disturbances import Constant, Mixture, Stacked, Sum, Uniform
from ccdtools.disturbances.combinations import is_recorded

MASS = Constant(Uniform([-0.2], [0.4]))


@pytest.mark.parametrize("wrap", [
    lambda d: d, lambda d: Sum((Gaussian([0.1]), d)), lambda d: Stacked((Gaussian([0.1]), d)),
    lambda d: Mixture((Gaussian([0.1]), d)), Constant, lambda d: Stacked((Sum((d,)), MASS)),
])  # fmt: skip
def test_a_recording_is_found_in_whatever_holds_it(wrap):
    assert is_recorded(wrap(Recorded(np.zeros(9))))
    assert not is_recorded(wrap(Gaussian([0.1])))
