"""Plants that logged states and inputs tell."""

from dataclasses import replace

import casadi as ca
import numpy as np
import pytest
from logged_spring import DT, RUNS, START, STEPS, P, cubic, logged, spring, stated, without_states
from scipy.optimize import least_squares
from scipy.signal import lfilter

from ccdtools import DesignSpace, Gaussian, InputError, LinearFeedback, Plant, deploy, saturated_lqr
from ccdtools.twin import fit_plant, updated_problem


def seen(real, seed=0, unit=1.0, runs=RUNS, law=None):
    """Problem whose states are known, and a log of LQR on a real plant."""
    problem = stated(unit=unit, measurement=None)
    w = Gaussian([0.3]).sample(runs, STEPS, np.random.default_rng(seed))
    law = saturated_lqr(problem, P) if law is None else law
    return problem, deploy(real, law, P, w, x0=unit * np.array(START))


def test_of_states_a_gain_is_the_least_squares_solution_in_any_unit():
    found = []
    for unit in (1.0, 1e4):
        problem, log = seen(spring(0.5, unit=unit), unit=unit)
        found.append(fit_plant(problem, log, plant=spring(unit=unit, names=("gain",))))
        A, B, E = problem.model.matrices(P)
        along = E[:, 0] / (E.T @ E)[0, 0]  # noise and input enter alike
        error = (log.states[:, 1:] - log.states[:, :-1] @ A.T) @ along
        moved = log.inputs[:, :, 0] * (B.T @ along)[0]

        def left(z, error=error, moved=moved):
            """What a gain and a correlation leave."""
            one = error - z[0] * moved
            return (one[:, 1:] - z[1] * one[:, :-1]).ravel()

        own = least_squares(left, [1.0, 0.0], xtol=1e-12, ftol=1e-12)
        spread = np.linalg.inv(own.jac.T @ own.jac) * left(own.x).var()
        assert found[-1].status.name == "SOLVED"
        np.testing.assert_allclose(found[-1].values[:2], own.x, atol=1e-3)  # the mean of w is that of a sample
        np.testing.assert_allclose(found[-1].deviations[:2], np.sqrt(np.diag(spread)), rtol=0.08)
    assert found[0].values[0] == pytest.approx(found[1].values[0], rel=1e-6)


@pytest.mark.long
@pytest.mark.parametrize("carried", [0.5, 0.8])
def test_of_states_a_disturbance_that_lasts_is_no_dynamics(carried):
    held = 0
    for seed in range(20):
        rng = np.random.default_rng(seed)
        w = 0.3 * lfilter([(1 - carried**2) ** 0.5], [1, -carried], rng.standard_normal((4, 200, 1)), axis=1)
        problem = stated(measurement=None)
        found = fit_plant(problem, deploy(spring(0.5), saturated_lqr(problem, P), P, w, x0=START),
                          plant=spring(names=("gain",)))  # fmt: skip
        assert found.status.name == "SOLVED"
        held += bool(found.intervals()[0, 0] <= 0.5 <= found.intervals()[0, 1])
    assert held >= 16  # without a correlation none


@pytest.mark.long
@pytest.mark.parametrize(("carried", "status"), [(0.0, "SOLVED"), (0.9, "LASTING")])
def test_of_outputs_a_disturbance_that_lasts_is_told_by_innovations_further_apart(carried, status):
    problem, unit = stated(), (1 - carried**2) ** 0.5
    for seed in range(3):
        drawn = np.random.default_rng(seed).standard_normal((RUNS, STEPS, 1))
        log = logged(problem, spring(0.8), w=0.3 * lfilter([unit], [1, -carried], drawn, axis=1))
        found = fit_plant(problem, without_states(log), plant=spring(names=("gain", "mass")))
        assert found.status.name == status


def test_of_states_a_push_that_nothing_states_is_not_known_and_one_that_is_stated_is():
    problem, log = seen(spring(0.5, push=0.3))
    found = fit_plant(problem, log, plant=spring(names=("gain",)))
    assert found.status.name == "LASTING"
    assert "constant part" in found.advice
    with pytest.raises(InputError, match="LASTING"):
        updated_problem(problem, found)
    x, u, w, p = ca.SX.sym("x", 2), ca.SX.sym("u"), ca.SX.sym("w"), ca.SX.sym("p", 3)
    space = DesignSpace(["k", "gain", "push"], [0.5, 0.2, -1.0], [4.0, 3.0, 1.0])
    rates = [x[1], p[1] * u - p[0] * x[0] - 0.3 * x[1] + w + p[2]]
    found = fit_plant(problem, log, plant=Plant(x, u, w, p, rates, space, dt=DT))
    assert found.status.name == "SOLVED"
    np.testing.assert_allclose(found.values[:2], [0.5, 0.3], atol=4 * found.deviations[:2].max())


