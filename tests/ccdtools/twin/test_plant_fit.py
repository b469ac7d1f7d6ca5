"""Plants that logged outputs, or states, and inputs tell."""

import warnings
from dataclasses import replace

import casadi as ca
import numpy as np
import pytest
from logged_spring import BOX, DT, RUNS, START, STEPS, P, cubic, logged, spring, stated, without_states
from scipy.optimize import minimize

from ccdtools import (
    CoDesignProblem,
    DesignSpace,
    FixedStart,
    Gaussian,
    InputError,
    LinearFeedback,
    Measurement,
    Plant,
    QuadraticObjective,
    RandomStarts,
    deploy,
    discretise,
    saturated_lqr,
)
from ccdtools.co_design import kalman_filter
from ccdtools.controllers import Observed, Passive
from ccdtools.twin import OutputLog, fit_plant, updated_problem


@pytest.mark.long
@pytest.mark.parametrize(
    ("noise", "gain", "push"), [(0.01, 0.5, 0.0), (0.01, 1.5, 0.2), (0.1, 0.5, 0.0), (0.1, 1.5, 0.2)]
)
def test_a_weak_or_strong_actuator_is_found_with_its_sign_where_smoothed_states_had_the_other(noise, gain, push):
    problem, real = stated(noise), spring(gain, push)
    fit = fit_plant(problem, without_states(logged(problem, real)))
    assert fit.names == (
        "w1 by x1",
        "w1 by x2",
        "w1 by u1",
        "w1 by constant",
        "log factor of the variance of w",
        "log factor of the variance of the sensors",
    )
    assert fit.status.name == "SOLVED"
    away = (fit.values - [0, 0, gain - 1, push, 0, 0]) / fit.deviations
    assert np.abs(away).max() < 3.5
    assert (gain - 1) * fit.values[2] > 0
    known = fit_plant(problem, logged(problem, real), noise="known")
    assert known.names == fit.names[:4]
    assert np.abs((known.values[:4] - [0, 0, gain - 1, push]) / known.deviations).max() < 3.5
    assert ((gain - 1) * known.intervals()[2] > 0).all()
    assert fit.innovation_variance == pytest.approx(1, abs=0.1)
    found, true = (m.matrices(P)[1] for m in (updated_problem(problem, known).model, discretise(real)))
    np.testing.assert_allclose(found, true, rtol=0.25)


def by_hand(log, gain, stiffer):
    """Minus the logarithm of the likelihood of a log, by a Kalman filter of its own."""
    nominal = spring()
    A, B, E = discretise(nominal).matrices(P)
    A, B = A + E @ [[stiffer, 0.0]], B + E * gain
    C, V = np.array([[1.0, 0.0]]), 0.05**2
    cost = 0.0
    guess, S, before = np.tile(START, (RUNS, 1)), np.zeros((2, 2)), np.zeros((RUNS, 1))
    for k in range(STEPS):
        if k:
            guess, S = guess @ A.T + before @ B.T, A @ S @ A.T + 0.09 * E @ E.T
        seen = (C @ S @ C.T + V)[0, 0]
        missed = log.outputs[:, k, 0] - guess[:, 0]
        cost += np.sum(missed**2 / seen + np.log(seen)) / 2
        M = S @ C.T / seen
        guess, S = guess + missed[:, None] * M.T, S - M @ C @ S
        before = log.inputs[:, k]
    return cost


@pytest.mark.check
def test_it_is_the_likeliest_by_a_filter_and_an_optimiser_of_ones_own():
    x, u, w, p = ca.SX.sym("x", 2), ca.SX.sym("u"), ca.SX.sym("w"), ca.SX.sym("p", 3)
    problem = stated()
    A, B, E = (ca.DM(part) for part in problem.model.matrices(P))
    after = A @ x + B @ u + E * (p[1] * u + p[2] * x[0] + w) + 0 * p[0]
    plant = Plant(
        x, u, w, p, after, DesignSpace(["k", "by u", "by x"], [0.5, -2, -2], [4, 2, 2]), dt=DT, continuous=False
    )
    log = logged(problem, spring(0.6))
    fit = fit_plant(problem, log, plant=plant, noise="known")
    best = minimize(
        lambda v: by_hand(log, *v), [-0.3, 0.1], method="Nelder-Mead", options={"xatol": 1e-5, "fatol": 1e-6}
    )
    np.testing.assert_allclose(fit.values, best.x, atol=0.02 * fit.deviations.min())
    step = 0.2 * fit.deviations
    curved = [by_hand(log, *(best.x + s * step * e)) - best.fun for e in np.eye(2) for s in (-1, 1)]
    information = np.reshape(curved, (2, 2)).sum(axis=1) / step**2
    np.testing.assert_allclose(np.diag(np.linalg.inv(fit.covariance)), information, rtol=0.25)


