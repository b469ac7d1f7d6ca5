"""The expert, and the PID, on a model with a learned error: what is stepped is the model that is trained on."""

from dataclasses import replace

import casadi as ca
import numpy as np
import pytest
import torch

from ccdtools import (
    CoDesignProblem,
    DesignSpace,
    FixedStart,
    Gaussian,
    InputError,
    Plant,
    QuadraticObjective,
    baselines,
    discretise,
    saturated_lqr,
    simulate,
)
from ccdtools.co_design import expert_dataset
from ccdtools.co_design.lqr_regions import times
from ccdtools.comparison.pid_tuning import tuned_pid
from ccdtools.twin import replay_problem
from ccdtools.twin.discrepancy import Discrepancy, TwinPlant
from ccdtools.twin.replay import Replay
from ccdtools.twin.residuals import Residuals
from invariant_sets import Polytope
from learning.quantile import QuantileNetwork

PUSH = np.array([0.05, 0.0, -0.02])  # an error in directions that the disturbance does not enter in
GAMMA = 0.9
FOLLOWED = 464  # steps of a loop, most of them to look ahead


def problem_of(disturbances):
    """Three states with the disturbances (1 or 2) in the second and third, one input; episodes of 30 steps."""
    x, u, w, p = ca.SX.sym("x", 3), ca.SX.sym("u"), ca.SX.sym("w", disturbances), ca.SX.sym("p")
    force = u + w[0]
    change = ca.vertcat(x[1], -p * x[0] - x[1] + force, -x[2] + (w[1] if disturbances > 1 else 0.0))
    plant = Plant(x, u, w, p, change, DesignSpace(["k"], [1.0], [2.0]), dt=0.1)
    return CoDesignProblem(
        discretise(plant), X=Polytope.from_bounds([-1] * 3, [1] * 3), U=Polytope.from_bounds([-1], [1]),
        objective=QuadraticObjective(np.eye(3), 1.0), scenarios=FixedStart([0.5, 0, 0], Gaussian([0.1] * disturbances)),
        steps=30,
    )  # fmt: skip


def network(median=(0.0, 0.0, 0.0), on_input=(0.0, 0.0, 0.0)):
    """Quantiles of e⁺ (3,) of which the median is given, and may grow with u."""
    made = QuantileNetwork(7, 3, (0.1, 0.5, 0.9), (4,))
    for parameter in made.parameters():
        torch.nn.init.zeros_(parameter)
    made.output_offset.copy_(torch.tensor(median))
    made.median_network.skip.weight.data[:, 6] = torch.tensor(on_input)
    return made


def replaying(problem, error, learned, steps=40):
    """The problem on an updated model whose log, of so few steps, left the same error unexplained all the time."""
    zeros = np.zeros((2, steps, 3))
    log = Residuals(zeros, zeros, np.zeros((2, steps, 1)), np.array([1.5]), np.broadcast_to(error, zeros.shape))
    discrepancy = Discrepancy(learned, np.eye(3), noise="replayed")
    return replace(problem, discrepancy=discrepancy, scenarios=Replay([log]))


def discounted(problem, state, w):
    """What `simulate` says that LQR gets on the updated model, penalty and stationary rest included."""
    x, p = state[:3], state[3:]
    plant = TwinPlant(problem.model, problem.discrepancy)
    run = simulate(plant, saturated_lqr(problem, p), x0=x, steps=FOLLOWED, disturbance=np.tile(w, (FOLLOWED, 1)),
                   design=p)  # fmt: skip
    width = 2 * np.log(2)  # of the quantiles of a network of zeros, in each state
    rewards = problem.objective.rewards(run.states[0, 1:], run.inputs[0]) - 3 * width**2
    return (rewards * GAMMA ** np.arange(FOLLOWED)).sum() + GAMMA**FOLLOWED / (1 - GAMMA) * rewards[-100:].mean()


@pytest.mark.check
@pytest.mark.parametrize("disturbances", [1, 2])
@pytest.mark.parametrize("explained", [True, False])
def test_values_are_those_of_the_updated_model(disturbances, explained):
    learned = network(PUSH if explained else 0 * PUSH)
    left = 0 * PUSH if explained else PUSH
    problem = replaying(problem_of(disturbances), left, learned)
    rng = np.random.default_rng(0)
    data = expert_dataset(problem, samples=6, rng=rng, gamma=GAMMA, sets="none")
    assert data.diverged == 0
    for state, value in list(zip(data.inputs, data.values))[::20]:
        assert value == pytest.approx(discounted(problem, state, left), rel=1e-4)


@pytest.mark.long
def test_a_model_that_draws_its_errors_is_followed_too_and_a_lost_run_stays_lost():
    problem = replace(problem_of(2), discrepancy=Discrepancy(network(5 * PUSH), np.eye(3), noise="quantiles"))
    a, b = (expert_dataset(problem, samples=4, rng=np.random.default_rng(1), sets="none") for _ in range(2))
    np.testing.assert_array_equal(a.values, b.values)
    lost = replaying(problem_of(1), 1e4 * PUSH, network())
    assert expert_dataset(lost, samples=6, rng=np.random.default_rng(2), sets="none").diverged == 1


def test_a_log_shorter_than_the_loops_that_are_followed_is_enough():
    problem = problem_of(1)
    log = replaying(problem, PUSH, network()).scenarios.logs
    data = expert_dataset(replay_problem(problem, log, 40), samples=6, rng=np.random.default_rng(0), sets="none")
    assert np.isfinite(data.values).all()


def test_matrices_refuse_vectors_of_another_width():
    with pytest.raises(InputError, match="x: got 3 columns, expected 1, as the matrices have"):
        times(np.ones((5, 2, 1)), np.ones((5, 3)))


# ── the PID of the baselines ──


@pytest.mark.check
def test_the_pid_is_tuned_on_the_updated_model():
    nominal = problem_of(1)
    strong = 1.5 * nominal.model.matrices([1.5])[1][:, 0]
    updated = replaying(nominal, 0.3 * PUSH, network(on_input=strong))
    options = dict(runs=2, screened=60, starts=1, refinements=1)  # both choose among the same candidates
    plant = TwinPlant(updated.model, updated.discrepancy)
    x0, w = updated.scenarios.sample(2, 30, np.random.default_rng(1))
    returns = []
    for problem in (updated, nominal):
        pid = tuned_pid(problem, [1.5], rng=np.random.default_rng(0), **options)
        run = simulate(plant, pid, x0=x0, steps=30, disturbance=w, design=[1.5])
        returns.append(run.returns(updated.objective).mean())
    assert returns[0] > returns[1] + 0.01 * abs(returns[1])


@pytest.mark.check
def test_baselines_take_an_updated_problem_and_refuse_one_whose_draws_have_no_offset():
    updated = replace(replaying(problem_of(2), PUSH, network()), steps=4)
    assert list(baselines(updated, [1.5], rng=np.random.default_rng(0))) == ["passive", "LQR", "PID", "MPC"]
    drawing = replace(updated, discrepancy=replace(updated.discrepancy, noise="quantiles"))
    with pytest.raises(InputError, match=r"problem\.discrepancy: got noise 'quantiles', which no offset"):
        tuned_pid(drawing, [1.5], rng=np.random.default_rng(0))
