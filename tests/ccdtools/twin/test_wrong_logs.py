"""Logs as a stranger's recorder leaves them, kind by kind, at each function that takes one."""

from contextlib import suppress
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
    Measurement,
    Plant,
    QuadraticObjective,
    deploy,
    discretise,
    saturated_lqr,
)
from ccdtools.co_design import kalman_filter
from ccdtools.controllers import Observed
from ccdtools.exceptions import LimitWarning
from ccdtools.twin import (
    disturbance_set,
    drift_of_log,
    fit_plant,
    free_running_bands,
    identified_change,
    identified_lqr,
    identified_plant,
    outside_data,
    replay_problem,
    robust_mpc,
    updated_problem,
)
from mpc import InfeasibleError

x, u, w, p = ca.SX.sym("x", 2), ca.SX.sym("u"), ca.SX.sym("w"), ca.SX.sym("p")
PLANT = Plant(x, u, w, p, ca.vertcat(x[1], -p * x[0] - 0.4 * x[1] + u + w), DesignSpace(["k"], [1.0], [5.0]), dt=0.1)
PROBLEM = CoDesignProblem(discretise(PLANT), X=(-4, 4), U=(-3, 3), objective=QuadraticObjective(np.eye(2), [[0.1]]),
                          scenarios=FixedStart([1.0, 0.0], Gaussian([0.3])), steps=50)  # fmt: skip
W = Gaussian([0.3]).sample(20, 100, np.random.default_rng(0))
LOG = deploy(PLANT, saturated_lqr(PROBLEM, [2.0]), [2.0], W, x0=[1.0, 0.0])


def rng():
    return np.random.default_rng(0)


def taught(log):
    return DigitalTwin(PROBLEM.model).update(log, weight=0.1 * np.eye(2), rng=rng())


TWIN = taught(LOG)


def changed(name, value, at=(0, 30)):
    """Log with one value of a column replaced."""
    column = np.array(getattr(LOG, name))
    column[at] = value
    return replace(LOG, **{name: column})


def short(runs, steps):
    """First runs and steps of the log."""
    columns = {name: getattr(LOG, name)[:runs, :steps] for name in ("inputs", "disturbances")}
    return replace(LOG, states=LOG.states[:runs, : steps + 1], diverged_at=LOG.diverged_at[:runs], **columns)


OF_PROBLEM = {
    "fit_plant": lambda log: fit_plant(PROBLEM, log),
    "identified_change": lambda log: identified_change(PROBLEM, log),
    "identified_lqr": lambda log: identified_lqr(PROBLEM, [2.0], log),
    "identified_plant": lambda log: identified_plant(PROBLEM, log),
    "replay_problem": lambda log: replay_problem(PROBLEM, log, 20),
}
FUNCTIONS = OF_PROBLEM | {
    "robust_mpc": lambda log: robust_mpc(PROBLEM, [2.0], log, level=0.9, horizon=5, rng=rng()),
    "update": taught,
    "remembering": lambda log: DigitalTwin(PROBLEM.model).remembering(log),
    "disturbance_set": lambda log: disturbance_set(log, level=0.9, model=PROBLEM.model),
    "drift_of_log": lambda log: drift_of_log(TWIN, log),
    "outside_data": lambda log: outside_data(TWIN, log),
    "free_running_bands": lambda log: free_running_bands(TWIN, log, saturated_lqr(PROBLEM, [2.0]), rng=rng(), draws=9),
}
WRONG = {
    "a gap": (lambda: changed("states", np.nan), "states"),
    "an infinite state": (lambda: changed("states", np.inf), "states"),
    "a gap of inputs": (lambda: changed("inputs", np.nan), "inputs"),
    "another rate": (lambda: replace(LOG, dt=0.2), r"dt = 0\.2"),
    "a missing state": (lambda: replace(LOG, states=LOG.states[:, :, :1]), "1 states"),
    "a missing input": (lambda: replace(LOG, inputs=LOG.inputs[:, :, :0]), "0 inputs"),
    "no runs": (lambda: short(0, 100), "at least one"),
    "only lost runs": (lambda: replace(LOG, diverged_at=LOG.diverged_at * 0 + 3), "all diverged"),
    "another design": (lambda: replace(LOG, design=np.array([2.0, 1.0])), "design"),
    "a design outside its box": (lambda: replace(LOG, design=np.array([9.0])), "design"),
    "nothing": (lambda: None, "log|twin"),
}


