"""LQR re-identified from logs: least squares, the offset, and what it is worth."""

from dataclasses import replace

import casadi as ca
import numpy as np
import pytest
from scipy.optimize import minimize_scalar

from ccdtools import (
    CoDesignProblem,
    DesignSpace,
    FixedStart,
    Gaussian,
    InputError,
    LinearFeedback,
    Nested,
    Plant,
    QuadraticObjective,
    Scenario,
    codesign,
    deploy,
    discretise,
    linear_mpc,
    saturated_lqr,
)  # fmt: skip
from ccdtools.twin import (
    DigitalTwin,
    disturbance_set,
    identified_change,
    identified_lqr,
    replay_problem,
    updated_problem,
)

DESIGN, Q, R = [2.0, 0.5], np.eye(2), np.array([[0.1]])


def oscillator(mass=1.0, force=0.0, unit=1.0):
    """A mass with stiffness and damping to be designed, positions in a unit, pushed by a constant force."""
    x, u, w, p = ca.SX.sym("x", 2), ca.SX.sym("u"), ca.SX.sym("w"), ca.SX.sym("p", 2)
    space = DesignSpace(["k", "c"], lower=[1.0, 0.1], upper=[5.0, 1.0])
    push = (-p[0] * x[0] / unit - p[1] * x[1] / unit + u + w + force) / mass
    return Plant(x, u, w, p, ca.vertcat(x[1], push * unit), space, dt=0.1)


def pendulum():
    """A pendulum of the same sizes."""
    plant = oscillator()
    return replace(
        plant,
        dynamics=ca.vertcat(plant.x[1], plant.u + plant.w - plant.p[0] * ca.sin(plant.x[0]) - plant.p[1] * plant.x[1]),
    )


def problem_of(unit=1.0):
    scale = np.array([unit, unit])
    return CoDesignProblem(
        discretise(oscillator(unit=unit)), X=(-9 * scale, 9 * scale), U=(-9, 9),
        objective=QuadraticObjective(Q / unit**2, R), scenarios=FixedStart(0.5 * scale, Gaussian([0.1])), steps=100,
    )  # fmt: skip


def logged(problem, real, controller, noise=0.0, runs=10, unit=1.0):
    """Errors of the nominal model along runs on the real plant."""
    rng = np.random.default_rng(0)
    x0 = unit * rng.uniform(-1, 1, (runs, 2))
    log = deploy(real, controller, DESIGN, noise * rng.standard_normal((runs, 200, 1)), x0=x0)
    return DigitalTwin(problem.model).remembering(log).logs


def wandering(x):
    """Inputs that no linear law gives."""
    return np.sin(7 * x[..., :1]) + 0.3 * np.cos(11 * x[..., 1:])


@pytest.mark.parametrize("unit", [1.0, 1e-6])
def test_a_law_of_exact_logs_is_the_best_affine_one_of_the_real_plant(unit):
    problem, real = problem_of(unit), oscillator(1.6, 0.4, unit)
    law = identified_lqr(problem, DESIGN, logged(problem, real, lambda x: wandering(x / unit), unit=unit))
    A, B, _ = discretise(oscillator(1.6, 0.0, unit)).matrices(DESIGN)
    c = 0.4 * B[:, 0]  # the force acts where the input does

    def cost(offset):
        state = np.linalg.solve(np.eye(2) - A + B @ law.K, B[:, 0] * offset + c)
        push = offset - law.K[0] @ state
        return state @ Q @ state / unit**2 + R[0, 0] * push**2

    truth = problem.objective.weights(np.array(DESIGN), 2, 1).keywords()
    np.testing.assert_allclose(law.K, lqr_gain(A, B, **truth), rtol=1e-5)
    np.testing.assert_allclose(law.offset[0], minimize_scalar(cost, tol=1e-12).x, rtol=1e-5)


def lqr_gain(A, B, Q, R, **_):
    """Gain by iterating the Riccati equation."""
    P = Q
    for _ in range(3000):
        K = np.linalg.solve(R + B.T @ P @ B, B.T @ P @ A)
        P = Q + A.T @ P @ (A - B @ K)
    return K


def test_noise_alone_changes_the_law_little_and_a_wrong_model_gains_by_it():
    problem = problem_of()
    own = saturated_lqr(problem, DESIGN)
    unchanged = identified_lqr(problem, DESIGN, logged(problem, oscillator(), own, noise=0.3))
    np.testing.assert_allclose(unchanged.K, own.K, atol=0.15)
    np.testing.assert_allclose(unchanged.offset, 0.0, atol=0.05)

    real = oscillator(1.6, 0.4)
    law = identified_lqr(problem, DESIGN, logged(problem, real, own, noise=0.3))
    w = 0.3 * np.random.default_rng(9).standard_normal((50, 200, 1))
    scenario = Scenario(real, np.tile([0.5, 0.0], (50, 1)), w)
    before, after = (scenario.run(one, design=DESIGN).returns(problem.objective) for one in (own, law))
    assert ((after - before) > 0).mean() > 0.95
    assert after.mean() > 0.85 * before.mean()


