"""Oscillations that the sampling time does not resolve are found wherever in the box they are."""

import warnings

import casadi as ca
import pytest
from study_plants import quarter_car

from ccdtools import DesignSpace, Plant, discretise
from ccdtools.exceptions import SamplingWarning


def oscillator(stiffness, design, dt, damping=0.0):
    """ẍ = −stiffness(p) x − damping ẋ + u."""
    x, u, p = ca.SX.sym("x", 2), ca.SX.sym("u"), ca.SX.sym("p")
    return Plant(x, u, None, p, [x[1], -stiffness(p) * x[0] - damping * x[1] + u], design, dt=dt)


def test_the_wheel_hop_of_the_suspension_is_found_where_it_is_fastest():
    with pytest.warns(SamplingWarning, match=r"at most 10 Hz, but the plant oscillates at 10.3 Hz at k_s = 40000 N/m, "
                                             r"c_s = 500 N·s/m.*dt = 0.0097 s has ten"):  # fmt: skip
        discretise(quarter_car())


def test_an_intended_sampling_time_is_taken_without_a_warning():
    discretise(quarter_car(), sampling_guard="ignore")


def test_the_recommended_sampling_time_draws_no_warning():
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        discretise(quarter_car(), dt=0.0097)


def test_a_mode_that_dies_within_one_sample_is_not_warned_of():
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        discretise(oscillator(lambda p: p * 1e4, DesignSpace(["p"], [1], [2]), dt=0.1, damping=120.0))


def test_a_discrete_plant_has_no_modes_to_judge():
    x, u, p = ca.SX.sym("x"), ca.SX.sym("u"), ca.SX.sym("p")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        discretise(Plant(x, u, None, p, -p * x + u, DesignSpace(["p"], [0.1], [0.9]), dt=1.0, continuous=False))
