"""What is measured in a loop: outputs of any kind, with noise that is the same for every controller."""

import copy
import pickle

import casadi as ca
import control
import numpy as np
import pytest

import ccdtools as cc
from ccdtools import Gaussian, InputError, Measurement, Scenario
from ccdtools.disturbances import Uniform
from ccdtools.plants import LinearModel
from invariant_sets import Polytope

A, B, E = np.array([[1.0, 0.2], [0.0, 1.0]]), np.array([[0.0], [0.2]]), np.eye(2)
MODEL = LinearModel.from_state_space(control.ss(A, B, np.eye(2), 0, 0.2), E=E)
C = np.array([[1.0, -2.0]])
K = np.array([[2.0, 3.0]])


class Listener:
    """Applies −K x and keeps what was measured."""

    def __init__(self, *needs, gain=1.0):
        self.needs = frozenset(needs) | {"output"}
        self.gain = gain
        self.heard = []

    def __call__(self, x, y, **signals):
        self.heard.append(np.array(y))
        return -self.gain * x @ K.T

    @property
    def outputs(self):
        heard = np.array(self.heard)
        if "preview" in self.needs:  # called run by run
            heard = heard.reshape(-1, 3, heard.shape[-1])
        return heard.transpose(1, 0, 2)


def loop(output, runs=3, steps=200, seed=0, listener=None, disturbance=True, plant=MODEL, **options):
    listener = Listener() if listener is None else listener
    x0 = np.random.default_rng(5).standard_normal((runs, plant.nx))
    w = Gaussian([0.1, 0.1]) if disturbance is True else disturbance
    rng = None if seed is None else np.random.default_rng(seed)
    run = cc.simulate(plant, listener, x0=x0, steps=steps, disturbance=w, output=output, rng=rng, **options)
    return run, listener.outputs


def noise_of(output, **options):
    run, y = loop(output, **options)
    return y - run.states[:, :-1] @ C.T


def test_noise_is_added_to_what_is_measured_and_has_the_standard_deviation_given():
    v = noise_of(Measurement(C, noise=[0.3]), runs=50)
    assert v.std() == pytest.approx(0.3, rel=4 / np.sqrt(2 * v.size))
    assert abs(v.mean()) < 4 * 0.3 / np.sqrt(v.size)
    assert abs(np.mean(v[0] * v[1])) < 4 * 0.09 / np.sqrt(v[0].size)


def test_the_same_generator_gives_the_same_noise_to_every_controller():
    noisy = Measurement(C, noise=[0.3])
    first = noise_of(noisy)
    np.testing.assert_allclose(noise_of(noisy, listener=Listener(gain=0.5)), first, atol=1e-12)
    np.testing.assert_allclose(noise_of(noisy, listener=Listener("preview")), first, atol=1e-12)
    assert np.abs(noise_of(noisy, seed=1) - first).max() > 0.1


def test_noise_does_not_change_the_disturbance():
    plain, _ = loop(C)
    noisy, _ = loop(Measurement(C, noise=[0.3]))
    np.testing.assert_array_equal(noisy.disturbances, plain.disturbances)
    rng = np.random.default_rng(0)
    runs = [cc.simulate(MODEL, Listener(), x0=[1.0, 0.0], steps=5, disturbance=Gaussian([1.0, 1.0]), rng=rng,
                        output=Measurement(C, noise=[1.0])).disturbances for _ in range(2)]  # fmt: skip
    again = np.random.default_rng(0)
    expected = [Gaussian([1.0, 1.0]).sample(1, 5, again) for _ in range(2)]
    np.testing.assert_array_equal(runs, expected)


def test_a_second_simulation_with_the_same_generator_meets_other_noise():
    rng = np.random.default_rng(0)
    heard = []
    for _ in range(2):
        listener = Listener()
        cc.simulate(MODEL, listener, x0=[0.0, 0.0], steps=5, output=Measurement(C, noise=[1.0]), rng=rng)
        heard.append(listener.outputs)
    assert np.abs(heard[0] - heard[1]).max() > 0.1