@pytest.mark.check
@pytest.mark.parametrize("steps", [5, 10, 30])
def test_of_states_a_short_log_has_wide_intervals(steps):
    held = 0
    problem, real, wide = stated(measurement=None), spring(0.5), spring(names=("gain",))
    law = saturated_lqr(problem, P)
    for seed in range(60):
        w = Gaussian([0.3]).sample(1, steps, np.random.default_rng(seed))
        low, high = fit_plant(problem, deploy(real, law, P, w, x0=START), plant=wide).intervals()[0]
        held += bool(low <= 0.5 <= high)
    assert held >= 50


@pytest.mark.long
def test_of_states_intervals_hold_the_truth_as_often_as_they_say():
    held = sum(
        bool(low <= 0.5 <= high)
        for seed in range(40)
        for low, high in fit_plant(*seen(spring(0.5), seed, runs=4), plant=spring(names=("gain",))).intervals()
    )
    assert 34 <= held <= 40


@pytest.mark.long
def test_of_states_a_nonlinear_entry_is_found_and_designs_of_all_kinds_use_it():
    problem, log = seen(cubic(c=2.0))
    found = fit_plant(problem, log, plant=cubic("c"))
    assert found.status.name == "SOLVED"
    assert found.values[0] == pytest.approx(2.0, abs=3 * found.deviations[0])
    weaker = updated_problem(problem, fit_plant(*seen(spring(0.5)), plant=spring(names=("gain",))))
    B = weaker.model.matrices(P)[1]
    np.testing.assert_allclose(B, 0.5 * problem.model.matrices(P)[1], rtol=0.1)
    assert abs(saturated_lqr(weaker, P).K).max() != abs(saturated_lqr(problem, P).K).max()


def test_of_states_a_loop_without_excitation_leaves_open_what_its_law_hides():
    problem, log = seen(spring(0.5))
    found = fit_plant(problem, log)
    assert found.status.name == "OPEN"
    assert {"w1 by x1", "w1 by x2", "w1 by u1"} == {name for one in found.open for name in one}
    rng, lqr = np.random.default_rng(1), saturated_lqr(problem, P)
    law = lambda x: lqr(x) + rng.normal(0, 0.5, (len(x), 1))  # noqa: E731
    found = fit_plant(*seen(spring(0.5), law=law))
    assert found.status.name == "SOLVED"
    assert found.values[2] == pytest.approx(-0.5, abs=4 * found.deviations[2])


@pytest.mark.parametrize("digits", [np.float64, np.float32])
def test_of_states_a_log_without_any_disturbance_is_exact(digits):
    problem, _ = seen(cubic(c=2.0))
    law, steps = saturated_lqr(problem, P), (4, STEPS, 1)
    real = deploy(cubic(c=2.0), lambda x: law(x).astype(digits).astype(float), P, np.zeros(steps), x0=START)
    log = replace(real, inputs=law(real.states[:, :-1].reshape(-1, 2)).reshape(steps))  # before they are rounded
    found = fit_plant(problem, log, plant=cubic("c"))
    assert found.status.name == "SOLVED"
    assert found.values[0] == pytest.approx(2.0, rel=1e-4)  # the model integrates as well as that


def test_of_states_a_constant_push_without_noise_lasts():
    problem, _ = seen(spring())
    log = deploy(spring(0.5, push=0.3), saturated_lqr(problem, P), P, np.zeros((4, STEPS, 1)), x0=START)
    assert fit_plant(problem, log, plant=spring(names=("gain",))).status.name == "LASTING"


@pytest.mark.parametrize("gain", [1e-3, 1e-6, 0.0])
def test_of_states_what_small_inputs_do_not_tell_stays_open(gain):
    for seed in range(3):
        problem, log = seen(spring(1.3), seed, runs=3, law=LinearFeedback([[gain, gain]]))
        found = fit_plant(problem, log, plant=spring(names=("gain",)))
        assert found.status.name == "OPEN"
        with pytest.raises(InputError, match="OPEN"):
            updated_problem(problem, found)


def test_of_states_wrong_logs_are_named():
    problem, log = seen(spring())
    for given, words in [
        (log.states, "a Trajectory"),
        ([], "at least one log"),
        (replace(log, dt=2 * DT), "dt"),
        (replace(log, diverged_at=np.zeros(RUNS, dtype=int)), "all diverged"),
        (replace(log, states=np.where(np.arange(STEPS + 1)[:, None] == 5, np.nan, log.states)), r"logs\[0\].states"),
    ]:
        with pytest.raises(InputError, match=words):
            fit_plant(problem, given, plant=spring(names=("gain",)))
