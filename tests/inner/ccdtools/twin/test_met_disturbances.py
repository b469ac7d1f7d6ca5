"""Errors of a nonlinear model are split along its log: a replay is the log, and the disturbances are those met."""

from dataclasses import replace

import casadi as ca
import numpy as np
import pytest
import torch

from ccdtools import (
    CoDesignProblem,
    DesignSpace,
    DigitalTwin,
    FixedStart,
    Gaussian,
    InputError,
    LinearFeedback,
    Plant,
    QuadraticObjective,
    discretise,
    simulate,
)
from ccdtools.co_design.differentiable_model import Stepper
from ccdtools.plants import SampledModel
from ccdtools.twin import replay_problem
from ccdtools.twin.residuals import residuals
from ccdtools.twin.transport import ErrorSplit, check_disturbance_enters

SCALE = np.array([5.0, 5.0])
LAW = LinearFeedback(np.array([[1.0, 1.0]]))
SOFT, STIFF = np.array([2.0]), np.array([4.0])


def drag(w, x):
    return 0.5 * (w - x[1]) * ca.sqrt((w - x[1]) ** 2 + 0.01)


FORCES = {"drag": drag, "w |w|": lambda w, x: 0.5 * w * ca.fabs(w), "w sin(x)": lambda w, x: w * ca.sin(x[0])}


def boat(force="drag", *, units=(1.0, 1.0)) -> Plant:
    """A mass on a hardening spring, the spring as design; wind acts on it.

    The unit of the position is 1/units[0] m, that of the wind 1/units[1] m/s.
    """
    x, u, w, p = ca.SX.sym("x", 2), ca.SX.sym("u"), ca.SX.sym("w"), ca.SX.sym("p")
    at = ca.vertcat(x[0] / units[0], x[1])
    spring = p * (at[0] + 0.1 * at[0] ** 3)
    acceleration = (u + FORCES[force](w / units[1], at) - spring - x[1]) / 2
    return Plant(x, u, w, p, ca.vertcat(units[0] * x[1], acceleration), DesignSpace(["k"], [1.0], [5.0]), dt=0.1)


def logged(model, p, *, std=1.5, units=(1.0, 1.0), runs=4, steps=100):
    """A log of a model from 1 m under random wind, and the wind."""
    w = std * units[1] * np.random.default_rng(0).standard_normal((runs, steps, 1))
    law = LinearFeedback(np.array([[1.0 / units[0], 1.0]]))
    x0 = np.tile([units[0], 0.0], (runs, 1))
    log = simulate(model, law, x0=x0, steps=steps, disturbance=w, design=p, limit=[1e3 * units[0], 1e3])
    return log, w


@pytest.fixture(scope="module")
def model():
    return SampledModel(boat(), 0.1, "rk4", 8)


@pytest.mark.long
@pytest.mark.parametrize("force", FORCES)
@pytest.mark.parametrize("method", ["rk4", "collocation"])
def test_the_disturbances_of_a_log_are_found_and_another_design_meets_them(force, method):
    model = SampledModel(boat(force), 0.1, method, 8 if method == "rk4" else 1)
    log, w = logged(model, SOFT, steps=60)
    met = ErrorSplit(model, SCALE).disturbances(residuals(model, log))
    felt = np.abs(w) > 0.05 if force == "w |w|" else np.abs(np.sin(log.states[:, :-1, :1])) > 0.01
    told = felt if force != "drag" else np.abs(w - log.states[:, :-1, 1:]) > 0.1
    np.testing.assert_allclose(met[..., :1][told], w[told], rtol=1e-4, atol=1e-4)
    there, _ = logged(model, STIFF, steps=60)
    again = simulate(model.with_errors(), LAW, x0=np.tile([1.0, 0.0], (4, 1)), steps=60, disturbance=met, design=STIFF)
    np.testing.assert_allclose(again.states, there.states, atol=1e-6)


@pytest.mark.parametrize(
    ("effect", "wind", "met"), [(0.3, 5.0, 5.0), (0.03, 5.0, 2.0), (0.03, 1.5, 1.5), (3e-6, 1.5, 1.5), (3e-7, 1.5, 0.0)]
)
def test_what_is_hardly_told_is_no_larger_than_twice_what_is_told_and_in_the_end_nothing(effect, wind, met):
    """x⁺ = x + w x₂: one run with the whole effect and w = 1, the other with a part of it."""
    x, u, w, p = ca.SX.sym("x", 2), ca.SX.sym("u"), ca.SX.sym("w"), ca.SX.sym("p")
    after = ca.vertcat(w * x[1] + 0.0 * x[0], x[1] + u)
    model = discretise(Plant(x, u, w, p, after, DesignSpace(["k"], [1.0], [5.0]), dt=1.0, continuous=False))
    log = simulate(model, lambda x: 0 * x[:, :1], x0=[[0.0, 1.0], [0.0, effect]], steps=1, design=SOFT,
                   disturbance=[[[1.0]], [[wind]]])  # fmt: skip
    found = ErrorSplit(model, SCALE).disturbances(residuals(model, log))[:, 0, 0]
    np.testing.assert_allclose(found, [1.0, met], rtol=1e-6)


