"""Which sets the expert's data come from: by a budget of work, by option, and in many dimensions."""

import itertools
import re
from dataclasses import replace

import casadi as ca
import numpy as np
import pytest

import ccdtools as cc
from ccdtools import progress
from ccdtools.co_design import candidates, expert_dataset, feasible_sets
from ccdtools.co_design.candidates import SetBudget, affordable_designs, found_sets, limited, starts
from ccdtools.co_design.expert_loops import expert_law
from ccdtools.co_design.lqr_regions import LQRRegions
from invariant_sets import AdmissibleInputs, ParametricSet, Polytope, maximal_positively_invariant_set


def chain(masses, *, inputs=1, unit=1.0):
    """Weakly damped masses between springs, pushed at the far end; every state in units of `unit` metres."""
    x = ca.SX.sym("x", 2 * masses)
    u = ca.SX.sym("u", inputs)
    w = ca.SX.sym("w")
    p = ca.SX.sym("p")
    place = ca.vertcat(0, x[:masses])
    speed = ca.vertcat(0, x[masses:])
    force = -p * (place[1:] - place[:-1]) - 0.02 * (speed[1:] - speed[:-1])
    push = ca.vertcat(w, ca.SX.zeros(masses - 2), u[0]) / unit
    if inputs == 2:
        push += ca.vertcat(u[1], ca.SX.zeros(masses - 1)) / unit
    acceleration = force - ca.vertcat(force[1:], 0) + push
    space = cc.DesignSpace(["k"], [1.0], [4.0])
    plant = cc.Plant(x, u, w, p, ca.vertcat(x[masses:], acceleration), space, dt=0.1)
    half = np.repeat([1.0, 1.5], masses) / unit
    start = np.repeat([0.3, 0.0], masses) / unit
    return cc.CoDesignProblem(
        cc.discretise(plant, sampling_guard="ignore"), X=Polytope.from_bounds(-half, half),
        U=Polytope.from_bounds(-np.ones(inputs), np.ones(inputs)),
        objective=cc.QuadraticObjective(unit**2 * np.eye(2 * masses), 0.1 * np.eye(inputs)),
        scenarios=cc.FixedStart(start, cc.Gaussian([0.05])),
    )  # fmt: skip


def rail():
    """A mass on a rail whose speed limit LQR does not know; the mass is the design."""
    x = ca.SX.sym("x", 2)
    u = ca.SX.sym("u")
    w = ca.SX.sym("w")
    p = ca.SX.sym("p")
    space = cc.DesignSpace(["m"], [0.5], [2.0], units=["kg"])
    plant = cc.Plant(x, u, w, p, ca.vertcat(x[1], (u + w) / p), space, dt=0.1)
    return cc.CoDesignProblem(
        cc.discretise(plant), X=Polytope.from_bounds([-1.0, -0.2], [1.0, 0.2]), U=Polytope.from_bounds([-1.0], [1.0]),
        objective=cc.QuadraticObjective(np.diag([10.0, 0.1]), [[0.1]]),
        scenarios=cc.FixedStart([0.5, 0.0], cc.Gaussian([0.01])),
    )  # fmt: skip


def box_samples(problem, n, seed=0):
    """States uniform in X and designs uniform in the box."""
    rng = np.random.default_rng(seed)
    lower, upper = problem.X.bounding_box()
    return lower + rng.random((n, len(lower))) * (upper - lower), problem.design.latin_hypercube(n, rng)


class Clock:
    """A clock on which every look costs `seconds`."""

    def __init__(self, seconds):
        self.now = 0.0
        self.seconds = seconds

    def __call__(self):
        self.now += self.seconds
        return self.now


@pytest.fixture
def no_sets(monkeypatch):
    """Have every computation of a set fail the test."""

    def computed(*_):
        raise AssertionError("a set was computed")

    monkeypatch.setattr(ParametricSet, "result", computed)


# --- the region that saturated LQR keeps ---------------------------------------------------------------------