def test_a_log_whose_inputs_follow_its_states_exactly_gives_a_law_all_the_same():
    problem, real = problem_of(), oscillator(1.3)
    own = LinearFeedback(saturated_lqr(problem, DESIGN).K)
    logs = logged(problem, real, own)
    law = identified_lqr(problem, DESIGN, logs)
    assert np.isfinite(law.K).all()
    assert np.abs(law.K - own.K).max() < 1.0


@pytest.mark.parametrize("steps", [1, 2])
def test_a_log_through_which_any_line_goes_leaves_the_gain(steps):
    problem = problem_of()
    log = deploy(oscillator(1.6), wandering, DESIGN, np.ones((1, steps, 1)), x0=[[0.5, 0.0]])
    law = identified_lqr(problem, DESIGN, DigitalTwin(problem.model).remembering(log).logs)
    np.testing.assert_allclose(law.K, saturated_lqr(problem, DESIGN).K, rtol=1e-9)


def test_logs_of_another_design_are_carried_to_this_one():
    problem = problem_of()
    rng = np.random.default_rng(0)
    log = deploy(oscillator(force=0.4), wandering, [4.0, 0.2], np.zeros((5, 200, 1)), x0=rng.uniform(-1, 1, (5, 2)))
    law = identified_lqr(problem, DESIGN, DigitalTwin(problem.model).remembering(log).logs)
    np.testing.assert_allclose(law.K, saturated_lqr(problem, DESIGN).K, atol=1e-4)
    assert law.offset[0] < -0.05


@pytest.mark.parametrize("logs", [(), None, [1]])
def test_wrong_logs_are_named(logs):
    with pytest.raises(InputError, match="logs"):
        identified_lqr(problem_of(), DESIGN, logs)


def test_a_gain_with_an_offset():
    law = LinearFeedback([[1.0, 2.0]], -1, 1, offset=[0.5])
    np.testing.assert_allclose(law([0.1, 0.1]), [0.2])
    np.testing.assert_allclose(law([[9.0, 0.0], [0.0, 0.0]]), [[-1.0], [0.5]])
    for wrong in ([1.0, 2.0], [np.nan]):
        with pytest.raises(InputError, match="offset"):
            LinearFeedback([[1.0, 2.0]], offset=wrong)


def test_logs_are_taken_as_they_were_deployed():
    problem, rng = problem_of(), np.random.default_rng(0)
    log = deploy(oscillator(1.6, 0.4), wandering, DESIGN, 0.1 * rng.standard_normal((8, 200, 1)), x0=[1.0, 0.0])
    errors = DigitalTwin(problem.model).remembering(log).logs
    for given in (log, [log]):
        assert identified_lqr(problem, DESIGN, given).K.tolist() == identified_lqr(problem, DESIGN, errors).K.tolist()
        W = disturbance_set(given, level=0.9, model=problem.model)
        assert W.volume == disturbance_set(errors, level=0.9, model=problem.model).volume
    with pytest.raises(InputError, match=r"logs\[0\].*with `model=` a Trajectory, too"):
        disturbance_set(log)


def test_every_method_takes_the_model_that_a_log_tells():
    problem, real = problem_of(), oscillator(1.6, 0.4)
    log = logged(problem, real, wandering)
    updated = updated_problem(problem, identified_change(problem, log))
    A, B, _ = discretise(real).matrices(DESIGN)
    np.testing.assert_allclose(updated.model.matrices(DESIGN)[0], A, atol=1e-6)
    np.testing.assert_allclose(updated.model.matrices(DESIGN)[1], B, atol=1e-6)
    law, known = saturated_lqr(updated, DESIGN), identified_lqr(problem, DESIGN, log)
    np.testing.assert_allclose(law.K, known.K, rtol=1e-9)
    np.testing.assert_allclose(law.offset, known.offset, rtol=1e-6)


def test_mpc_of_what_a_log_tells_is_that_of_the_real_plant():
    wide, real = problem_of(), oscillator(1.6, 0.4)
    problem = replace(wide, U=(-0.8, 0.3))
    updated = updated_problem(problem, identified_change(wide, logged(wide, real, wandering)))
    pushed = FixedStart([0.5, 0.5], Gaussian([0.1], [0.4]))
    truth = replace(problem, model=discretise(oscillator(1.6)), scenarios=pushed)
    states = np.random.default_rng(0).uniform(-1, 1, (20, 2))
    found, known = (linear_mpc(one, DESIGN)(states) for one in (updated, truth))
    assert {-0.8, 0.3} <= set(known.round(6).ravel())
    np.testing.assert_allclose(found, known, atol=1e-4)


