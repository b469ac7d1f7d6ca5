"""Environments of Gymnasium are plants."""

import time

import casadi as ca
import numpy as np
import pytest

from ccdtools import DesignSpace, DigitalTwin, InputError, LinearFeedback, Plant, deploy, discretise, simulate
from ccdtools.exceptions import SimulatorError
from ccdtools.plants import from_gymnasium


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