@pytest.mark.check
def test_the_lqr_region_is_part_of_the_maximal_set_and_nearly_all_of_it(study):
    problem = study.problem()
    x, p = box_samples(problem, 300)
    region = LQRRegions.of(problem, p).contains(x, np.arange(300))
    largest = np.array([feasible_sets(problem).at(pi).contains(xi, tol=1e-6) for xi, pi in zip(x, p)])
    assert not (region & ~largest).any()
    assert region.sum() > 0.95 * largest.sum()


@pytest.mark.check
def test_without_saturation_the_lqr_region_is_the_maximal_positively_invariant_set(suspension):
    problem = replace(suspension.problem(), U=Polytope.from_bounds([-1e6], [1e6]))
    x, p = box_samples(problem, 400)
    p[:] = suspension.p0
    regions = LQRRegions.of(problem, p)
    closed = regions.A[0] - regions.B[0] @ regions.K[0]
    expected = maximal_positively_invariant_set(closed, problem.X).set.contains(x)
    np.testing.assert_array_equal(regions.contains(x, np.arange(400)), expected)
    assert 0.2 < expected.mean() < 0.95


@pytest.mark.check
def test_the_lqr_region_does_not_depend_on_units():
    near, far = (chain(3, unit=unit) for unit in (1.0, 1e-6))
    x, p = box_samples(near, 200)
    runs = np.arange(200)
    inside = LQRRegions.of(near, p).contains(x, runs)
    np.testing.assert_array_equal(inside, LQRRegions.of(far, p).contains(x * 1e6, runs))
    assert 0.1 < inside.mean() < 0.6


@pytest.mark.long
def test_a_state_scaled_by_its_reach_lies_in_the_region_and_scaled_further_does_not():
    problem = chain(3)
    x, p = box_samples(problem, 200)
    runs = np.arange(200)
    regions = LQRRegions.of(problem, p)
    outside = runs[~regions.contains(x, runs)]
    reach = regions.reach(x[outside], outside)
    assert regions.contains(reach[:, None] * x[outside], outside).all()
    assert (reach > 0.1).all()
    assert not regions.contains(1.02 * reach[:, None] * x[outside], outside).any()


# --- data where X_fea cannot be had --------------------------------------------------------------------------


@pytest.mark.parametrize("inputs", [1, 2])
def test_a_chain_of_eight_states_has_data_from_the_lqr_region_and_from_the_start_of_the_episodes(inputs):
    problem = chain(4, inputs=inputs)
    data = expert_dataset(problem, samples=40, rng=np.random.default_rng(0), time_limit=1.0)
    assert data.sets.lqr == 40
    assert data.sets.feasible == 0
    assert "X_fea(p) was not found" in data.sets.reason
    assert data.sets.seconds > 0.0
    assert data.acceptance < 0.5
    assert data.diverged == 0.0
    x0 = problem.scenarios.x0
    assert (data.inputs[:, :8] == x0).all(axis=1).sum() == 10
    regions = LQRRegions.of(problem, data.inputs[:40, 8:])
    assert regions.contains(data.inputs[:40, :8], np.arange(40)).mean() > 0.7


def test_a_set_that_is_tiny_beside_x_is_sampled_by_moving_states_into_it(illustrative):
    problem = replace(illustrative.problem(), X=Polytope.from_bounds([-1e4, -1e4], [1e4, 1e4]))
    begin = starts(problem, feasible_sets(problem), 30, None, SetBudget("auto"), np.random.default_rng(0))
    assert begin.acceptance == 0.0
    assert begin.candidates == 30
    first = begin.x[:30]
    assert all(S.contains(x) for S, x in zip(begin.sets, first))
    assert len(np.unique(first, axis=0)) == 30
    gauge = np.array([(S.A @ x / S.b).max() for S, x in zip(begin.sets, first)])
    assert gauge.min() < 0.6  # spread over the sets, not only their boundaries
    assert gauge.max() > 0.9


