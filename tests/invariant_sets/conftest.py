"""Fixtures shared by the tests of `invariant_sets`."""

import numpy as np
import pytest


@pytest.fixture
def rng():
    """Return a seeded generator."""
    return np.random.default_rng(20240611)
