"""A plant that has nothing but what `Simulable` asks for stands wherever a plant does."""

import numpy as np
import pytest
import torch

from ccdtools import (
    CoDesignProblem,
    DesignSpace,
    FixedStart,
    Gaussian,
    InputError,
    LinearFeedback,
    Nested,
    QuadraticObjective,
    RealPlant,
    Scenario,
    closed_loop_returns,
    codesign,
    compare,
    deploy,
    experiment,
    saturated_lqr,
    simulate,
)
from ccdtools.co_design import DesignEnv, EpisodeEnv
from ccdtools.exceptions import SimulatorError
from ccdtools.plants import BlackBox
from ccdtools.twin import replay_problem
from learning import train

LAWS = {"LQR": LinearFeedback([[0.4, 0.8]]), "half": LinearFeedback([[0.2, 0.4]])}
OBJECTIVE = QuadraticObjective(np.eye(2), [[0.1]], design_cost=lambda p: 2.0 / p[0])
LIMITS = {"X": ([-2.0, -2.0], [2.0, 2.0]), "U": ([-1.0], [1.0])}


def moved(x, u, w, p):
    """Cart of mass p with friction, a tenth of a second later."""
    v = x[:, 1] + 0.1 * (u[:, 0] + w[:, 0] - 0.3 * np.tanh(x[:, 1])) / p[0]
    return np.stack([x[:, 0] + 0.1 * v, v], axis=1)


class Cart:
    nx = 2
    nu = 1
    nw = 1
    dt = 0.1
    design = DesignSpace(["m"], [0.5], [2.0])

    def stepper(self, p, *, batch):
        return lambda x, u, w: moved(x, u, w, p)


BOX = BlackBox(moved, nx=2, nu=1, nw=1, dt=0.1, design=Cart.design, batched=True)
DRAWN = np.random.default_rng(0).normal(0, 0.05, (9, 30, 1))


def problem(model):
    return CoDesignProblem(
        model, **LIMITS, steps=30, scenarios=FixedStart([1.0, 0.0], Gaussian([0.05])), objective=OBJECTIVE
    )


def test_it_is_simulated_compared_and_deployed_as_the_function_that_it_is():
    given = {"x0": [1.0, 0.0], "steps": 30, "disturbance": DRAWN, "design": [1.5]}
    states = [simulate(plant, LAWS["LQR"], **given).states for plant in (Cart(), BOX)]
    np.testing.assert_array_equal(*states)
    told = {"design": [1.5], "objective": OBJECTIVE, "X": LIMITS["X"]}
    one, other = (compare(LAWS, Scenario(plant, [1.0, 0.0], DRAWN), **told) for plant in (Cart(), BOX))
    assert [score.summary for score in one] == [score.summary for score in other]
    log = deploy(Cart(), LAWS["LQR"], [1.5], DRAWN, x0=np.tile([1.0, 0.0], (9, 1)))
    np.testing.assert_array_equal(log.states, states[0])


def test_it_takes_the_place_of_the_plant_of_a_scenario():
    laws = {name: lambda design, rng, law=law: law for name, law in LAWS.items()}
    found = experiment(
        laws, Scenario(BOX, [1.0, 0.0], DRAWN), designs=[1.5], plants={"own": Cart(), "box": BOX}, seeds=2,
        objective=OBJECTIVE, X=LIMITS["X"],
    )  # fmt: skip
    assert found["half", "own"].value == found["half", "box"].value


@pytest.mark.long
def test_it_is_designed_and_trained_on_as_the_function_that_it_is():
    method = Nested(runs=16, starts=1)
    one, other = (codesign(problem(plant), method=method, rng=np.random.default_rng(0)) for plant in (Cart(), BOX))
    np.testing.assert_array_equal(one.design, other.design)
    env = DesignEnv(problem(Cart()), [1.5])
    env.reset(seed=0)
    state = env.step([0.5])[4]["state"]
    assert state[1] == pytest.approx(0.05 / 1.5, abs=0.02)


def test_it_may_be_the_real_plant():
    plant = Cart()
    real = RealPlant(plant, Gaussian([0.05]), x0=[0.0, 0.0], runs=30, steps=20)
    assert real.plant is plant


@pytest.mark.parametrize("name", ["nx", "nu", "nw", "dt", "design"])
def test_what_is_missing_is_named(name):
    class Half:
        stepper = Cart.stepper

    for other in {"nx", "nu", "nw", "dt", "design"} - {name}:
        setattr(Half, other, getattr(Cart, other))
    with pytest.raises(InputError, match=f"plant: got a Half without {name}, expected a Simulable"):
        simulate(Half(), LAWS["LQR"], x0=[1.0, 0.0], steps=3, design=[1.5])
    with pytest.raises(InputError, match=f"model: got a Half without {name}"):
        problem(Half())
    with pytest.raises(InputError, match=rf"real\.plant: got a Half without {name}"):
        RealPlant(Half(), Gaussian([0.05]), x0=[0.0, 0.0], runs=30, steps=20)