def test_runs_that_are_being_lost_are_not_imitated():
    problem = chain(2)
    shaken = replace(problem, scenarios=cc.FixedStart(np.zeros(4), cc.Gaussian([30.0])))
    data = expert_dataset(shaken, samples=20, rng=np.random.default_rng(0), sets="none")
    assert (np.abs(data.inputs[:, :4]) <= 2 * problem.state_scale).all()
    assert len(data.inputs) > 20


# --- by option -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("option", "lqr", "limits"), [("none", 0, 30), ("lqr", 30, 0)])
def test_no_set_is_computed_where_none_is_asked_for(illustrative, no_sets, option, lqr, limits):
    data = expert_dataset(illustrative.problem(), samples=30, rng=np.random.default_rng(0), sets=option)
    assert (data.sets.feasible, data.sets.lqr, data.sets.limits) == (0, lqr, limits)
    assert data.sets.reason == f'sets = "{option}"'


def test_without_sets_every_state_of_x_is_accepted_and_inputs_are_saturated_lqr(illustrative):
    problem = illustrative.problem()
    data = expert_dataset(problem, samples=30, rng=np.random.default_rng(0), sets="none")
    assert data.acceptance == 1.0
    regions = LQRRegions.of(problem, data.inputs[:30, 2:])
    np.testing.assert_allclose(data.actions[:30], regions.inputs(data.inputs[:30, :2], np.arange(30)), atol=1e-12)


@pytest.mark.parametrize(("argument", "value"), [("sets", "some"), ("sets", None), ("time_limit", 0.0), ("echo", 3)])
def test_wrong_options_are_refused(illustrative, argument, value):
    with pytest.raises(cc.InputError, match=f"{argument}: got"):
        expert_dataset(illustrative.problem(), samples=5, rng=np.random.default_rng(0), **{argument: value})


# --- by work, which every machine counts alike ---------------------------------------------------------------


@pytest.mark.parametrize("slower", [1.0, 50.0])
def test_the_sets_do_not_depend_on_how_fast_the_processor_is(monkeypatch, slower):
    """A clock that runs fifty times as fast stands for a machine that is as much slower."""
    problem = rail()
    clock = candidates.time.thread_time
    monkeypatch.setattr(candidates.time, "thread_time", lambda: slower * clock())
    budget = SetBudget("auto", 20.0)
    family = limited(feasible_sets(problem), budget)
    assert affordable_designs(problem, family, 1000, budget) == (1000, "")
    sets, counts = found_sets(family, problem.design.latin_hypercube(10, np.random.default_rng(0)), budget)
    assert (counts.feasible, counts.reason) == (10, "")
    assert all(S is not None for S in sets)


def test_candidates_share_as_many_designs_as_the_budget_allows_and_none_below_sixty_four(illustrative):
    problem = illustrative.problem()
    family = feasible_sets(problem)
    many, fewer, none = (affordable_designs(problem, family, 10**6, SetBudget("auto", t)) for t in (2000.0, 0.2, 1e-3))
    assert many == (10**6, "")
    assert 64 <= fewer[0] < 10**4
    assert none == (0, "X_fea(p) of 64 designs is more work than allowed")


def test_designs_that_an_abort_does_not_reach_get_no_set_and_the_reason_is_said(illustrative, monkeypatch):
    problem = illustrative.problem()
    designs = problem.design.latin_hypercube(10, np.random.default_rng(0))
    monkeypatch.setattr(candidates.time, "thread_time", Clock(1.0))
    sets, counts = found_sets(feasible_sets(problem), designs, SetBudget("auto", 1.0))
    assert [S is not None for S in sets] == 4 * [True] + 6 * [False]
    assert (counts.feasible, counts.lqr) == (4, 6)
    assert "another machine may get further" in str(counts)


