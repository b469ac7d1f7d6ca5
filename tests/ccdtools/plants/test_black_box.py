"""Plants of which only a step is known: functions, and simulators that hang, die or stop."""

import os
import pickle
import signal
import subprocess
import sys
import time

import numpy as np
import pytest

from ccdtools import (
    InputError,
    LinearFeedback,
    Scenario,
    Search,
    codesign,
    compare,
    deploy,
    load_study,
    saturated_lqr,
    simulate,
)
from ccdtools.exceptions import SimulatorError
from ccdtools.plants import BlackBox

A, B, E = np.array([[1.0, 0.1], [-0.2, 0.95]]), np.array([[0.0], [0.1]]), np.array([[0.0], [0.05]])


def box(**change):
    given = {"advance": lambda x, u, w, p: A @ x + B @ u + E @ w, "nx": 2, "nu": 1, "nw": 1, "dt": 0.1}
    return BlackBox(**given | change)


@pytest.mark.parametrize("batched", [False, True])
def test_a_function_is_simulated_as_the_loop_by_hand(batched):
    rows = {"advance": lambda x, u, w, p: x @ A.T + u @ B.T + w @ E.T, "batched": True}
    w = np.random.default_rng(0).standard_normal((3, 12, 1))
    run = simulate(
        box(**rows if batched else {}), LinearFeedback([[0.4, 0.3]]), x0=np.eye(3, 2), steps=12, disturbance=w
    )
    x = np.eye(3, 2)
    for k in range(12):
        u = -x @ np.array([[0.4], [0.3]])
        np.testing.assert_allclose(run.inputs[:, k], u, rtol=1e-12)
        x = x @ A.T + u @ B.T + w[:, k] @ E.T
    np.testing.assert_allclose(run.states[:, -1], x, rtol=1e-12)


def test_a_function_that_changes_what_it_is_given_changes_no_run():
    def rude(x, u, w, p):
        x[:] = 0.5 * x
        return x

    assert simulate(box(advance=rude), LinearFeedback([[0.0, 0.0]]), x0=[1, 1], steps=2).states[0, 1, 0] == 0.5


@pytest.mark.parametrize("wrong", [np.array([1j, 0]), None, [1.0], "here", [[1.0, 0.0]], [True, False]])
def test_what_is_no_state_is_refused(wrong):
    with pytest.raises(InputError, match="advance: got"):
        simulate(box(advance=lambda x, u, w, p: wrong), LinearFeedback([[0.0, 0.0]]), x0=[1, 1], steps=2)


def test_controllers_are_compared_and_deployed_on_it_as_on_the_plant_it_hides():
    problem = load_study("suspension").problem()
    design = problem.design.centre
    step = problem.model.stepper(design, batch=1)
    hidden = BlackBox(
        lambda x, u, w, p: step(x[None], u[None], w[None])[0], nx=4, nu=1, nw=1, dt=problem.model.dt,
        design=problem.design,
    )  # fmt: skip
    x0, w = problem.scenarios.sample(6, 20, np.random.default_rng(0))
    laws = {"LQR": saturated_lqr(problem, design), "half": LinearFeedback(0.5 * saturated_lqr(problem, design).K)}
    given = {"design": design, "objective": problem.objective, "X": problem.X}
    one, other = (compare(laws, Scenario(plant, x0, np.array(w)), **given) for plant in (problem.model, hidden))
    assert [s.summary.mean for s in one] == pytest.approx([s.summary.mean for s in other], rel=1e-12)
    log = deploy(hidden, laws["LQR"], design, np.array(w), x0=x0)
    assert log.states.shape == (6, 21, 4)