@pytest.mark.parametrize(
    ("name", "value"), [("nx", 2.0), ("nu", 0), ("nw", -1), ("dt", None), ("design", ["m"]), ("stepper", 3)]
)
def test_what_is_of_another_kind_is_named(name, value):
    wrong = type("Wrong", (Cart,), {name: value})()
    for asked in (problem, lambda plant: simulate(plant, LAWS["LQR"], x0=[1.0, 0.0], steps=3, design=[1.0])):
        with pytest.raises(InputError, match=f"{name}: got"):
            asked(wrong)


class Dying(Cart):
    """Cart whose licence is lost at the fourth sample."""

    def stepper(self, p, *, batch):
        left = iter(range(3))

        def step(x, u, w):
            if next(left, None) is None:
                raise OSError("licence lost")
            return moved(x, u, w, p)

        return step


class Alone(Cart):
    """Cart that forgets the runs."""

    def stepper(self, p, *, batch):
        return lambda x, u, w: moved(x, u, w, p)[0]


def test_one_that_dies_says_where_and_keeps_what_was_simulated():
    with pytest.raises(SimulatorError, match=r"licence lost at x = .* at step 3, counted from 0\.") as caught:
        simulate(Dying(), LAWS["LQR"], x0=[1.0, 0.0], steps=30, design=[1.0])
    assert caught.value.kept.inputs.shape == (1, 3, 1)


class Ageing:
    """Plant whose second state falls by a tenth in a sample, and which stops below a half, in the eighth."""

    nx, nu, nw, dt = 2, 1, 0, 0.1
    design = None

    def stepper(self, p, *, batch):
        def step(x, u, w):
            age = np.abs(x[:, 1])
            if ((age > 0.1) & (age < 0.5)).any():
                raise OSError("licence lost")
            return np.hstack([0.8 * x[:, :1] + 0.1 * u, 0.9 * x[:, 1:]])

        return step


def ageing():
    return CoDesignProblem(
        Ageing(), **LIMITS, steps=30, scenarios=FixedStart([0.0, 1.0]), objective=QuadraticObjective(np.eye(2), [[1.0]])
    )


def trained():
    env = EpisodeEnv(ageing(), [], runs=3, rng=np.random.default_rng(0))
    train(env, env.agent(), iterations=9, steps=4, generator=torch.Generator().manual_seed(0))


RUNS = {
    "simulated": lambda: simulate(Ageing(), LAWS["LQR"], x0=np.tile([0.0, 1.0], (3, 1)), steps=30),
    "trained on": trained,
    "co-designed": lambda: codesign(ageing(), method="pathwise", rng=np.random.default_rng(0)),
    "measured": lambda: closed_loop_returns(ageing(), LAWS["LQR"], [], np.random.default_rng(0), runs=3),
}


@pytest.mark.parametrize("name", RUNS)
def test_the_step_at_which_many_runs_stop_is_named(name):
    with pytest.raises(SimulatorError, match=r"licence lost at x = .* at step 7, counted from 0\.") as caught:
        RUNS[name]()
    assert caught.value.step == 7


def test_one_that_moves_to_another_shape_says_so():
    with pytest.raises(SimulatorError, match=r"states of shape \(2,\), expected \(1, 2\)"):
        simulate(Alone(), LAWS["LQR"], x0=[1.0, 0.0], steps=30, design=[1.0])


def test_a_plant_that_is_not_discretised_is_no_simulator(illustrative):
    with pytest.raises(InputError, match=r"model: got .*expected a LinearModel or a SampledModel.*discretise"):
        problem(illustrative.plant)
    with pytest.raises(InputError, match="model: got the class Cart"):
        problem(Cart)


def test_a_recorded_log_is_a_plant_that_does_again_what_was_logged(suspension):
    problem = suspension.problem()
    design = problem.design.centre
    law = saturated_lqr(problem, design)
    drawn = suspension.disturbance.sample(3, 40, np.random.default_rng(1))
    log = deploy(suspension.real.plant, law, design, drawn, x0=np.tile(suspension.x0, (3, 1)))
    replayed = replay_problem(problem, log, 40)
    x0, errors = replayed.scenarios.whole()
    again = simulate(replayed.model, law, x0=x0, steps=40, disturbance=errors, design=design)
    np.testing.assert_allclose(again.states, log.states, rtol=1e-9, atol=1e-9)
    laws = {"LQR": law, "half": LinearFeedback(0.5 * law.K, law.lower, law.upper)}
    table = compare(laws, Scenario(replayed.model, x0, errors), design=design, objective=problem.objective, X=problem.X)
    assert table["LQR"].summary.mean > table["half"].summary.mean
