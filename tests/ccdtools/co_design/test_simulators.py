"""Co-design of a plant of which only a step is known."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
import torch
from scipy.linalg import solve_discrete_are
from scipy.optimize import minimize_scalar

from ccdtools import (
    CoDesignConfig,
    CoDesignProblem,
    DesignSpace,
    FixedStart,
    Gaussian,
    InputError,
    Learned,
    Nested,
    QuadraticObjective,
    Search,
    codesign,
    equilibrium,
    load_study,
)
from ccdtools.co_design import DesignEnv, EpisodeEnv, stochastic_linearisation
from ccdtools.plants import BlackBox, deviations, from_gymnasium
from learning import NetworkConfig

RNG = np.random.default_rng(4)


def hidden(problem, asked=None, noise=0.0):
    """The same problem behind a simulator, which keeps the designs that it is asked for."""
    model = problem.model
    rng = np.random.default_rng(3)
    step = cache(lambda p: model.stepper(p, batch=1))

    def advance(x, u, w, p):
        if asked is not None:
            asked.append(p.copy())
        after = step(tuple(p))(x, u, w)
        return after + noise * rng.standard_normal(after.shape) * problem.state_scale

    box = BlackBox(advance, nx=model.nx, nu=model.nu, nw=model.nw, dt=model.dt, design=problem.design, batched=True)
    return replace(problem, model=box)


@pytest.mark.long
@pytest.mark.parametrize("name", ["suspension", "two_tanks", "pendulum_on_cart"])
def test_slopes_are_those_of_the_plant_at_bounds_too(name):
    problem = load_study(name).problem()
    other = hidden(problem)
    for p in (problem.design.lower, problem.design.upper, problem.design.centre):
        for exact, found in zip(problem.model.matrices(p), other.model.matrices(p)):
            np.testing.assert_allclose(found, exact, atol=1e-8 * np.abs(exact).max())
        for exact, found in zip(problem.model.derivatives(p), other.model.derivatives(p)):
            size = np.abs(exact).max(axis=(0, 1), initial=1e-300)
            np.testing.assert_allclose(found / size, exact / size, atol=1e-5)


@pytest.mark.long
def test_the_gradient_of_a_step_is_that_of_the_plant():
    problem = load_study("two_tanks").problem()
    other = hidden(problem)
    rng = np.random.default_rng(0)
    x = 0.3 * problem.state_scale * rng.uniform(-1, 1, (7, problem.model.nx))
    u = 0.3 * problem.input_bounds[1] * rng.uniform(-1, 1, (7, problem.model.nu))
    w = 0.01 * rng.uniform(-1, 1, (7, problem.model.nw))
    p = problem.design.latin_hypercube(7, rng)
    slopes = []
    for model in (problem.model, other.model):
        given = [torch.tensor(part, requires_grad=True) for part in (x, u, w, p)]
        weights = torch.linspace(-1.0, 2.0, 7 * model.nx).reshape(7, -1).double()
        (weights * model.pathwise(*given)).sum().backward()
        slopes.append([part.grad.numpy() for part in given])
    for exact, found in zip(*slopes):
        np.testing.assert_allclose(found, exact, rtol=1e-5, atol=1e-7 * np.abs(exact).max(initial=0.0))


@pytest.mark.long
def test_a_design_is_that_of_the_open_plant_and_no_other_design_than_of_the_box_is_asked_for():
    problem = replace(load_study("dc_servo").problem(), limit_tolerance="off", steps=10)
    asked = []
    found, known = (
        codesign(one, method=Nested(runs=32, starts=1), rng=np.random.default_rng(0))
        for one in (hidden(problem, asked), problem)
    )
    np.testing.assert_allclose(found.design, known.design, rtol=1e-3, atol=1e-9)
    assert found.status is known.status
    assert (np.array(asked) >= problem.design.lower).all()
    assert (np.array(asked) <= problem.design.upper).all()


@pytest.mark.check
def test_policy_and_design_climb_through_a_simulator():
    problem = replace(load_study("dc_servo").problem(), steps=10, limit_tolerance="off")
    agent = EpisodeEnv(problem, problem.design.centre, rng=np.random.default_rng(0)).agent(config=NetworkConfig((4,)))
    config = CoDesignConfig(iterations=4, block=4, pathwise_runs=16, evaluation_runs=64, starts=1)
    found, known = (
        codesign(one, method=Learned(agent=agent, config=config), rng=np.random.default_rng(0))
        for one in (hidden(problem), problem)
    )
    assert found.gradients.trusted
    np.testing.assert_allclose(found.gradients.pathwise, known.gradients.pathwise, rtol=1e-2)
    assert found.objective == pytest.approx(known.objective, rel=1e-3)


def gears(advance=None, **change):
    """Mass with a whole number of gears behind a simulator."""

    def step(x, u, w, p):
        if p[0] != np.round(p[0]):
            raise RuntimeError("half a gear")
        v = 0.9 * x[:, 1] + 0.05 * p[0] * u[:, 0] - 0.01 * p[0] ** 2 * x[:, 1] + w[:, 0]
        return np.stack([x[:, 0] + 0.1 * x[:, 1], v], axis=1)

    space = DesignSpace(["gears"], [1], [6], integer=["gears"])
    box = BlackBox(advance or step, nx=2, nu=1, nw=1, dt=0.1, design=space, batched=True)
    given = {"X": ([-1, -1], [1, 1]), "U": ([-1], [1]), "objective": QuadraticObjective(np.eye(2), [[0.1]]),
             "scenarios": FixedStart([0.5, 0.0], Gaussian([0.01])), "steps": 20}  # fmt: skip
    return CoDesignProblem(box, **{**given, **change})


@pytest.mark.long
def test_whole_numbers_are_asked_for_as_they_are():
    found = codesign(gears(), method=Nested(runs=16), rng=np.random.default_rng(0))
    assert found.design[0] == np.round(found.design[0])
    for p in range(1, 7):
        A = np.array([[1.0, 0.1], [0.0, 0.9 - 0.01 * p**2]])
        np.testing.assert_allclose(gears().model.matrices([p])[0], A, atol=1e-12)


def test_whole_numbers_stay_within_bounds_that_are_none():
    asked = set()

    def advance(x, u, w, p):
        asked.add(float(p[0]))
        return 0.9 * x + 0.1 * u / p + w

    space = DesignSpace(["teeth"], [0.5], [3.5], integer=["teeth"])
    problem = CoDesignProblem(
        BlackBox(advance, nx=1, nu=1, nw=1, dt=0.1, design=space, batched=True),
        X=(-2, 2),
        U=(-1, 1),
        steps=5,
        scenarios=FixedStart([1.0], Gaussian([0.1])),
        objective=QuadraticObjective([[1.0]], [[0.1]]),
    )
    problem.model.advance(np.ones((2, 1)), np.ones((2, 1)), np.ones((2, 1)), np.array([[0.5], [3.5]]))
    assert asked == {1.0, 2.0, 3.0}


def test_what_no_state_changes_is_designed_without_a_step_for_its_slope():
    space = DesignSpace(["m"], [0.5], [2.0])
    problem = CoDesignProblem(
        BlackBox(lambda x, u, w, p: 0.9 * x + 0.1 * u / p, nx=1, nu=1, dt=0.1, design=space), X=(-2, 2), U=(-1, 1),
        objective=QuadraticObjective([[0.0]], [[0.1]], design_cost=lambda p: p[0] + 1 / p[0]), steps=5,
        scenarios=FixedStart([1.0], Gaussian([])),
    )  # fmt: skip
    found = codesign(problem, method=Nested(runs=2, starts=1), rng=np.random.default_rng(0))
    np.testing.assert_allclose(found.design, [1.0], atol=1e-3)


@pytest.mark.parametrize(("change", "match"), [
    ({"advance": lambda x, u, w, p: x + 1.0}, "model: got a plant that does not rest"),
    ({"advance": lambda x, u, w, p: x + RNG.normal(0, 0.01, x.shape)}, "model: got a simulator whose steps from one"),
    ({"advance": lambda x, u, w, p: np.where(np.abs(x) > 0, np.nan, x)}, "design: got a design at which a step beside"),
    ({"scenarios": FixedStart([0.5, 0.0], Gaussian([0.01, 0.01]))}, "scenarios: got disturbances of shape"),
    ({"X": ([-1, -1, -1], [1, 1, 1])}, r"X\[0\]: got shape"),
])  # fmt: skip
def test_wrong_simulators_are_named(change, match):
    with pytest.raises(InputError, match=match):
        gears(**change)


@pytest.mark.parametrize("method", ["sequential", "simultaneous"])
def test_what_needs_expressions_says_so(method):
    with pytest.raises(InputError, match="which has no expressions"):
        codesign(gears(), method=method, rng=np.random.default_rng(0))


def test_a_simulator_is_not_asked_for_what_is_refused():
    problem, asked = load_study("dc_servo").problem(), []
    other = hidden(problem, asked)
    asked.clear()
    with pytest.raises(InputError, match="method: got optimal trajectories of a simulator"):
        codesign(other, method="simultaneous", rng=np.random.default_rng(0))
    assert not asked


@pytest.mark.long
def test_noise_of_a_simulator_is_a_thousand_times_as_large_in_a_slope():
    problem = load_study("suspension").problem()
    exact = problem.model.matrices(problem.design.centre)[0]
    found = hidden(problem, noise=1e-12).model.matrices(problem.design.centre)[0]
    scale = problem.state_scale
    assert 1e-11 < np.abs((found - exact) * scale / scale[:, None]).max() < 1e-8


@pytest.mark.parametrize("unit", [1e-3, 1.0, 1e3])
def test_a_simulator_may_rest_to_a_millionth_of_the_limits_in_any_unit(unit):
    def problem(drift):
        box = BlackBox(lambda x, u, w, p: 0.9 * x + 0.1 * unit * u / p + drift * unit, nx=1, nu=1, dt=0.1,
                       design=DesignSpace(["p"], [0.5], [2.0]))  # fmt: skip
        return CoDesignProblem(
            box, X=(-2 * unit, 2 * unit), U=(-1, 1), steps=5, scenarios=FixedStart([unit], Gaussian([])),
            objective=QuadraticObjective([[unit**-2]], [[0.1]]),
        )  # fmt: skip

    assert problem(1e-6).model.nx == 1
    with pytest.raises(InputError, match="does not rest at x = 0, u = 0: x1 moves by"):
        problem(1e-5)


def test_a_simulator_that_rests_elsewhere_is_told_how_to_count_from_there():
    def advance(x, u, w, p):  # a mass that its input holds against 9.81
        return x + 0.1 * np.array([x[1], u[0] - 9.81 - p[0] * x[1]])

    def problem(advance):
        box = BlackBox(advance, nx=2, nu=1, dt=0.1, design=DesignSpace(["p"], [1.0], [2.0]))
        return CoDesignProblem(box, X=([-1, -1], [1, 1]), U=(-5, 5), scenarios=FixedStart([0.5, 0.0], Gaussian([])),
                               objective=QuadraticObjective(np.eye(2), [[0.1]]))  # fmt: skip

    with pytest.raises(InputError, match="does not rest") as refused:
        problem(advance)
    x_e, u_e = np.zeros(2), np.array([9.81])
    written = refused.value.cure.partition("BlackBox(")[2].partition(", ...")[0]
    assert problem(eval(written, {"advance": advance, "x_e": x_e, "u_e": u_e})).model.nx == 2
    for ask in (lambda box: equilibrium(box, [1.0]), lambda box: deviations(box, None)):
        with pytest.raises(InputError, match=r"plant: got a BlackBox, expected a Plant\. Count the states"):
            ask(BlackBox(advance, nx=2, nu=1, dt=0.1))


@pytest.mark.long
def test_a_length_is_designed_in_an_environment_of_gymnasium():
    gymnasium = pytest.importorskip("gymnasium")

    def write(env, x):
        env.state = np.array(x)

    def build(env, p):
        env.l = float(p[0])

    plant = from_gymnasium(
        gymnasium.make("Pendulum-v1"), read=lambda env: env.state, write=write, build=build, dt=0.05,
        design=DesignSpace(["length"], [0.5], [1.5], ["m"]),
    )  # fmt: skip
    problem = CoDesignProblem(
        plant, X=([-1, -8], [1, 8]), U=([-2], [2]), steps=20, scenarios=FixedStart([0.05, 0.0], Gaussian([])),
        objective=QuadraticObjective(np.eye(2), [[0.1]], design_cost=lambda p: (p[0] - 1.2) ** 2),
        limit_tolerance="off",
    )  # fmt: skip
    gravity, length = 10.0, 1.25
    v = np.array([0.05 * 3 * gravity / (2 * length), 1.0])  # semi-implicit Euler, as the environment takes it
    np.testing.assert_allclose(problem.model.matrices([length])[0], [[1 + 0.05 * v[0], 0.05], v], atol=1e-9)
    found = codesign(problem, method=Search(evaluations=40, runs=2), rng=np.random.default_rng(0))
    best = minimize_scalar(cost_of_a_length, bounds=(0.5, 1.5), method="bounded")
    assert cost_of_a_length(found.design[0]) == pytest.approx(best.fun, rel=1e-3)


@pytest.mark.parametrize("step_limit", [None, pytest.param(60.0, marks=pytest.mark.check)])
def test_inputs_that_an_environment_does_not_take_are_refused(step_limit):
    gymnasium = pytest.importorskip("gymnasium")
    given = {"X": ([-1, -8], [1, 8]), "scenarios": FixedStart([0.05, 0.0]), "steps": 5,
             "objective": QuadraticObjective(np.eye(2), [[0.1]])}  # fmt: skip
    plant = from_gymnasium(gymnasium.make("Pendulum-v1"), step_limit=step_limit)
    for wide in ((-2, 2.1), lambda p: (-2.1, 1)):
        with pytest.raises(InputError, match=r"U: got inputs from .*2.1.* within \[-2.\] and \[2.\], which the sim"):
            CoDesignProblem(plant, U=wide, **given)
    problem = CoDesignProblem(plant, U=(-2, 2), **given)
    with pytest.raises(InputError, match="U: got inputs from"):
        replace(problem, U=(-3, 3))


def test_a_function_may_state_the_inputs_that_it_takes():
    given = {"nx": 1, "nu": 2, "dt": 0.1}
    box = BlackBox(lambda x, u, w, p: x + 0.1 * u.sum(), **given, input_bounds=([-1.0, 0.0], [1.0, 0.5]))
    stated = {"X": (-2, 2), "scenarios": FixedStart([1.0]), "objective": QuadraticObjective([[1.0]], np.eye(2))}
    CoDesignProblem(box, U=([-1.0, 0.0], [1.0, 0.5]), **stated)
    for wide in ((-1.0, 0.5), ([-1.0, 0.0], [1.0, 0.6])):
        with pytest.raises(InputError, match=r"U: got inputs from .* which the simulator takes"):
            CoDesignProblem(box, U=wide, **stated)
    for wrong in ([0.0, 1.0, 2.0], ([0.0], [1.0]), (0.0, np.nan), (1.0, -1.0)):
        with pytest.raises(InputError, match=r"input_bounds: .* expected \(lower, upper\), two numbers or two \(2,\)"):
            BlackBox(box.advance, **given, input_bounds=wrong)


def cost_of_a_length(length):
    """Cost of the loop above by the equations of motion."""
    gain, B = 0.05 * 3 * 10.0 / (2 * length), 0.05 * 3 / length**2
    A, B = np.array([[1 + 0.05 * gain, 0.05], [gain, 1.0]]), np.array([[0.05 * B], [B]])
    P = solve_discrete_are(A, B, np.eye(2), [[0.1]])
    K = np.linalg.solve(0.1 + B.T @ P @ B, B.T @ P @ A)[0]
    x, total = np.array([0.05, 0.0]), (length - 1.2) ** 2
    for _ in range(20):
        u = np.clip(-K @ x, -2, 2)
        v = x[1] + gain * np.sin(x[0]) + B[1, 0] * u
        x = np.array([x[0] + 0.05 * v, v])
        total += x @ x + 0.1 * u**2
    return total


def test_a_simulator_that_gives_no_number_loses_the_run_and_is_left_out_of_the_secant():
    def advance(x, u, w, p):
        after = np.stack([x[:, 0] + 0.1 * x[:, 1], x[:, 1] + 0.1 * (u[:, 0] + w[:, 0]) / p[0]], axis=1)
        after[x[:, 1] > 0.5] = np.nan
        return after

    box = BlackBox(advance, nx=2, nu=1, nw=1, dt=0.1, design=DesignSpace(["m"], [0.5], [2.0]), batched=True)
    problem = CoDesignProblem(
        box, X=(-3, 3), U=(-1, 1), objective=QuadraticObjective(np.eye(2), [[0.1]]), steps=30,
        scenarios=FixedStart([-2.0, 0.0], Gaussian([0.05])),
    )  # fmt: skip
    env = EpisodeEnv(problem, [1.0], runs=2, rng=np.random.default_rng(0))
    env.reset()
    single = DesignEnv(problem, [1.0])
    single.reset(seed=0)
    for _ in range(30):  # full power until the speed is beyond 0.5
        _, successor, reward, terminated, _ = env.step(torch.ones(2, 1))
        assert torch.isfinite(successor).all()
        assert torch.isfinite(reward).all()
        seen, paid, over, *_ = single.step(np.ones(1))
        assert np.isfinite([*seen, paid]).all()
        assert over == terminated.any()
        if over:
            break
    assert over
    found = stochastic_linearisation(problem, [1.0], np.random.default_rng(0))
    np.testing.assert_allclose(found.A, [[1.0, 0.1], [0.0, 1.0]], atol=1e-6)
    assert not found.better  # both lose their runs
    assert np.isfinite([found.mean_return, found.tangent_return]).all()
