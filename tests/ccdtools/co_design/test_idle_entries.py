"""Entries of the design that change nothing, alone or together, are named; those that act anywhere are not."""

import casadi as ca
import numpy as np
import pytest
from idle_design_entries import DISGUISES, PLACES, SPLIT, TOGETHER, named, told

import ccdtools as cc


@pytest.mark.parametrize("number", range(len(DISGUISES)))
def test_an_entry_that_enters_nowhere_is_named_however_it_is_disguised(number):
    assert named(number, acts=False)


@pytest.mark.parametrize("number", range(len(PLACES)))
def test_an_entry_that_acts_at_one_place_is_not_named(number):
    assert not named(number, acts=True)


def test_an_entry_that_acts_only_beyond_a_stop_and_a_fixed_one_are_let_be():
    x, u, w, p = ca.SX.sym("x", 2), ca.SX.sym("u"), ca.SX.sym("w"), ca.SX.sym("p", 2)
    stop = p[0] * ca.fmax(ca.fabs(x[0]) - 0.95, 0) * ca.sign(x[0])
    space = cc.DesignSpace(["stop", "spare"], [1.0, 3.0], [9.0, 3.0])
    plant = cc.Plant(x, u, w, p, x + 0.1 * ca.vertcat(x[1], u + w - stop), space, dt=0.1, continuous=False)
    cc.CoDesignProblem(
        cc.discretise(plant), X=(-1, 1), U=(-1, 1), objective=cc.QuadraticObjective(np.eye(2), [[1.0]]), steps=5,
        scenarios=cc.FixedStart([0.1, 0.0], cc.Gaussian([0.1])),
    )  # fmt: skip


@pytest.mark.parametrize("number", range(len(TOGETHER)))
def test_entries_that_act_only_together_are_named(number):
    assert told(number).startswith("k, q act only together, in 1 of 2 directions: ")


@pytest.mark.parametrize("number", range(len(SPLIT)))
def test_entries_that_act_apart_at_one_place_are_not_named(number):
    assert told(number, SPLIT[number]) == ""


def oscillator(dynamics, deviation=0.1):
    """A co-design of a stiffness made of two entries k and l, and of m, which scales the disturbance."""
    x, u, w, p = ca.SX.sym("x", 2), ca.SX.sym("u"), ca.SX.sym("w"), ca.SX.sym("p", 3)
    space = cc.DesignSpace(["k", "l", "m"], [1.0, 1.0, 1.0], [3.0, 3.0, 2.0])
    plant = cc.Plant(x, u, w, p, ca.vertcat(x[1], dynamics(p) * x[0] - x[1] + u + p[2] * w), space, dt=0.1)
    return cc.CoDesignProblem(
        cc.discretise(plant), X=(-9, 9), U=(-1, 1), objective=cc.QuadraticObjective(np.eye(2), [[1.0]]), steps=10,
        scenarios=cc.FixedStart([1.0, 0.0], cc.Gaussian([deviation])),
    )  # fmt: skip


def test_the_notes_of_a_result_name_the_entries_of_which_one_is_free():
    problem = oscillator(lambda p: -p[0] * p[1])
    result = cc.codesign(problem, method=cc.Nested(runs=8, starts=1, evaluations=2), rng=np.random.default_rng(0))
    assert any("k, l act only together, in 1 of 2 directions" in note for note in result.notes)


def test_an_entry_that_scales_only_a_disturbance_of_zero_is_named():
    oscillator(lambda p: -p[0] - p[1])
    with pytest.raises(cc.InputError, match=r"the entry m, .* but what a disturbance of zero does"):
        oscillator(lambda p: -p[0] - p[1], deviation=0.0)
