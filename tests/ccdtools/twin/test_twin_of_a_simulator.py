"""Twins, replays and fits of a plant of which only a step is known, beside the same plant in CasADi."""

from dataclasses import replace

import casadi as ca
import numpy as np
import pytest

from ccdtools import (
    CoDesignProblem,
    DesignSpace,
    DigitalTwin,
    FixedStart,
    Gaussian,
    InputError,
    Nested,
    Plant,
    QuadraticObjective,
    closed_loop_returns,
    codesign,
    deploy,
    discretise,
    saturated_lqr,
    simulate,
)
from ccdtools.plants import BlackBox
from ccdtools.twin import fit_plant, replay_problem, updated_problem
from learning import QuantileConfig

DESIGN = np.array([1.5])


def plant(drag=0.3, names=()):
    """Cart of mass m with friction, a tenth of a second later; gusts push with their cube."""
    x, u, w, p = ca.SX.sym("x", 2), ca.SX.sym("u"), ca.SX.sym("w"), ca.SX.sym("p", 1 + len(names))
    friction = p[1] if names else drag
    v = x[1] + 0.1 * (u + w + w**3 - friction * ca.tanh(x[1])) / p[0]
    box = DesignSpace(["m", *names], [0.5, *(0.0 for _ in names)], [2.0, *(1.0 for _ in names)])
    return Plant(x, u, w, p, ca.vertcat(x[0] + 0.1 * v, v), box, dt=0.1, continuous=False)


MODEL = discretise(plant())
BOX = BlackBox(
    lambda x, u, w, p: MODEL.stepper(p, batch=len(x))(x, u, w), nx=2, nu=1, nw=1, dt=0.1, design=MODEL.design,
    batched=True,
)  # fmt: skip


def problem(model):
    return CoDesignProblem(
        model, X=([-2.0, -2.0], [2.0, 2.0]), U=([-1.0], [1.0]), steps=30, limit_tolerance="off",
        scenarios=FixedStart([1.0, 0.0], Gaussian([0.2])),
        objective=QuadraticObjective(np.eye(2), [[0.1]], design_cost=lambda p: 2.0 / p[0]),
    )  # fmt: skip


PROBLEMS = [problem(MODEL), problem(BOX)]
LAW = saturated_lqr(PROBLEMS[0], DESIGN)
LOG = deploy(
    discretise(plant(drag=0.8)), LAW, DESIGN, Gaussian([0.2]).sample(3, 200, np.random.default_rng(0)),
    x0=np.tile([1.0, 0.0], (3, 1)),
)  # fmt: skip


def taught(model):
    return DigitalTwin(model).update(
        LOG, weight=np.eye(2), rng=np.random.default_rng(1), config=QuantileConfig(hidden=(16,), steps=30)
    )


def test_a_twin_learns_of_a_simulator_what_it_learns_of_the_plant():
    known = taught(MODEL)
    for model in (BOX, PROBLEMS[1].model):
        found = taught(model)
        assert found.scores == known.scores
        np.testing.assert_allclose(found.transport.inverse, known.transport.inverse, rtol=1e-6)
        older = replace(known.logs[0].part(slice(1), slice(50)), p=np.array([0.7]))
        exact, carried = (replace(one, logs=(older, *one.logs)).carried()[0].e_next for one in (known, found))
        np.testing.assert_allclose(carried, exact, atol=1e-8)


def returned(problem):
    return closed_loop_returns(problem, LAW, [0.7], np.random.default_rng(0), runs=20).values


def test_an_updated_problem_of_a_simulator_returns_what_that_of_the_plant_does():
    known, found = (updated_problem(one, taught(model)) for one, model in zip(PROBLEMS, (MODEL, BOX)))
    np.testing.assert_allclose(returned(found), returned(known), rtol=1e-6)


@pytest.mark.check
@pytest.mark.parametrize(
    "learned", [lambda p: updated_problem(p, taught(p.model)), lambda p: replay_problem(p, LOG, 50)]
)
def test_what_a_log_told_of_a_simulator_is_designed_for_as_of_the_plant(learned):
    method = Nested(runs=16, starts=1)
    known, found = (codesign(learned(p), method=method, rng=np.random.default_rng(0)) for p in PROBLEMS)
    np.testing.assert_allclose(found.design, known.design, rtol=1e-3)


def test_a_log_of_a_simulator_is_a_plant_that_does_again_what_was_logged():
    replayed = [replay_problem(one, LOG, 100) for one in PROBLEMS]
    (x0, errors), (_, known) = (one.scenarios.whole() for one in replayed[::-1])
    np.testing.assert_allclose(errors, known, atol=1e-6)
    again = simulate(replayed[1].model, LAW, x0=x0, steps=200, disturbance=errors, design=DESIGN)
    np.testing.assert_allclose(again.states, LOG.states, rtol=1e-9, atol=1e-9)
    for exact, found in zip(*(one.model.matrices(DESIGN) for one in replayed)):
        np.testing.assert_allclose(found, exact, atol=1e-6)
    np.testing.assert_allclose(*(returned(one) for one in replayed), rtol=1e-6)


def test_a_fit_beside_a_simulator_takes_a_plant_with_what_is_unknown():
    with pytest.raises(InputError, match=r"problem\.model: got .*BlackBox.*Pass plant=, with what is unknown"):
        fit_plant(PROBLEMS[1], LOG)
    found = [fit_plant(one, LOG, plant=plant(names=("drag",))) for one in PROBLEMS]
    assert found[1].values == pytest.approx(found[0].values)
    assert found[1].values[0] == pytest.approx(0.8, abs=0.1)
    assert updated_problem(PROBLEMS[1], found[1]).model.nw >= 1