@pytest.mark.long
def test_units_change_nothing():
    fits = [fit_plant(one, logged(one, spring(0.5, unit=unit)))
            for unit in (1.0, 1e3) for one in [stated(unit=unit)]]  # fmt: skip
    factors = np.array([1e-3, 1e-3, 1, 1, 1, 1])
    assert (np.abs(fits[1].values - factors * fits[0].values) < 0.01 * fits[1].deviations).all()
    np.testing.assert_allclose(fits[1].deviations, factors * fits[0].deviations, rtol=0.01)


@pytest.mark.long
def test_how_wide_the_limits_of_the_state_are_changes_nothing():
    problem = stated(0.01)
    log = logged(problem, spring(0.6))
    one, other = (fit_plant(replace(problem, X=X), log, plant=spring(names=("gain",))) for X in ((-4, 4), (-4e5, 4e5)))
    np.testing.assert_allclose(other.values, one.values, atol=0.01 * one.deviations.min())
    assert other.status is one.status


@pytest.mark.long
def test_logs_of_several_designs_are_one_plant():
    problem = stated()
    log = logged(problem, spring(0.5))
    single = fit_plant(problem, log)
    other = np.array([3.0])
    law = Observed(saturated_lqr(problem, other), kalman_filter(problem, other))
    rng = np.random.default_rng(5)
    w = Gaussian([0.3]).sample(RUNS, STEPS, rng)
    second = deploy(spring(0.5), law, other, w, x0=START, output=problem.measurement, rng=rng)
    both = fit_plant(problem, [log, second])
    assert both.deviations[2] < 0.9 * single.deviations[2]
    assert abs(both.values[2] + 0.5) < 3.5 * both.deviations[2]


@pytest.mark.long
@pytest.mark.parametrize("measured", [True, False], ids=["outputs", "states"])
def test_a_fit_says_how_many_runs_it_leaves_out(measured):
    problem = stated()
    log = logged(problem, spring(0.5))
    problem = problem if measured else replace(problem, measurement=None)
    diverged_at = np.where(np.arange(RUNS) < 3, 5, -1)
    fit = fit_plant(problem, [log, replace(log, diverged_at=diverged_at)])
    assert fit.left_out == (3, 2 * RUNS)
    assert "3 of 80 runs left out" in repr(fit)
    assert "3 of 80 runs diverged and are left out" in fit.advice
    whole = fit_plant(problem, log)
    assert whole.left_out == (0, RUNS)
    assert "left out" not in repr(whole) + whole.advice


@pytest.mark.long
def test_mass_and_gain_of_a_stated_plant_with_an_accelerometer():
    plant = spring(names=("mass", "gain"), accelerometer=True)
    problem = stated(measurement=Measurement(spring(accelerometer=True), noise=[0.05, 0.05]))
    real = replace(plant, p=plant.p[:1], dynamics=ca.substitute(plant.dynamics, plant.p[1:], ca.DM([1.4, 0.7])),
                   outputs=ca.substitute(plant.outputs, plant.p[1:], ca.DM([1.4, 0.7])), design=BOX)  # fmt: skip
    law = Observed(saturated_lqr(problem, P), kalman_filter(problem, P))
    rng = np.random.default_rng(0)
    w = Gaussian([0.3]).sample(RUNS, STEPS, rng)
    log = deploy(real, law, P, w, x0=START, output=replace(problem.measurement, output=real), rng=rng)
    fit = fit_plant(problem, log, plant=plant)
    assert fit.status.name == "SOLVED"
    assert (np.abs(fit.values[:2] - [1.4, 0.7]) < 3.5 * fit.deviations[:2]).all()
    updated = updated_problem(problem, fit)
    np.testing.assert_allclose(updated.model.matrices(P)[1], discretise(real).matrices(P)[1], rtol=0.05)
    x, u = np.array([[1.0, 0.0]]), np.array([[1.0]])
    np.testing.assert_allclose(updated.measurement.at(2, 1, P).of(x, u)[0], real.observe(x, u, P)[0], rtol=0.05)


@pytest.mark.long
def test_a_push_becomes_a_part_of_the_disturbance():
    problem = stated()
    fit = fit_plant(problem, logged(problem, spring(push=0.2)))
    w = updated_problem(problem, fit).scenarios.sample(200, STEPS, np.random.default_rng(0))[1]
    assert w.mean() == pytest.approx(fit.values[3], abs=0.01)
    assert fit.values[3] == pytest.approx(0.2, abs=4 * fit.deviations[3])


