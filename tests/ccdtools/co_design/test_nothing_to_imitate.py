"""Plants on which no expert keeps a run, or of which there is none."""

import casadi as ca
import numpy as np
import pytest

from ccdtools import (
    CoDesignConfig,
    CoDesignProblem,
    DesignSpace,
    FixedStart,
    Gaussian,
    InputError,
    Learned,
    Plant,
    QuadraticObjective,
    codesign,
    discretise,
)
from ccdtools.co_design import expert_dataset
from ccdtools.plants import BlackBox

BOX = DesignSpace(["gain"], [1.0], [3.0])
FEW = CoDesignConfig(iterations=4, pathwise_runs=8, evaluation_runs=16)


def escaping(model, U=0.2):
    """Problem whose runs leave whatever is done."""
    return CoDesignProblem(
        model, X=(-1, 1), U=(-U, U), steps=20, limit_tolerance="off", objective=QuadraticObjective([[1.0]], [[0.01]]),
        scenarios=FixedStart([0.5], Gaussian([0.0])),
    )  # fmt: skip


def equations(step):
    x, u, w, p = (ca.SX.sym(name) for name in "xuwp")
    return discretise(Plant(x, u, w, p, step(x, u, p) + w, BOX, 0.1, continuous=False))


def simulator(x, u, w, p):
    return 2 * x + 0.1 * u * p


@pytest.mark.check
@pytest.mark.usefixtures("brief")
@pytest.mark.parametrize("model", ["equations", "simulator"])
def test_a_plant_that_escapes_every_law_is_told_as_diverging(model):
    if model == "equations":
        model = equations(lambda x, u, p: 2 * x + 0.1 * p * u + 0.001 * x**3)
    else:
        model = BlackBox(simulator, nx=1, nu=1, nw=1, dt=0.1, design=BOX, batched=True)
    found = codesign(escaping(model), method="pathwise", config=FEW, rng=np.random.default_rng(0))
    assert found.status.name == "DIVERGING"


@pytest.mark.check
def test_a_plant_whose_input_does_nothing_at_rest_imitates_the_secant():
    model = equations(lambda x, u, p: 1.1 * x + 0.1 * p * u * x)
    found = codesign(escaping(model, U=2.0), method="pathwise", config=FEW, rng=np.random.default_rng(0))
    assert not found.closed_loop.lost.any()
    assert found.closed_loop.summary.mean > -1.0  # held at 0 the input lets the state grow to 3, which costs 60


@pytest.mark.check
@pytest.mark.usefixtures("brief")
def test_a_plant_of_which_there_is_no_expert_is_learned_from_scratch():
    model = equations(lambda x, u, p: 3 * x - 0.7 * p * u**2 * x)
    found = Learned(by="ppo", config=FEW).run(escaping(model, U=2.0), np.array([2.0]), np.random.default_rng(0))
    assert "PPO learned from scratch what the policy began with" in found.notes


def test_an_expert_without_a_regulator_is_refused_by_its_cause():
    problem = escaping(equations(lambda x, u, p: 1.1 * x + 0.1 * p * u * x))
    with pytest.raises(InputError, match="none lies in X at a design with an LQR"):
        expert_dataset(problem, samples=20, rng=np.random.default_rng(0))
