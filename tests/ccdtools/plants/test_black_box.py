"""Plants of which only a step is known: functions and environments of Gymnasium."""

import os
import pickle
import signal
import subprocess
import sys
import time

import casadi as ca
import numpy as np
import pytest

from ccdtools import (
    DesignSpace,
    DigitalTwin,
    InputError,
    LinearFeedback,
    Plant,
    Scenario,
    Search,
    codesign,
    compare,
    deploy,
    discretise,
    load_study,
    saturated_lqr,
    simulate,
)
from ccdtools.exceptions import SimulatorError
from ccdtools.plants import BlackBox, from_gymnasium

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


@pytest.mark.check
def test_an_environment_may_hang_in_its_process():
    def build(env, p):
        if p[0] > 1.8:
            time.sleep(600)
        env.m = p[0]

    plant = pendulum(design=DesignSpace(["m"], [0.5], [2.0]), build=build, step_limit=5.0)
    np.testing.assert_allclose(plant.step([0.1, 0.2], [1.0], [], [1.0]), swung([0.1, 0.2], 1.0, 1.0), atol=1e-6)
    with pytest.raises(SimulatorError, match="does not come back"):
        plant.step([0.1, 0.2], [1.0], [], [2.0])


def write(env, x):
    env.state = x


def pendulum(**change):
    gymnasium = pytest.importorskip("gymnasium")
    given = {"read": lambda env: env.state, "write": write, "dt": 0.05}
    return from_gymnasium(gymnasium.make("Pendulum-v1"), **given | change)


def swung(x, u, m, g=10.0, length=1.0, dt=0.05):
    """The step that Gymnasium documents."""
    u = np.clip(u, -2, 2)
    rate = np.clip(x[1] + (3 * g / (2 * length) * np.sin(x[0]) + 3.0 / (m * length**2) * u) * dt, -8, 8)
    return np.array([x[0] + rate * dt, rate])


def test_an_environment_of_gymnasium_steps_from_any_state_at_any_design():
    def build(env, p):
        env.m = p[0]

    plant = pendulum(design=DesignSpace(["m"], [0.5], [2.0], ["kg"]), build=build)
    rng = np.random.default_rng(0)
    for _ in range(20):
        x, u, m = rng.normal(size=2), rng.normal(size=1), rng.uniform(0.5, 2)
        np.testing.assert_allclose(
            plant.step(x, u, [], [m]), swung(x, u[0], m), atol=1e-6
        )  # actions in single precision
    run = simulate(plant, LinearFeedback([[10.0, 2.0]]), x0=rng.normal(0, 0.05, (3, 2)), steps=300, design=[1.0])
    assert np.abs(run.states[:, -1]).max() < 1e-3  # beyond the time limit of 200 steps, too


def test_what_cannot_be_an_environment_is_refused():
    with pytest.raises(InputError, match="build: got none"):
        pendulum(design=DesignSpace(["m"], [0.5], [2.0]))
    with pytest.raises(InputError, match="read: got 3"):
        pendulum(read=3)
    with pytest.raises(InputError, match="write: got a state"):
        pendulum(write=lambda env, x: setattr(env, "state", x + 1))
    with pytest.raises(InputError, match=r"env, write: got .* after one step from one state"):
        pendulum(write=lambda env, x: None)
    gymnasium = pytest.importorskip("gymnasium")
    with pytest.raises(
        InputError, match=r"env: got an environment with the actions Discrete\(2\), .*box of float actions"
    ):
        from_gymnasium(gymnasium.make("CartPole-v1"), read=lambda env: env.state, write=write, dt=0.02)


class Bodies:
    """Environment that steps another without showing its state."""

    def __init__(self, env):
        self.env, self.unwrapped, self.action_space = env, self, env.action_space
        self.reset, self.step = env.reset, env.step


@pytest.mark.parametrize("missing", ["read", "write"])
def test_an_environment_without_a_state_says_what_to_pass(missing):
    gymnasium = pytest.importorskip("gymnasium")
    given = {"read": lambda env: env.env.unwrapped.state, "write": lambda env, x: write(env.env.unwrapped, x)}
    bodies = Bodies(gymnasium.make("Pendulum-v1"))
    assert from_gymnasium(bodies, **given).nx == 2
    del given[missing]
    with pytest.raises(InputError, match=f"{missing}: got nothing, of an environment without .*Such as {missing}="):
        from_gymnasium(bodies, **given)


def test_an_environment_that_is_none_or_changed_by_a_wrapper_is_refused():
    gymnasium = pytest.importorskip("gymnasium")
    made = gymnasium.make("Pendulum-v1")
    scaled = gymnasium.wrappers.RescaleAction(made, -1, 1)
    closed = Bodies(made)
    closed.reset = lambda seed: 1 / 0
    for env, match in ((scaled, r"a wrapper that makes the actions .*Pass env\.unwrapped"),
                       (closed, "stops with ZeroDivisionError"), (Bodies, "env: got the class Bodies"),
                       ("Pendulum-v1", "such as by gymnasium.make")):  # fmt: skip
        with pytest.raises(InputError, match=match):
            from_gymnasium(env)
    assert from_gymnasium(scaled.unwrapped).nx == 2


