"""Experiments that would tell what a log leaves open, and what they tell when they are run."""

import casadi as ca
import numpy as np
import pytest

from ccdtools import (
    CoDesignProblem,
    DesignSpace,
    FixedStart,
    Gaussian,
    InputError,
    LinearFeedback,
    Plant,
    QuadraticObjective,
    deploy,
    discretise,
    saturated_lqr,
)
from ccdtools.twin import fit_plant, plan_experiment

P, START, W = np.array([2.0]), [1.0, 0.0], Gaussian([0.3])


def cart(mass=1.0, drag=0.5, names=()):
    """Cart behind a spring; with unknown entries besides, of which "belt" and "motor" act as one."""
    x, u, w, p = ca.SX.sym("x", 2), ca.SX.sym("u"), ca.SX.sym("w"), ca.SX.sym("p", 1 + len(names))
    known = dict(zip(("k", *names), ca.vertsplit(p)))
    force = known.get("belt", 1.0) * known.get("motor", 1.0) * u - known["k"] * x[0] - known.get("drag", drag) * x[1]
    box = DesignSpace(["k", *names], [0.5] + [0.2] * len(names), [4.0] + [3.0] * len(names))
    return Plant(x, u, w, p, [x[1], (force + w) / known.get("mass", mass)], box, dt=0.25)


def problem_of(X=4.0):
    return CoDesignProblem(discretise(cart()), X=(-X, X), U=(-3, 3), objective=QuadraticObjective(np.eye(2), [[0.1]]),
                           scenarios=FixedStart(START, W), steps=60)  # fmt: skip


def run_on(real, law, runs=10, seed=0):
    return deploy(real, law, P, W.sample(runs, 60, np.random.default_rng(seed)), x0=START)


def planned(problem=None, seed=0, *, names=(), **options):
    """Plan for what LQR on a heavier cart leaves open."""
    problem = problem_of() if problem is None else problem
    law = saturated_lqr(problem, P)
    fit = fit_plant(problem, run_on(cart(1.4), law, seed=seed), plant=cart(names=names) if names else None)
    return fit, plan_experiment(problem, fit, law, P, rng=np.random.default_rng(seed), **options)


@pytest.mark.long
def test_the_experiment_that_is_named_tells_what_the_loop_leaves_open():
    problem = problem_of()
    log = run_on(cart(1.4), saturated_lqr(problem, P))
    fit, plan = planned(problem)
    assert fit.status.name == "OPEN"
    assert "plan_experiment" in fit.advice
    assert plan.candidates[0].open
    assert plan.status.name == "FOUND"
    assert set(plan.names) <= {"w1 by x1", "w1 by x2", "w1 by u1"}
    after = fit_plant(problem, [log, run_on(cart(1.4), plan.best.controller, seed=1)])
    assert after.status.name == "SOLVED"
    found = np.diff(after.intervals(), axis=1)[plan.places, 0] / 2
    assert (found < 1.6 * plan.best.half_widths[plan.places]).all()
    assert (plan.best.half_widths[plan.places] <= plan.asked).all()
    for said in (plan.best.words, "w1 by x2 ± ", "asked", "a run"):
        assert said in plan.advice


@pytest.mark.check
def test_what_no_excitation_tells_apart_stays_open():
    fit, plan = planned(names=("belt", "motor"))
    assert fit.status.name == plan.status.name == "OPEN"
    assert plan.names == ("belt", "motor")
    assert "measure another output" in plan.advice


@pytest.mark.check
def test_more_is_asked_than_so_many_runs_tell():
    fit, plan = planned(names=("mass", "drag"), within=1e-4)
    assert fit.status.name == "SOLVED"
    assert plan.status.name == "LONGER"
    assert plan.names == ("mass", "drag")
    widths = [(one.half_widths[plan.places] / plan.asked).max() for one in plan.candidates]
    assert plan.best is plan.candidates[int(np.argmin(widths))]


@pytest.mark.check
def test_no_candidate_leaves_the_limits_more_often_than_the_loop():
    _, plan = planned(problem_of(1.6))
    _, wide = planned()
    assert len(plan.candidates) < len(wide.candidates)
    assert all(one.outside <= plan.candidates[0].outside for one in plan.candidates)
    assert all((np.abs(one.controller(np.zeros(2), time=3)) <= 3).all() for one in wide.candidates[1:-2])


def test_a_plan_that_cannot_be_made_is_named():
    problem = problem_of()
    fit, _ = planned(problem)
    law = saturated_lqr(problem, P)
    for wrong, name in (({"runs": 0}, "runs"), ({"within": 0.0}, "within"), ({"rng": 1}, "rng")):
        with pytest.raises(InputError, match=name):
            plan_experiment(problem, fit, law, P, **({"rng": np.random.default_rng(0)} | wrong))
    with pytest.raises(InputError, match="a PlantFit"):
        plan_experiment(problem, run_on(cart(), law), law, P, rng=np.random.default_rng(0))
    with pytest.raises(InputError, match=r"controller.*loses 10 of 10 runs"):
        plan_experiment(problem, fit, LinearFeedback([[-90.0, -90.0]]), P, rng=np.random.default_rng(0))


@pytest.mark.check
def test_predicted_intervals_are_those_of_fits_after_the_experiment():
    problem, ratios = problem_of(), []
    for seed in range(10):
        fit, plan = planned(problem, seed, names=("mass", "drag"), within=0.02)
        logs = [run_on(cart(1.4), saturated_lqr(problem, P), seed=seed)]
        logs.append(run_on(cart(1.4), plan.best.controller, seed=100 + seed))
        after = fit_plant(problem, logs, plant=cart(names=("mass", "drag")))
        ratios.append(np.diff(after.intervals(), axis=1)[:2, 0] / 2 / plan.best.half_widths[:2])
        assert fit.status.name == "SOLVED"
    assert 0.85 < np.mean(ratios) < 1.15
