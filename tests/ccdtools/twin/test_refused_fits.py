"""Logs, plants and problems that cannot be meant are refused by fits, each named."""

from dataclasses import replace

import numpy as np
import pytest
from logged_spring import DT, RUNS, START, STEPS, P, cubic, logged, spring, stated

from ccdtools import Gaussian, InputError, Measurement, RandomStarts, deploy, saturated_lqr
from ccdtools.exceptions import LimitWarning
from ccdtools.twin import OutputLog, fit_plant, updated_problem


@pytest.fixture(scope="module")
def log():
    problem = stated()
    return logged(problem, spring())


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"inputs": lambda u: np.where(u == u[0, 3], np.nan, u)}, "inputs: got nan at index"),
        ({"outputs": lambda y: np.where(y == y[0, 3], np.inf, y)}, "outputs: .*NaN in gaps"),
        ({"outputs": lambda y: y[:, :-1]}, "inputs: got shape .*as many as outputs"),
        (
            {"outputs": lambda y: np.concatenate([y, y], axis=2)},
            r"logs\[0\]: got 2 outputs and 1 inputs, expected 1 and 1",
        ),
        ({"outputs": lambda y: y[:1, :3], "inputs": lambda u: u[:1, :3]}, "3 measured values for 6 unknowns"),
        ({"outputs": lambda y: y * np.nan}, "0 measured values for 6 unknowns"),
        ({"design": lambda p: p + 9}, r"logs\[0\].design"),
    ],
)
def test_a_log_that_cannot_be_meant_is_named(log, change, words):
    columns = {
        name: change.get(name, np.array)(np.array(getattr(log, name))) for name in ("outputs", "inputs", "design")
    }
    with pytest.raises(InputError, match=words):
        fit_plant(stated(), OutputLog(**columns))


@pytest.mark.check
def test_inputs_in_other_units_are_told(log):
    with pytest.warns(LimitWarning, match="inputs lie outside U"):
        fit_plant(stated(), OutputLog(log.outputs, 1e3 * log.inputs, P))


def test_wrong_problems_plants_and_kinds_are_named(log):
    problem = stated()
    function = Measurement(lambda x: x[:, :1], noise=[0.1])
    cases = [
        (lambda: fit_plant(replace(problem, measurement=None), OutputLog(log.outputs, log.inputs, P)), "a Trajectory"),
        (lambda: fit_plant(replace(problem, measurement=function), log), "matrix or a Plant"),
        (lambda: fit_plant(problem, []), "at least one log"),
        (lambda: fit_plant(problem, log.states), r"logs\[0\]: .*OutputLog"),
        (lambda: fit_plant(problem, replace(log, outputs=None)), r"logs\[0\]: .*OutputLog"),
        (lambda: fit_plant(problem, replace(log, diverged_at=np.zeros(RUNS, dtype=int))), "all diverged"),
        (lambda: fit_plant(problem, log, plant=spring()), "what is unknown besides"),
        (lambda: fit_plant(problem, log, plant=3), "plant"),
    ]  # fmt: skip
    for call, words in cases:
        with pytest.raises(InputError, match=words):
            call()


@pytest.mark.long
def test_a_filter_that_diverges_is_a_status_and_what_is_not_known_cannot_be_drawn():
    problem = stated(noise=0.3, X=(-6, 6), scenarios=RandomStarts(Gaussian([1.5, 1.5]), Gaussian([0.5])))
    x0 = problem.scenarios.sample(RUNS, STEPS, np.random.default_rng(3))[0]
    found = fit_plant(problem, logged(problem, cubic(), x0=x0), plant=cubic("c"))
    assert found.status.name == "UNSOLVED"
    for call, words in [
        (lambda: found.drawn(problem, 3, np.random.default_rng(0)), "UNSOLVED"),
        (lambda: updated_problem(problem, found), "UNSOLVED"),
    ]:
        with pytest.raises(InputError, match=words):
            call()


def test_a_loop_logs_what_its_sensors_told_and_one_of_the_state_nothing():
    problem = stated()
    rng = np.random.default_rng(0)
    w = Gaussian([0.3]).sample(RUNS, STEPS, rng)
    log = logged(problem, spring(), w=w)
    assert log.outputs.shape == (RUNS, STEPS, 1)
    assert (log.outputs - log.states[:, :-1, :1]).std() == pytest.approx(0.05, rel=0.1)
    assert deploy(spring(), saturated_lqr(problem, P), P, w, x0=START).outputs is None


@pytest.mark.long
def test_a_clock_that_jumps_or_has_another_rate_is_named():
    problem = stated()
    log, plant = logged(problem, spring(0.5)), spring(names=("gain",))
    clock = DT * np.arange(STEPS)
    jumped = clock + (np.arange(STEPS) > 30) * 0.1
    whole = OutputLog(log.outputs, log.inputs, P, times=clock)
    assert fit_plant(problem, whole, plant=plant).values[0] == fit_plant(problem, log, plant=plant).values[0]
    for wrong, words in [
        (replace(whole, times=jumped), r"logs\[0\]\.times: got 0\.43 s from sample 30"),
        (replace(whole, times=2 * clock), "got 0.66 s from sample 0"),
        (replace(log, dt=2 * DT), r"dt = 0\.66 s, expected dt = 0\.33 s"),
    ]:
        with pytest.raises(InputError, match=words):
            fit_plant(problem, wrong, plant=plant)
    with pytest.raises(InputError, match="times: got shape"):
        OutputLog(log.outputs, log.inputs, P, times=clock[1:])


@pytest.mark.long
def test_a_sensor_that_stuck_is_named_in_logs_of_outputs_and_of_states(log):
    outputs, states = np.array(log.outputs), np.array(log.states)
    outputs[2, 10:25] = outputs[2, 10]
    with pytest.warns(UserWarning, match=r"logs\[0\]: y1 repeats .* over 15 samples, from 10 of run 2"):
        fit_plant(stated(), OutputLog(outputs, log.inputs, P))
    states[1, 20:, 1] = states[1, 20, 1]
    with pytest.warns(UserWarning, match=r"logs\[0\]: x2 repeats .*, from 20 of run 1"):
        fit_plant(replace(stated(), measurement=None), replace(log, states=states, outputs=None))