@pytest.mark.parametrize(("name", "dt"), [("Pendulum-v1", 0.05), ("MountainCarContinuous-v0", 1.0)])
def test_an_environment_of_classic_control_alone_is_a_plant(name, dt):
    gymnasium = pytest.importorskip("gymnasium")
    plant = from_gymnasium(gymnasium.make(name))
    assert (plant.nx, plant.nu, plant.dt) == (2, 1, dt)
    env = gymnasium.make(name)
    env.reset(seed=3)
    first = np.array(env.unwrapped.state)
    env.step(np.array([0.5], dtype=np.float32))
    np.testing.assert_allclose(plant.step(first, [0.5], [], []), env.unwrapped.state, atol=1e-7)


@pytest.mark.parametrize("read", [
    lambda env: None, lambda env: {}, lambda env: env.state[None], lambda env: env.state + 0j, lambda env: [np.nan, 0],
])  # fmt: skip
def test_what_is_no_state_of_an_environment_is_named(read):
    with pytest.raises(InputError, match="read: got"):
        pendulum(read=read)


@pytest.mark.parametrize("name", ["read", "write", "build"])
def test_a_function_of_the_environment_that_stops_is_named_with_its_line(name):
    def stops(env, value=None):
        raise OSError("no such body")

    design = DesignSpace(["m"], [0.5], [2.0])
    given = {"design": design, "build": lambda env, p: setattr(env, "m", p[0]), name: stops}
    with pytest.raises(InputError, match=r"OSError: no such body"):
        pendulum(**given)


@pytest.mark.long
@pytest.mark.parametrize("step_limit", [None, 60.0])
def test_a_design_that_the_environment_does_not_heed_is_told(step_limit):
    gymnasium = pytest.importorskip("gymnasium")
    box = DesignSpace(["m", "l"], lower=[0.5, 0.5], upper=[2.0, 2.0])

    def build(env, p):
        env.mass, env.l = p  # its mass is m

    with pytest.warns(UserWarning, match="build: m changes no state in 3 steps"):
        from_gymnasium(gymnasium.make("Pendulum-v1"), design=box, build=build, step_limit=step_limit)


def test_a_design_that_acts_late_or_stops_the_environment_is_not_called_idle():
    gymnasium = pytest.importorskip("gymnasium")

    class Chain(gymnasium.Env):
        dt, gain, state = 0.1, 1.0, np.zeros(3)
        observation_space = gymnasium.spaces.Box(-9, 9, (3,))
        action_space = gymnasium.spaces.Box(-1, 1, (1,), np.float64)

        def reset(self, *, seed=None, options=None):
            self.state = np.zeros(3)
            return self.state, {}

        def step(self, action):
            if self.gain == 9.0:
                raise ValueError("too stiff")
            a, b, c = self.state
            self.state = np.array([self.gain * a + b, b + c, c + action[0]])
            return self.state, 0.0, False, False, {}

    for upper in (2.0, 9.0):
        box = DesignSpace(["gain"], [0.5], [upper])
        from_gymnasium(Chain(), design=box, build=lambda env, p: setattr(env, "gain", p[0]))


def test_an_environment_of_whole_number_actions_is_refused():
    gymnasium = pytest.importorskip("gymnasium")
    env = gymnasium.make("Pendulum-v1").unwrapped
    env.action_space = gymnasium.spaces.Box(-3, 3, (1,), np.int32)
    with pytest.raises(InputError, match=r"env: got an environment with the actions .*int32.*float actions"):
        from_gymnasium(env)


def test_an_environment_is_tried_at_a_design_that_exists():
    asked = []

    def build(env, p):
        env.m = float(p[0])
        asked.append(env.m)

    pendulum(design=DesignSpace(["m"], [1], [2], integer=["m"]), build=build)
    assert set(asked) <= {1.0, 2.0}


def test_a_model_with_a_wrong_mass_learns_its_error_from_the_environment():
    space = DesignSpace(["m"], [0.5], [2.0], ["kg"])
    plant = pendulum(design=space, build=lambda env, p: setattr(env, "m", p[0]))
    x, u, w, m = ca.SX.sym("x", 2), ca.SX.sym("u"), ca.SX.sym("w"), ca.SX.sym("m")
    rate = x[1] + 0.05 * (15.0 * ca.sin(x[0]) + 3.0 / (1.3 * m) * u + w)  # 30 % too heavy
    after = ca.vertcat(x[0] + 0.05 * rate, rate)
    model = discretise(Plant(x, u, w, m, after, space, dt=0.05, continuous=False), X=([-9, -9], [9, 9]), U=(-2, 2))
    start = np.random.default_rng(0).normal(0, 0.05, (20, 2))
    log = deploy(plant, LinearFeedback([[10.0, 2.0]], -2, 2), [1.0], np.zeros((60, 0)), x0=start)
    (errors,) = DigitalTwin(model).remembering(log).logs
    np.testing.assert_allclose(errors.e_next[..., 1], 0.05 * (3.0 - 3.0 / 1.3) * log.inputs[..., 0], atol=1e-6)


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
