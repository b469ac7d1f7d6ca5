"""What test_depth_outside.py claims, seen from inside."""

import copy
import pickle

import numpy as np
from scipy import signal

from ccdtools import depth_outside, excursions
from ccdtools.limits import Excursions, further_outside
from ccdtools.output_limits import limits_of
from invariant_sets import Polytope

BOX = Polytope.from_bounds([-1.0, -0.5], [3.0, 0.5])  # half-widths 2 and 0.5


def test_limits_and_excursions_can_be_copied_and_pickled():
    made = excursions([[5, 0.0]], BOX)
    for again in (copy.deepcopy(made), pickle.loads(pickle.dumps(made))):
        assert repr(again) == repr(made)
    limits = limits_of(BOX)
    x, nothing = np.array([5, 0.0]), np.zeros(0)
    depths = limits.depths(x, nothing, nothing)
    np.testing.assert_array_equal(depths.max(), depth_outside(x, BOX))
    np.testing.assert_array_equal(pickle.loads(pickle.dumps(limits)).depths(x, nothing, nothing), depths)


def peaks(values, fraction=0.0, **options):
    """Excursions with these peaks."""
    n = len(values)
    return Excursions(np.full(n, fraction), np.zeros(n), np.asarray(values, dtype=float), **options)


def test_further_outside_needs_a_difference_that_is_certain_and_matters(rng):
    noise = rng.uniform(0, 0.2, 60)
    assert further_outside(peaks(noise + 0.05), peaks(noise))
    assert not further_outside(peaks(noise + 0.005), peaks(noise))  # certain, but too small to matter
    assert not further_outside(peaks(noise / 10 + 0.004), peaks(noise / 10))  # so it is where the other does nothing
    assert further_outside(peaks(noise / 10 + 0.03), peaks(noise / 10))
    assert not further_outside(peaks(noise + 0.05 + 2 * rng.standard_normal(60)), peaks(noise))  # chance
    assert not further_outside(peaks(noise + 2.05), peaks(noise + 2.0))  # a fortieth of what the other does
    assert further_outside(peaks(noise, 0.2), peaks(noise, 0.1))  # not deeper, but more often
    assert not further_outside(peaks([1.0]), peaks([0.0]))  # a single run is no evidence
    assert not further_outside(peaks([]), peaks([]))


def test_stretches_of_one_run_are_one_correlated_series():
    """Peaks of stretches that wander slowly: as independent values they would be told apart in most of the trials."""
    told = {True: 0, False: 0}
    for seed in range(100):
        steps = np.random.default_rng(seed).standard_normal((2, 60))
        one, other = (np.abs(0.3 * signal.lfilter([1], [1, -0.9], s)) for s in steps)
        for stretches in told:
            told[stretches] += further_outside(peaks(one, single=stretches), peaks(other, single=stretches))
    assert told[True] <= 8 < 15 <= told[False]
    noise = np.random.default_rng(0).uniform(0, 0.2, 60)
    assert further_outside(peaks(noise + 0.3, single=True), peaks(noise[::-1], single=True))