@pytest.mark.parametrize("kind", WRONG)
@pytest.mark.parametrize("function", FUNCTIONS)
def test_a_wrong_log_is_named(function, kind):
    log, said = WRONG[kind]
    given = log()
    with pytest.raises(InputError, match=said):
        FUNCTIONS[function](given)


@pytest.mark.long
@pytest.mark.parametrize("function", FUNCTIONS)
def test_a_stuck_sensor_is_told(function):
    stuck = np.array(LOG.states)
    stuck[:, 20:80, 1] = stuck[:, 20:21, 1]
    with pytest.warns(UserWarning, match="x2 repeats"), suppress(InfeasibleError):
        FUNCTIONS[function](replace(LOG, states=stuck))


@pytest.mark.long
@pytest.mark.parametrize("function", FUNCTIONS)
def test_a_leap_of_a_sensor_is_told(function):
    with pytest.warns(UserWarning, match="x1 is 3.9 in sample 30 of run 0"), suppress(InfeasibleError):
        FUNCTIONS[function](changed("states", 3.9, at=(0, 30, 0)))


def draws_of(kind):
    """Disturbances (20, 100, 1) of 0.3, by the robust size of most."""
    draws = np.random.default_rng(2)
    if kind == "heavy tails":
        return 0.3 * draws.standard_t(3, W.shape)
    if kind == "two regimes":
        return W * np.where(np.arange(20) < 5, 12, 1)[:, None, None]
    return W + 15.0 * (draws.random(W.shape) < 0.01) * draws.choice([-1, 1], W.shape)


@pytest.mark.parametrize("kind", ["heavy tails", "two regimes", "gusts"])
def test_a_leap_is_told_from_what_meets_the_plant(kind):
    held = Plant(x, u, w, p, ca.vertcat(x[0] + 0.1 * x[1], x[1] + p * u + w), PLANT.design, dt=0.1, continuous=False)
    log = deploy(held, lambda state: state @ np.array([[-0.1], [-0.3]]), [2.0], draws_of(kind), x0=[1.0, 0.0])
    assert np.abs(log.disturbances).max() > 12 * 0.3
    twin = DigitalTwin(discretise(held))
    assert twin.remembering(log).logs  # a warning is an error
    leaping = np.array(log.states)
    leaping[[13, 15, 17], [40, 20, 50], [1, 0, 0]] += [1e3, 1e3, 2e3]
    with pytest.warns(UserWarning, match="x1 is .* in sample 50 of run 17 .* foretell .*, and 2 others are as odd"):
        twin.remembering(replace(log, states=leaping))


def test_a_disturbance_that_holds_its_value_between_jumps_is_no_stuck_sensor():
    held = Plant(x, u, w, p, ca.vertcat(0.9 * x[0] + p * u + x[1], x[1] + w), PLANT.design, dt=0.1, continuous=False)
    jumps = W * (np.random.default_rng(1).random(W.shape) < 0.02)
    log = deploy(held, lambda state: -0.3 * state[..., :1], [2.0], jumps, x0=[1.0, 0.0])
    assert (np.diff(log.states[..., 1]) == 0).mean() > 0.9
    assert DigitalTwin(discretise(held)).remembering(log).logs  # a warning is an error


@pytest.mark.parametrize("jump", [0.1, -0.15])
def test_no_log_has_a_clock_that_jumps(jump):
    clock = 5.0 + 0.1 * np.arange(101)
    assert replace(LOG, times=clock).times is not None
    clock[31:] += jump
    with pytest.raises(InputError, match=r"times.* from sample 30 .*dt = 0\.1 s.*Cut the log"):
        replace(LOG, times=clock)
    with pytest.raises(InputError, match=r"times.*\(101,\)"):
        replace(LOG, times=clock[1:])


@pytest.mark.parametrize("function", [*OF_PROBLEM, "robust_mpc"])
def test_other_units_are_told(function):
    small = replace(LOG, states=1000 * LOG.states)
    with pytest.warns(LimitWarning, match="lie outside X"), suppress(InfeasibleError):
        FUNCTIONS[function](small)
    of_inputs = replace(LOG, inputs=1000 * LOG.inputs)
    with pytest.warns(LimitWarning, match="inputs lie outside U"), suppress(InfeasibleError):
        FUNCTIONS[function](of_inputs)


