"""What a co-design is refused for, and what its expert learns from, turns at the stated numbers."""

import casadi as ca
import numpy as np
import pytest

import ccdtools as cc


def scalar(after, design=("p",), **changes):
    """A problem of one state, x⁺ = after(x, u, p), within ±1."""
    x, u, w, p = ca.SX.sym("x"), ca.SX.sym("u"), ca.SX.sym("w"), ca.SX.sym("p", len(design))
    space = cc.DesignSpace(list(design), [0.0] * len(design), [1.0] * len(design))
    plant = cc.Plant(x, u, w, p, after(x, u, p) + w, space, dt=1.0, continuous=False)
    given = {"X": (-1, 1), "U": (-1, 1), "steps": 5, "objective": cc.QuadraticObjective([[1.0]], [[1.0]]),
             "scenarios": cc.FixedStart([0.5], cc.Gaussian([0.01]))}  # fmt: skip
    return cc.CoDesignProblem(cc.discretise(plant), **(given | changes))


@pytest.mark.parametrize(("eigenvalue", "accepted"), [(-0.6e-9, True), (-6e-9, False)])
def test_a_cross_weight_leaves_the_weights_semidefinite_up_to_a_billionth(eigenvalue, accepted):
    weights = ([[1.0]], [[1.0]], [[1 - eigenvalue]])
    if accepted:
        assert cc.QuadraticObjective(*weights).S.shape == (1, 1)
    else:
        with pytest.raises(cc.InputError, match="makes some steps cost less than nothing"):
            cc.QuadraticObjective(*weights)


@pytest.mark.parametrize(("part", "acts"), [(0.3e-12, False), (3e-12, True)])
def test_an_entry_acts_that_changes_a_trillionth(part, acts):
    if acts:
        assert scalar(lambda x, u, p: (1 + part * p) * x + u).design.dim == 1
    else:
        with pytest.raises(cc.InputError, match="the entry p, which nothing depends on"):
            scalar(lambda x, u, p: (1 + part * p) * x + u)


def test_an_expert_teaches_nothing_beyond_two_half_widths():
    """Every run is lost: from 1 it goes to 1.5, to 2.25, and on."""
    problem = scalar(lambda x, u, p: 1.5 * x + (1 + p) * u, U=(-1e-3, 1e-3), steps=30)
    data = cc.expert_dataset(problem, samples=100, sets="none", expert="lqr", rng=np.random.default_rng(0))
    assert 1.3 < np.abs(data.inputs[:, 0]).max() <= 2


@pytest.mark.long
@pytest.mark.parametrize(("reach", "moved"), [(0.6, False), (0.08, True)])
def test_candidates_are_moved_into_their_sets_where_fewer_than_a_quarter_lie_there(reach, moved):
    """LQR keeps |x| < reach alone, where half an input holds half a state."""
    problem = scalar(lambda x, u, p: 1.5 * x + (1 + 1e-3 * p) * u, U=(-reach / 2, reach / 2), steps=30)
    data = cc.expert_dataset(problem, samples=200, sets="lqr", expert="lqr", rng=np.random.default_rng(0))
    assert data.acceptance == pytest.approx(reach, abs=0.1)
    assert (len(np.unique(data.inputs[:, 1])) > 150) == moved  # every candidate has a design of its own


@pytest.mark.parametrize(
    ("acts", "found"), [(lambda x: ca.fmax(1e-3 - ca.fabs(x), 0), True), (lambda x: ca.fmax(ca.fabs(x) - 30, 0), False)]
)
def test_entries_are_tried_at_states_from_a_hundred_thousandth_to_ten_times_X(acts, found):
    if found:
        assert scalar(lambda x, u, p: x + u + p * x * acts(x)).design.dim == 1
    else:
        with pytest.raises(cc.InputError, match="the entry p, which nothing depends on"):
            scalar(lambda x, u, p: x + u + p * x * acts(x))