@pytest.mark.check
def test_a_design_is_found_through_the_box_within_300_evaluations():
    problem = load_study("suspension").problem()
    w = np.array(problem.scenarios.sample(8, 60, np.random.default_rng(0))[1])
    x0 = np.tile([-0.1, -1.0, -0.1, -0.5], (8, 1))

    def returns(plant, p):
        run = simulate(plant, saturated_lqr(problem, p), x0=x0, steps=60, disturbance=w, design=p)
        return float(run.returns(problem.objective).mean())

    steps = {}

    def advance(x, u, w, p):
        key = p.tobytes()
        if key not in steps:
            steps[key] = problem.model.stepper(p, batch=len(x))
        return steps[key](x, u, w)

    hidden = BlackBox(advance, nx=4, nu=1, nw=1, dt=problem.model.dt, design=problem.design, batched=True)
    method = Search("cma", of=lambda p: returns(hidden, p), evaluations=300)
    found = codesign(problem, method=method, rng=np.random.default_rng(1))
    low, high = problem.design.lower, problem.design.upper
    grid = [[a, b] for a in np.linspace(low[0], high[0], 13) for b in np.linspace(low[1], high[1], 13)]
    best = max(returns(problem.model, np.array(p)) for p in grid)
    assert found.evaluations <= 300
    assert returns(problem.model, found.design) > 1.01 * best


def test_a_state_that_is_not_finite_is_a_run_that_diverged():
    run = simulate(box(advance=lambda x, u, w, p: x * np.nan), LinearFeedback([[0.0, 0.0]]), x0=[1, 1], steps=3)
    assert run.diverged.all()


def test_a_simulator_that_fails_is_named_with_where_it_stood():
    def dying(x, u, w, p):
        raise RuntimeError("no licence")

    with pytest.raises(InputError, match=r"advance: got a function that stops with RuntimeError: no licence at x = "):
        simulate(box(advance=dying), LinearFeedback([[0.0, 0.0]]), x0=[1, 1], steps=3)


@pytest.mark.parametrize(("change", "match"), [
    ({"advance": 3}, "advance: got 3"), ({"nx": 0}, "nx: got 0"), ({"nw": -1}, "nw: got -1"),
    ({"dt": 0.0}, "dt: got 0"),
    ({"design": 3}, "design: got 3"), ({"batched": 2}, "batched: got 2"), ({"step_limit": 0}, "step_limit: got 0"),
])  # fmt: skip
def test_wrong_arguments_are_named(change, match):
    with pytest.raises(InputError, match=match):
        box(**change)


def test_a_state_of_another_shape_is_refused():
    with pytest.raises(InputError, match=r"advance: got a state of shape \(1,\), expected \(2,\)"):
        simulate(box(advance=lambda x, u, w, p: x[:1]), LinearFeedback([[0.0, 0.0]]), x0=[1, 1], steps=3)


def hanging(x, u, w, p):
    time.sleep(600)


def dying(x, u, w, p):
    if x[0] < 0.3:
        os.kill(os.getpid(), signal.SIGSEGV)
    return A @ x + B @ u + E @ w


def running(**change):
    """A simulation from 1, whose state falls below 0.3 in its tenth sample."""
    return simulate(box(**change), LinearFeedback([[0.4, 0.3]]), x0=[1, 0], steps=40)


def licensed(x, u, w, p):
    if x[0] > 2:
        raise OSError("no licence")
    return A @ x + B @ u + E @ w


def alone(x):
    return x


def unlicensed_near_rest(x, u, w, p):
    return licensed(x if x[0] > 0.3 else [3.0], u, w, p)


@pytest.mark.check
def test_within_its_time_a_simulator_does_what_it_does_without_a_limit_and_so_does_a_copy():
    step = [0.8, 0.1], [0.2], [0.0], []
    plant = box(advance=licensed, step_limit=60.0)
    for each in (plant, pickle.loads(pickle.dumps(plant)), plant):
        np.testing.assert_array_equal(each.step(*step), box().step(*step))
    with pytest.raises(InputError, match=r"OSError: no licence at x = .* \(line \d+ of test_black_box.py\)"):
        plant.step([3.0, 0.0], *step[1:])