def test_a_recorder_of_single_precision_is_no_other_unit():
    law = saturated_lqr(replace(PROBLEM, U=(-0.1, 0.1)), [2.0])
    log = deploy(PLANT, law, [2.0], 10 * W, x0=[1.0, 0.0])
    rounded = replace(log, inputs=log.inputs.astype(np.float32).astype(float))
    assert (np.abs(rounded.inputs) > 0.1).mean() > 0.5
    assert identified_change(replace(PROBLEM, U=(-0.1, 0.1)), rounded)  # a warning is an error


@pytest.mark.parametrize("function", ["fit_plant", "update", "disturbance_set", "robust_mpc", "replay_problem"])
def test_too_little_data_is_said(function):
    with pytest.raises(InputError, match=r"at least|longer|lower|longest"):
        FUNCTIONS[function](short(1, 2))


@pytest.mark.parametrize("sensors", [False, True])
def test_a_fit_to_few_values_is_not_taken_for_known(sensors):
    # of so few, intervals of 95 % held 39 to 80 %, or were a thousand times as wide as the bounds
    entries = ca.SX.sym("p", 2)
    change = ca.vertcat(x[1], -entries[0] * x[0] - 0.4 * x[1] + entries[1] * u + w)
    unknown = Plant(x, u, w, entries, change, DesignSpace(["k", "gain"], [1.0, 0.1], [5.0, 3.0]), dt=0.1)
    seen = Measurement(np.array([[1.0, 0.0]]), noise=[0.02]) if sensors else None
    problem = replace(PROBLEM, measurement=seen)
    law = saturated_lqr(PROBLEM, [2.0])
    law = Observed(law, kalman_filter(problem, [2.0])) if sensors else law
    for runs, steps, status in ((1, 10, "FEW"), (1, 25, "FEW"), (20, 100, "SOLVED")):
        options = {"output": seen, "rng": rng()} if sensors else {}
        fit = fit_plant(problem, deploy(PLANT, law, [2.0], W[:runs, :steps], x0=[1.0, 0.0], **options), plant=unknown)
        assert fit.status.name == status, (runs, steps)
        if status == "FEW":
            with pytest.raises(InputError, match=r"expected one that is SOLVED. Too few values .* Log longer"):
                updated_problem(problem, fit)


def test_too_little_data_for_a_drift_are_a_status():
    found = drift_of_log(TWIN, short(1, 2))
    assert found.found is None
    assert found.samples == 0


def test_no_drift_says_how_many_samples_calibrated_it():
    found = drift_of_log(TWIN, LOG)
    assert found.calibrated == 20 * 100
    assert "no drift in 2000 samples, calibrated by 2000 (false alarms" in str(found)
    assert "480, 900 and 1800 samples" in found.status.advice


def test_runs_that_diverged_are_counted_where_a_guarantee_or_an_all_clear_is_given():
    lost = replace(LOG, diverged_at=np.where(np.arange(20) < 17, 5, -1))
    guaranteed = robust_mpc(PROBLEM, [2.0], lost, level=0.8, horizon=5, runs=4, rng=rng())
    assert guaranteed.left_out == (17, 20)
    assert "17 of 20 runs diverged: what they met is not allowed for" in str(guaranteed)
    drift = drift_of_log(TWIN, lost)
    assert drift.status.value == "no drift"
    assert drift.as_dict()["left_out"] == (17, 20)
    assert "17 of 20 runs diverged and are left out" in str(drift)
    unknown = drift_of_log(TWIN, lost, block=100)
    assert unknown.samples == 0
    assert "17 of 20" in str(unknown)
    assert "diverged" not in f"{robust_mpc(PROBLEM, [2.0], LOG, level=0.8, horizon=5, runs=4, rng=rng())}"
    assert "diverged" not in str(drift_of_log(TWIN, LOG))


def test_bands_ask_whatever_controller_a_simulation_takes():
    law = saturated_lqr(PROBLEM, [2.0])

    class Model:
        def predict(self, states):
            return law(states)

    for asked in (Model(), lambda x: torch.as_tensor(law(x))):  # warnings are errors here
        free_running_bands(TWIN, LOG, asked, rng=rng(), steps=(10,))
    with pytest.warns(LimitWarning, match="Pass the controller that drove the log"):
        free_running_bands(TWIN, LOG, lambda x: -law(x), rng=rng(), steps=(10,))