@pytest.mark.long
def test_a_design_is_found_for_what_a_log_tells():
    problem = problem_of()
    found = identified_change(problem, logged(problem, oscillator(force=0.4), wandering))
    pushed = replace(problem, scenarios=FixedStart([0.5, 0.5], Gaussian([0.1], [0.4])))
    own, truth = (
        codesign(one, method=Nested(), design=DESIGN, rng=np.random.default_rng(0)).design
        for one in (updated_problem(problem, found), pushed)
    )
    np.testing.assert_allclose(own, truth, atol=0.05)


def test_a_change_is_carried_to_designs_that_no_log_has_seen():
    problem = problem_of()
    found = identified_change(problem, logged(problem, oscillator(force=0.4), wandering))
    updated = updated_problem(problem, found)
    for design in ([1.0, 0.1], [5.0, 1.0]):
        A, B, E = discretise(oscillator(force=0.4)).matrices(design)
        np.testing.assert_allclose(updated.model.matrices(design)[0], A, atol=1e-5)
        np.testing.assert_allclose(updated.model.matrices(design)[2], np.hstack([E, 0.4 * B]), atol=1e-5)


def test_a_stated_mean_of_the_disturbance_is_not_counted_twice():
    known = FixedStart([0.5, 0.5], Gaussian([0.1], [0.4]))
    problem, rng = replace(problem_of(), scenarios=known), np.random.default_rng(0)
    log = deploy(
        oscillator(), wandering, DESIGN, known.disturbance.sample(40, 200, rng), x0=rng.uniform(-1, 1, (40, 2))
    )
    updated = problem
    for _ in range(2):  # an updated problem states its mean, too
        updated = updated_problem(updated, identified_change(problem if updated is problem else updated, log))
        drift = updated.model.matrices(DESIGN)[2] @ updated.mean_disturbance
        np.testing.assert_allclose(drift, problem.model.matrices(DESIGN)[2] @ [0.4], atol=2e-3)
        np.testing.assert_allclose(
            saturated_lqr(updated, DESIGN).offset, identified_lqr(problem, DESIGN, log).offset, atol=0.02
        )


def test_plants_are_drawn_from_a_log_of_two_steps():
    problem = problem_of()
    log = deploy(oscillator(1.6), wandering, DESIGN, np.ones((1, 2, 1)), x0=[[0.5, 0.0]])
    assert len([*identified_change(problem, log).drawn(problem, 5, np.random.default_rng(0))]) == 5


@pytest.mark.long
def test_plants_drawn_from_a_log_are_spread_about_the_truth():
    problem, real = problem_of(), oscillator(1.6, 0.4)
    found = identified_change(problem, logged(problem, real, wandering, noise=0.3))
    A, B, _ = discretise(oscillator(1.6)).matrices(DESIGN)
    drawn = [one.model.matrices(DESIGN) for one in found.drawn(problem, 40, np.random.default_rng(3))]
    for k, truth in enumerate((A, B)):
        told = np.array([one[k] for one in drawn])
        assert (np.abs(told.mean(axis=0) - truth) < 4 * told.std(axis=0) + 1e-9).all()
        assert (told.std(axis=0)[1] > 0).all()


def test_what_a_change_cannot_be_built_on_is_named():
    problem = problem_of()
    stiff = replace(problem, model=discretise(pendulum(), method="collocation"))
    with pytest.raises(InputError, match=r"problem\.model.*not by collocation"):
        identified_change(stiff, logged(problem, oscillator(), wandering))
    log = logged(problem, oscillator(force=1.0), wandering)
    with pytest.raises(InputError, match=r"problem\.scenarios"):
        updated_problem(replay_problem(problem, log, 20), identified_change(problem, log))


@pytest.mark.parametrize("bend", [0.3, 1.0])
def test_what_is_not_linear_in_a_law_is_not_taken_for_what_inputs_do(bend):
    """A weaker actuator and a spring that hardens, under a law that bends where the spring does."""
    nominal = oscillator()
    real = replace(nominal, dynamics=nominal.dynamics - ca.vertcat(0, 0.4 * nominal.u + 0.5 * nominal.x[0] ** 3))
    problem = problem_of()
    law = saturated_lqr(problem, DESIGN)

    def bent(x):
        u = law(x)
        return u - 0.02 * bend * u**3

    w = Gaussian([2.0]).sample(200, 100, np.random.default_rng(1))

    def cost(controller):
        return -deploy(real, controller, DESIGN, w, x0=[0.5, 0.5]).returns(problem.objective).mean()

    found = identified_lqr(problem, DESIGN, deploy(real, bent, DESIGN, w[::-1], x0=[0.5, 0.5]))
    assert cost(found) < 1.05 * cost(law)  # 2.6 and 4 times with all that varies