def pendulum(gain=1.0):
    """Pendulum that swings far."""
    x, u, w, p = ca.SX.sym("x", 2), ca.SX.sym("u"), ca.SX.sym("w"), ca.SX.sym("k")
    return Plant(x, u, w, p, [x[1], -p * ca.sin(x[0]) - 0.2 * x[1] + gain * u + w], BOX, dt=0.2, substeps=2)


@pytest.mark.long
def test_a_nonlinear_plant_by_its_filter():
    problem = CoDesignProblem(
        discretise(pendulum()), X=(-6, 6), U=(-3, 3), steps=STEPS, limit_tolerance="off",
        objective=QuadraticObjective(np.eye(2), [[0.1]]), measurement=Measurement([[1.0, 0.0]], noise=[0.05]),
        scenarios=RandomStarts(Gaussian([0.8, 0.8]), Gaussian([0.5])),
    )  # fmt: skip
    x0, w = problem.scenarios.sample(20, STEPS, np.random.default_rng(3))
    log = logged(problem, pendulum(0.6), x0=x0, w=w)
    assert np.abs(log.states[..., 0]).max() > 1
    fit = fit_plant(problem, log)
    assert fit.status.name == "SOLVED"
    assert (np.abs(fit.values[:4] - [0, 0, -0.4, 0]) < 3.5 * fit.deviations[:4]).all()
    assert fit.intervals()[2, 1] < 0


@pytest.mark.long
def test_noise_that_differs_from_what_is_stated_is_fitted():
    problem = stated()
    log = logged(stated(noise=0.1), spring(0.7))
    fit = fit_plant(problem, log)
    assert fit.names[-2:] == ("log factor of the variance of w", "log factor of the variance of the sensors")
    assert fit.innovation_variance == pytest.approx(1, abs=0.02)
    assert fit.values[-1] == pytest.approx(np.log(4), abs=3.5 * fit.deviations[-1])
    assert (np.abs(fit.values[:4] - [0, 0, -0.3, 0]) < 3.5 * fit.deviations[:4]).all()
    assert updated_problem(problem, fit).model.matrices(P)[1].shape == (2, 1)
    assert fit_plant(problem, log, noise="known").innovation_variance > 1.3


@pytest.mark.check
def test_a_disturbance_smaller_than_stated_misleads_nothing_on_an_unstable_plant():
    def inverted(gain=1.0):
        x, u, w, p = ca.SX.sym("x", 2), ca.SX.sym("u"), ca.SX.sym("w"), ca.SX.sym("k")
        return Plant(x, u, w, p, [x[1], p * x[0] - 0.1 * x[1] + gain * u + w], BOX, dt=0.1)

    problem = CoDesignProblem(
        discretise(inverted()), X=(-5, 5), U=(-50, 50), steps=STEPS, limit_tolerance="off",
        objective=QuadraticObjective(np.eye(2), [[0.1]]), measurement=Measurement([[1.0, 0.0]], noise=[0.01]),
        scenarios=FixedStart([0.3, 0.0], Gaussian([0.5])),
    )  # fmt: skip
    fit = fit_plant(problem, logged(problem, inverted(0.7)))
    assert fit.status.name == "SOLVED"
    assert (np.abs(fit.values - [0, 0, -0.3, 0, 2 * np.log(0.6), 0]) < 3.5 * fit.deviations).all()


# ── what a log does not tell ──


def test_without_inputs_nothing_is_told_of_their_gain():
    problem = stated()
    fit = fit_plant(
        problem, logged(problem, spring(0.5), law=Observed(LinearFeedback([[0.0, 0.0]]), kalman_filter(problem, P)))
    )
    assert fit.status.name == "OPEN"
    assert fit.open == ({"w1 by u1": 1.0},)
    assert np.isinf(fit.deviations[2])
    assert np.isfinite(np.delete(fit.deviations, 2)).all()
    assert "w1 by u1" in fit.advice
    with pytest.raises(InputError, match="OPEN"):
        updated_problem(problem, fit)


@pytest.mark.long
def test_two_gains_in_a_row_cannot_be_told_apart():
    problem = stated()
    fit = fit_plant(problem, logged(problem, spring(0.5)), plant=spring(names=("gain", "second")))
    assert fit.status.name == "OPEN"
    assert [set(one) for one in fit.open] == [{"gain", "second"}]
    assert np.prod(fit.values[:2]) == pytest.approx(0.5, abs=0.2)


@pytest.mark.long
def test_a_bound_that_holds_a_parameter_is_said():
    plant = spring(names=("gain",))
    narrow = replace(plant, design=DesignSpace(["k", "gain"], [0.5, 0.8], [4.0, 1.2]))
    problem = stated()
    fit = fit_plant(problem, logged(problem, spring(0.4)), plant=narrow)
    assert fit.status.name == "AT_BOUND"
    assert fit.values[0] == pytest.approx(0.8, abs=1e-5)
    assert "gain=0.8 at its bound" in str(fit)