def test_noise_of_any_disturbance_is_sampled_and_noise_itself_is_taken():
    v = noise_of(Measurement(C, noise=Uniform([0.0], [1.0])), runs=20)
    assert v.min() > -1e-9
    assert v.mean() == pytest.approx(0.5, abs=0.02)
    given = np.random.default_rng(1).standard_normal((3, 200, 1))
    np.testing.assert_allclose(noise_of(Measurement(C, noise=given), seed=0), given, atol=1e-12)
    np.testing.assert_allclose(noise_of(Measurement(C, noise=given[0])), np.tile(given[0], (3, 1, 1)), atol=1e-12)


def nonlinear_plant():
    x, u, p = ca.SX.sym("x", 2), ca.SX.sym("u"), ca.SX.sym("p")
    return cc.Plant(x, u, None, p, [x[1], -p * ca.sin(x[0]) + u], cc.DesignSpace(["p"], [1.0], [9.0]), 0.1,
                    outputs=[p * ca.sin(x[0]) + u, x[1] ** 2])  # fmt: skip


def last_inputs(run):
    return np.concatenate([np.zeros_like(run.inputs[:, :1]), run.inputs[:, :-1]], axis=1)


@pytest.mark.parametrize("runs", [1, 3, 20])
def test_outputs_of_a_plant_are_those_after_the_last_input(runs):
    plant = nonlinear_plant()
    for output in (plant, Measurement(plant), cc.discretise(plant)):
        run, y = loop(output, runs, 20, None, disturbance=None, plant=plant, design=[4.0])
        expected = np.stack([
            4 * np.sin(run.states[:, :-1, 0]) + last_inputs(run)[..., 0], run.states[:, :-1, 1] ** 2,
        ], axis=-1)  # fmt: skip
        np.testing.assert_allclose(y, expected, atol=1e-12)


def test_a_function_is_given_what_it_asks_for():
    plant = nonlinear_plant()
    options = {"disturbance": None, "plant": plant, "design": [4.0], "steps": 20, "seed": None}
    run, y = loop(lambda x, p, u: p * np.sin(x[:, :1]) + u, **options)
    np.testing.assert_allclose(y, 4 * np.sin(run.states[:, :-1, :1]) + last_inputs(run), atol=1e-12)
    run, y = loop(lambda state: state[:, 1:] ** 2, **options)
    np.testing.assert_allclose(y, run.states[:, :-1, 1:] ** 2, atol=1e-12)
    run, y = loop(lambda x, scale=2.0: scale * x, **options)
    np.testing.assert_allclose(y, 2 * run.states[:, :-1], atol=1e-12)


def scenario(**options):
    w = 0.1 * np.random.default_rng(2).standard_normal((6, 30, 2))
    return Scenario(MODEL, np.zeros((6, 2)), w, **options)


def test_every_controller_of_a_scenario_meets_the_same_noise_run_by_run():
    noisy = scenario(output=Measurement(C, noise=[0.5]), seed=3)
    heard = []
    for run_of, listener in ((noisy, Listener()), (noisy, Listener(gain=0.2)), (noisy.first(2), Listener())):
        run = run_of.run(listener)
        heard.append(listener.outputs - run.states[:, :-1] @ C.T)
    np.testing.assert_allclose(heard[1], heard[0], atol=1e-12)
    np.testing.assert_allclose(heard[2], heard[0][:2], atol=1e-12)
    listener = Listener()
    short = noisy.first(4, 10).run(listener)
    np.testing.assert_allclose(listener.outputs - short.states[:, :-1] @ C.T, heard[0][:4, :10], atol=1e-12)
    other = scenario(output=Measurement(C, noise=[0.5]), seed=4)
    assert np.abs(other.output.noise - noisy.output.noise).max() > 0.1


def test_scenarios_with_noise_are_copied_and_pickled():
    noisy = scenario(output=Measurement(nothing_hidden, noise=[0.5, 0.1]), seed=3)
    for again in (copy.deepcopy(noisy), pickle.loads(pickle.dumps(noisy))):
        np.testing.assert_array_equal(again.output.noise, noisy.output.noise)


def nothing_hidden(x):
    return x


