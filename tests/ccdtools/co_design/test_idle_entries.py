"""An entry of the design that changes nothing is named when the problem is stated; one that acts anywhere is not."""

import casadi as ca
import numpy as np
import pytest
from idle_design_entries import DISGUISES, PLACES, named

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