@pytest.mark.long
def test_a_sensor_that_leaps_is_told_and_chance_is_not():
    problem, plant = stated(), spring(names=("gain",))
    log = logged(problem, spring(0.5))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        fit_plant(problem, log, plant=plant)
    outputs = log.outputs.copy()
    outputs[3, 20] += 20.0
    with pytest.warns(UserWarning, match=r"logs\[0\]: y1 is .* deviations .* in sample 20 of run 3.*NaN"):
        fit_plant(problem, OutputLog(outputs, log.inputs, log.design), plant=plant)


@pytest.mark.long
def test_errors_that_last_are_told_where_a_bound_holds_a_parameter_too():
    """A sensor of the wrong sign."""
    problem, plant = stated(), spring(names=("gain",))
    log = logged(problem, spring(0.4))
    turned = OutputLog(-log.outputs, log.inputs, log.design)
    fit = fit_plant(problem, turned, plant=replace(plant, design=DesignSpace(["k", "gain"], [0.5, 0.3], [4.0, 3.0])))
    assert fit.status.name == "LASTING"
    with pytest.raises(InputError, match="LASTING"):
        updated_problem(problem, fit)


@pytest.mark.long
@pytest.mark.parametrize("sensors", [True, False])
def test_a_parameter_that_is_told_is_held_by_no_bound_however_wide_they_are(sensors):
    plant, problem = spring(names=("gain",)), stated(**({} if sensors else {"measurement": None}))
    log = logged(stated(), spring(0.5))
    near, wide = (
        fit_plant(problem, log, plant=replace(plant, design=DesignSpace(["k", "gain"], [0.5, 0.1], [4.0, most])))
        for most in (10.0, 1e6)
    )
    assert wide.status is near.status
    assert wide.values[0] == pytest.approx(near.values[0], abs=0.05 * near.deviations[0])
    assert wide.deviations[0] == pytest.approx(near.deviations[0], rel=0.05)


def rubbing(friction=None):
    """Mass on a spring with dry friction, whose acceleration and position are measured."""
    x, u, w, p = ca.SX.sym("x", 2), ca.SX.sym("u"), ca.SX.sym("w"), ca.SX.sym("p", 1 + (friction is None))
    box = DesignSpace(["k"], [0.5], [4.0]) if friction is not None else DesignSpace(["k", "f"], [0.5, 0.0], [4.0, 3.0])
    force = -p[0] * x[0] - 0.3 * x[1] - (p[1] if friction is None else friction) * ca.tanh(x[1] / 0.02) + u
    return Plant(x, u, w, p, [x[1], force + w], box, dt=0.02, substeps=4, outputs=[force, x[0]])


@pytest.mark.check
def test_dry_friction_that_an_accelerometer_sees_is_found_within_a_tenth():
    sensors, scenarios = Measurement(rubbing(0.0), noise=[0.2, 0.01]), FixedStart([0.0, 0.0], Gaussian([2.0]))
    problem = replace(stated(), model=discretise(rubbing(0.0)), measurement=sensors, scenarios=scenarios)
    w, real = Gaussian([2.0]).sample(8, 200, np.random.default_rng(1)), rubbing(1.0)
    sensed = Measurement(real, noise=[0.2, 0.01])
    law = Observed(Passive(1), kalman_filter(problem, P))
    log = deploy(real, law, P, w, x0=[0.0, 0.0], output=sensed, rng=np.random.default_rng(2))
    found = fit_plant(problem, log, plant=rubbing())
    assert found.values[0] == pytest.approx(1.0, abs=0.1)  # 0.79 by an extended filter, which takes it for noise


@pytest.mark.long
def test_a_disturbance_that_is_none_leaves_its_noise_open_and_the_plant_known():
    problem = stated(scenarios=RandomStarts(Gaussian([0.5, 0.5]), Gaussian([0.0])))
    x0 = problem.scenarios.sample(RUNS, STEPS, np.random.default_rng(3))[0]
    log = logged(problem, spring(0.5), x0=x0, w=np.zeros((RUNS, STEPS, 1)))
    found = fit_plant(problem, log, plant=spring(names=("gain",)))
    assert found.values[0] == pytest.approx(0.5, abs=0.05)
    assert len(found.drawn(problem, 3, np.random.default_rng(0))) == 3
    seen = found.updated(replace(problem, measurement=None))
    assert seen.measurement is None
    with pytest.raises(InputError, match="the design of the one that was fitted"):
        found.updated(replace(problem, model=discretise(cubic("c"))))