@pytest.mark.check
def test_cheap_sets_do_not_depend_on_the_time_limit(illustrative):
    problem = illustrative.problem()
    a, b = (expert_dataset(problem, samples=40, rng=np.random.default_rng(1), time_limit=t) for t in (20.0, None))
    np.testing.assert_array_equal(a.inputs, b.inputs)
    np.testing.assert_array_equal(a.actions, b.actions)
    assert a.sets.feasible == b.sets.feasible == 40


# --- the filter ----------------------------------------------------------------------------------------------


def test_runs_that_share_a_design_are_filtered_as_each_would_be_alone():
    problem = rail()
    begin = starts(problem, feasible_sets(problem), 60, 4, SetBudget("auto"), np.random.default_rng(0))
    found = expert_law(problem, begin, "lqr", 10)(begin.x)
    regions = begin.regions
    wanted = regions.inputs(begin.x, np.arange(len(begin.x)))
    changed = 0
    for i, S in enumerate(begin.sets):
        alone = AdmissibleInputs(regions.A[i], regions.B[i], S, problem.U).project(begin.x[i], wanted[i])[0]
        np.testing.assert_allclose(found[i], alone, atol=1e-6)
        changed += bool(np.abs(alone - wanted[i]).max() > 1e-3)
    assert changed > 10


# --- progress without a terminal -----------------------------------------------------------------------------


@pytest.mark.check
def test_what_takes_long_says_how_far_it_is(illustrative, monkeypatch):
    monkeypatch.setattr(progress, "SECONDS_BETWEEN_LINES", 0.001)
    lines = []
    expert_dataset(illustrative.problem(), samples=200, rng=np.random.default_rng(0), echo=lines.append)
    assert lines
    assert all(re.match(r"    … .*, after \d+ s", line) for line in lines)


def test_what_is_quick_says_nothing(illustrative):
    lines = []
    expert_dataset(illustrative.problem(), samples=5, rng=np.random.default_rng(0), echo=lines.append)
    assert not lines
    assert list(itertools.islice(progress.counted(itertools.count(), "n", total=3), 3)) == [0, 1, 2]


def pushed(mean, *, swing):
    """A spring, or a pendulum, pushed by a disturbance with a mean."""
    x, u, w, p = ca.SX.sym("x", 2), ca.SX.sym("u"), ca.SX.sym("w"), ca.SX.sym("p")
    back = ca.sin(x[0]) if swing else x[0]
    space = cc.DesignSpace(["k"], [0.5], [5.0])
    plant = cc.Plant(x, u, w, p, ca.vertcat(x[1], -p * back - 0.3 * x[1] + u + w), space, dt=0.1)
    return cc.CoDesignProblem(
        cc.discretise(plant), X=(-1.0, 1.0), U=(-1.0, 1.0),
        objective=cc.QuadraticObjective(np.diag([1.0, 0.1]), [[0.05]]),
        scenarios=cc.FixedStart([0.5, 0.0], cc.Gaussian([0.01], [mean])),
    )  # fmt: skip


@pytest.mark.long
@pytest.mark.parametrize("swing", [False, True])
def test_the_region_of_lqr_is_that_of_the_loop_that_is_pushed(swing):
    problem, still = (pushed(mean, swing=swing) for mean in (0.8, 0.0))
    states, designs = np.random.default_rng(0).uniform(-1, 1, (400, 2)), np.full((400, 1), 2.0)
    found, at_rest = (LQRRegions.of(one, designs).contains(states, np.arange(400)) for one in (problem, still))
    law, x, step = cc.saturated_lqr(problem, [2.0]), states, problem.model.stepper(np.array([2.0]), batch=400)
    kept = np.ones(400, dtype=bool)
    for _ in range(600):
        x = np.asarray(step(x, law(x), np.tile(problem.mean_disturbance, (400, 1))))
        kept &= (np.abs(x) <= 1 + 1e-6).all(axis=1)
    np.testing.assert_array_equal(found, kept)
    assert (found != at_rest).sum() > 10