def test_a_comparison_hands_the_noise_to_all():
    noisy = scenario(output=Measurement(C, noise=[0.5]), seed=3)
    first, second = Listener(), Listener()
    table = cc.compare(
        {"LQR": cc.LinearFeedback(K), "one": first, "two": second}, noisy, few={"two": 3},
        objective=cc.QuadraticObjective(np.eye(2), [[1.0]]), X=Polytope.from_bounds([-5, -5], [5, 5]),
    )  # fmt: skip
    for k in range(30):
        np.testing.assert_array_equal(second.heard[k], first.heard[k][:3])
    assert table["one"].step_time > 0


def test_a_deployment_is_measured_too():
    listener = Listener("reference")
    log = cc.deploy(
        MODEL, listener, None, np.zeros((8, 2)), x0=[1.0, 0.0], output=Measurement(C, noise=[0.1]),
        rng=np.random.default_rng(0), reference=[0.0, 0.0],
    )  # fmt: skip
    v = listener.outputs - log.states[:, :-1] @ C.T
    assert 0 < np.abs(v).max() < 1


@pytest.mark.parametrize(
    ("output", "message"),
    [
        (np.ones((1, 3)), "output: got shape"),
        (np.ones(2), "output: got shape"),
        ("position", "output: got 'position'"),
        (nonlinear_plant, r"output: got a function of \(\)"),
        (cc.Plant, "output: got the class Plant"),
        (lambda x, time: x, r"output: got a function of \(x, time\)"),
        (lambda x: x[:, 0], r"output: got outputs of shape \(3,\) for states \(3, 2\)"),
        (lambda x: "high", "output: got 'high'"),
    ],
)
def test_what_measures_nothing_is_named(output, message):
    with pytest.raises(InputError, match=message):
        loop(output)


@pytest.mark.parametrize(
    ("noise", "message"),
    [
        ([-0.1], "output.noise: got a negative standard deviation"),
        ([np.nan], "output.noise: got (nan|-?inf) at index"),
        ("loud", "output.noise: got 'loud'"),
        (Gaussian, "output.noise: got the class Gaussian"),
        ([0.1, 0.1], "output.noise: got 2 channels, expected 1, one per output"),
        (np.zeros((2, 200, 1)), r"output.noise: got shape \(2, 200, 1\), expected \(3, 200, ny\)"),
        (np.zeros((50, 1)), r"output.noise: got shape \(1, 50, 1\)"),
        (np.zeros((1, 1, 1, 1)), "output.noise: got shape"),
    ],
)
def test_noise_that_does_not_fit_is_named(noise, message):
    with pytest.raises(InputError, match=message):
        loop(Measurement(C, noise=noise))


@pytest.mark.parametrize(
    ("noise", "message"),
    [
        ([0.1, 0.1], "output.noise: got 2 channels, expected 1, one per output"),
        (np.zeros((30, 2)), "output.noise: got 2 channels, expected 1, one per output"),
        (np.zeros((2, 30, 1)), r"output.noise: got shape \(2, 30, 1\), expected \(6, 30, ny\)"),
        (np.zeros((29, 1)), r"output.noise: got shape \(1, 29, 1\), expected \(6, 30, ny\)"),
    ],
)
def test_noise_that_does_not_fit_is_named_when_the_scenario_is_made(noise, message):
    with pytest.raises(InputError, match=message):
        scenario(output=Measurement(C, noise=noise), seed=0)
    scenario(output=Measurement(C, noise=np.zeros((31, 1)))).first(2, 10)


def test_random_noise_needs_a_generator_or_a_seed():
    with pytest.raises(InputError, match="rng: got nothing"):
        loop(Measurement(C, noise=[0.1]), seed=None, disturbance=None)
    with pytest.raises(InputError, match="seed: got nothing"):
        scenario(output=Measurement(C, noise=[0.1]))
    with pytest.raises(InputError, match="seed: got -1"):
        scenario(output=Measurement(C, noise=[0.1]), seed=-1)


def test_the_plant_that_is_measured_is_of_the_sizes_and_design_of_the_loop():
    plant = nonlinear_plant()
    with pytest.raises(InputError, match="design: got shape"):
        loop(plant)
    x = ca.SX.sym("x", 3)
    other = cc.Plant(x, None, None, None, -x, cc.DesignSpace([], [], []), 0.1, outputs=[x[0]])
    with pytest.raises(InputError, match="output: got outputs of a plant of 3 states and 0 inputs"):
        scenario(output=other)