@pytest.mark.long
def test_a_simulator_that_hangs_is_named_with_where_it_stood_and_works_again():
    plant = box(advance=lambda x, u, w, p: hanging(x, u, w, p) if x[0] > 0.9 else 0.5 * x, step_limit=0.3)
    expected = (
        r"a simulator that does not come back at x = \[1.0, 0.0\], u = \[-0.4\], .*an answer within 0.3 s. .* step 0"
    )
    with pytest.raises(SimulatorError, match=expected) as caught:
        simulate(plant, LinearFeedback([[0.4, 0.3]]), x0=[1, 0], steps=40)
    assert caught.value.kept is None
    limitless = box(advance=lambda x, u, w, p: 0.5 * x)
    np.testing.assert_array_equal(plant.step([0.8, 0], [0], [0], []), limitless.step([0.8, 0], [0], [0], []))


@pytest.mark.long
@pytest.mark.skipif(sys.platform == "win32", reason="signals")
def test_what_was_simulated_before_a_simulator_died_is_kept():
    with pytest.raises(SimulatorError, match="ends its process by SIGSEGV at x = ") as caught:
        running(advance=dying, step_limit=60.0)
    whole = running()
    k = caught.value.step
    assert whole.states[0, k, 0] < 0.3 <= whole.states[0, k - 1, 0]
    np.testing.assert_array_equal(caught.value.kept.states, whole.states[:, : k + 1])
    np.testing.assert_array_equal(caught.value.kept.inputs, whole.inputs[:, :k])
    again = pickle.loads(pickle.dumps(caught.value))
    assert (str(again), again.step) == (str(caught.value), k)


def test_a_simulator_that_cannot_go_to_another_process_is_refused():
    held = (k for k in range(3))
    with pytest.raises(InputError, match="step_limit: got 60 s, and a simulator that cannot go to another process"):
        running(advance=lambda x, u, w, p: x + next(held), step_limit=60.0)


def test_a_search_leaves_out_designs_at_which_the_simulator_dies():
    problem = load_study("suspension").problem()

    def returned(p):
        if problem.design.to_unit(p)[0] > 0.6:
            raise SimulatorError("advance", "a simulator that dies", "x⁺")
        return -float(np.square(problem.design.to_unit(p)).sum())

    found = codesign(problem, method=Search("cma", of=returned, evaluations=30), rng=np.random.default_rng(1))
    lost = np.isinf(found.history.model_return)
    np.testing.assert_array_equal(lost, problem.design.to_unit(found.history.design)[:, 0] > 0.6)
    assert 0 < lost.sum() < len(lost)


CALLER = """
import os, sys, time
from ccdtools.plants import BlackBox

def hangs(x, u, w, p):
    print(os.getpid(), flush=True)
    while True:
        time.sleep(0.1)

BlackBox(hangs, nx=1, nu=1, nw=0, dt=0.1, step_limit=1000.0).step([1.0], [0.0], [], [])
"""


@pytest.mark.long
@pytest.mark.skipif(sys.platform == "win32", reason="signals of POSIX")
def test_a_process_that_hangs_ends_after_the_one_that_called_it():
    with subprocess.Popen([sys.executable, "-c", CALLER], stdout=subprocess.PIPE, text=True) as caller:
        worker = int(caller.stdout.readline())
        caller.kill()
    for _ in range(300):
        try:
            os.kill(worker, 0)
        except ProcessLookupError:
            return
        time.sleep(0.1)
    os.kill(worker, signal.SIGKILL)
    pytest.fail("the process is still there")


@pytest.mark.long
@pytest.mark.parametrize("step_limit", [None, 60.0])
def test_a_simulator_that_stops_keeps_what_was_simulated_before(step_limit):
    with pytest.raises(SimulatorError, match=r"OSError: no licence at x = .* at step \d+, counted from 0\.") as caught:
        running(advance=unlicensed_near_rest, step_limit=step_limit)
    whole, k = running(), caught.value.step
    assert k > 0
    np.testing.assert_array_equal(caught.value.kept.states, whole.states[:, : k + 1])
    with pytest.raises(SimulatorError, match="advance: got a function that stops with TypeError") as caught:
        running(advance=alone, step_limit=step_limit)
    assert (caught.value.step, caught.value.kept) == (0, None)