def test_a_replay_at_the_design_of_a_log_is_the_log_whatever_the_errors(model):
    """The real boat has another drag and a leak that the model does not know."""
    real = SampledModel(_leaking(boat()), 0.1, "rk4", 8)
    log, _ = logged(real, SOFT)
    errors = residuals(model, log)
    problem = CoDesignProblem(
        model, X=([-5, -5], [5, 5]), U=(-5, 5), objective=QuadraticObjective(np.eye(2), [[0.1]]),
        scenarios=FixedStart([1.0, 0.0], Gaussian([1.5])), steps=50,
    )  # fmt: skip
    replayed = replay_problem(problem, [errors], 100)
    x0, w = replayed.scenarios.whole()
    run = simulate(replayed.model, LAW, x0=x0, steps=100, disturbance=w, design=SOFT)
    np.testing.assert_allclose(run.states, log.states, atol=1e-12)
    stepper = Stepper.at(replayed, torch.tensor(SOFT))
    x = torch.tensor(errors.x[:, 0])
    for k in range(100):
        x = stepper.advance(x, torch.zeros_like(x), torch.tensor(errors.u[:, k]), torch.tensor(w[:, k]))[0]
    np.testing.assert_allclose(x.numpy(), log.states[:, -1], atol=1e-12)


def _leaking(plant) -> Plant:
    """The same plant with what the model does not know of: more drag, and a position that drifts."""
    more = ca.vertcat(0.05 * ca.cos(3 * plant.x[1]), -0.3 * plant.x[1])
    return replace(plant, dynamics=plant.dynamics + more)


@pytest.mark.parametrize("force", FORCES)
def test_an_error_that_has_another_cause_makes_no_large_disturbance(force):
    """Where w is hardly felt, what has another cause would need any wind at all: 1.5 m/s were blown, 6.3 at most."""
    model = SampledModel(boat(force), 0.1, "rk4", 4)
    log, w = logged(SampledModel(_leaking(boat(force)), 0.1, "rk4", 4), SOFT)
    errors = residuals(model, log)
    split = ErrorSplit(model, SCALE)
    met = split.disturbances(errors)
    assert np.abs(met[..., 0]).max() < 3 * np.abs(w).max()
    assert (np.linalg.norm(split.rest(errors) / SCALE, axis=-1) <= np.linalg.norm(errors.e_next / SCALE, axis=-1)).all()
    after = model.advance(errors.x, errors.u, met[..., :1], SOFT) + met[..., 1:]
    np.testing.assert_allclose(after, log.states[:, 1:], atol=1e-13)


@pytest.mark.long
@pytest.mark.parametrize("force", FORCES)
def test_the_disturbances_do_not_depend_on_units(force):
    found = []
    for units in ((1.0, 1.0), (1e6, 1e-6), (1e-3, 1e5)):
        log, _ = logged(SampledModel(_leaking_in(units, force), 0.1, "rk4", 4), SOFT, units=units)
        model = SampledModel(boat(force, units=units), 0.1, "rk4", 4)
        met = ErrorSplit(model, SCALE * [units[0], 1.0]).disturbances(residuals(model, log))
        found.append(met / [units[1], units[0], 1.0])
    for other in found[1:]:
        np.testing.assert_allclose(other, found[0], rtol=1e-4, atol=1e-5)


def _leaking_in(units, force) -> Plant:
    """`_leaking` in other units."""
    plant = boat(force, units=units)
    more = ca.vertcat(units[0] * 0.05 * ca.cos(3 * plant.x[1]), -0.3 * plant.x[1])
    return replace(plant, dynamics=plant.dynamics + more)


def test_two_channels_of_which_one_is_not_felt_at_rest():
    x, u, w, p = ca.SX.sym("x", 2), ca.SX.sym("u"), ca.SX.sym("w", 2), ca.SX.sym("p")
    dynamics = ca.vertcat(x[1] + w[1] * x[0] ** 2, (u + w[0] - p * ca.sin(x[0]) - x[1]) / 2)
    model = SampledModel(Plant(x, u, w, p, dynamics, DesignSpace(["k"], [1.0], [5.0]), dt=0.1), 0.1, "rk4", 4)
    w = np.random.default_rng(0).standard_normal((4, 100, 2))
    log = simulate(model, LAW, x0=np.tile([1.0, 0.0], (4, 1)), steps=100, disturbance=w, design=SOFT)
    met = ErrorSplit(model, SCALE).disturbances(residuals(model, log))
    np.testing.assert_allclose(met[..., 0], w[..., 0], atol=0.05)
    strong = log.states[:, :-1, 0] ** 2 > 0.1
    np.testing.assert_allclose(met[..., 1][strong], w[..., 1][strong], rtol=1e-6, atol=1e-6)


def test_a_log_carried_to_another_design_has_the_errors_that_its_disturbances_make_there(model):
    log, w = logged(model, SOFT)
    newest, _ = logged(model, STIFF)
    twin = DigitalTwin(model, scale=SCALE).remembering(log).remembering(newest)
    first, second = twin.carried()
    there = model.advance(first.x, first.u, w, STIFF) - model.undisturbed(STIFF)(first.x, first.u)
    np.testing.assert_allclose(first.e_next, there, atol=1e-5)
    np.testing.assert_array_equal(first.e[:, 1:], first.e_next[:, :-1])
    np.testing.assert_array_equal(second.e_next, twin.logs[1].e_next)


def test_a_disturbance_may_enter_where_its_effect_is_zero_at_rest():
    for force in ("w |w|", "w sin(x)"):
        model = discretise(boat(force))
        assert not np.any(model.matrices(SOFT)[2])
        check_disturbance_enters(model)
    plant = boat()
    still = replace(plant, dynamics=ca.substitute(plant.dynamics, plant.w, ca.SX(0)))
    with pytest.raises(InputError, match=r"plant: got dynamics without w: .*Let w act"):
        check_disturbance_enters(discretise(still))
