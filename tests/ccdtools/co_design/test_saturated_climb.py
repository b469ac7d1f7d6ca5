"""Where LQR does nothing that could be imitated, a policy from scratch climbs beside it along its own gradient."""

import casadi as ca
import numpy as np
import pytest

from ccdtools import (
    CoDesignConfig,
    CoDesignProblem,
    CustomObjective,
    DesignSpace,
    Gaussian,
    Plant,
    RandomStarts,
    Scenario,
    codesign,
    discretise,
)
from ccdtools.disturbances import Uniform

pytestmark = pytest.mark.check
DT, STEPS, STIFFNESS, SHARE, DAMPING = 0.1, 40, 2.0, 0.6, 0.1


def moved(q, v, u, push, stiffness):
    """Place and speed of a mass after a sample, on a spring that the input makes stiffer or softer."""
    v = v + DT * (-stiffness * (1 + SHARE * u) * q - DAMPING * v + push)
    return q + DT * v, v


@pytest.fixture(scope="module")
def oscillator():
    """Return the problem: LQR at rest does nothing, as the input moves nothing there."""
    x, u, w, p = ca.SX.sym("x", 2), ca.SX.sym("u"), ca.SX.sym("w"), ca.SX.sym("k")
    box = ([-10, -10], [10, 10])
    plant = Plant(x, u, w, p, ca.vertcat(*moved(x[0], x[1], u, w, p)), DesignSpace(["k"], [1.0], [3.0]), dt=DT,
                  continuous=False)  # fmt: skip
    objective = CustomObjective(lambda x, u, p: x[0] ** 2 + 0.2 * x[1] ** 2, Q=np.diag([1.0, 0.2]), R=[[0.01]])
    starts = RandomStarts(Uniform([-2, -2], [2, 2]), Gaussian([0.5]))
    return CoDesignProblem(discretise(plant, X=box, U=(-1, 1)), X=box, U=(-1, 1), objective=objective, scenarios=starts,
                           steps=STEPS, limit_tolerance="off")  # fmt: skip


@pytest.fixture(scope="module")
def found(oscillator):
    """Return a co-design that begins with nothing."""
    config = CoDesignConfig(design_rate=0.0, iterations=80, block=20, runs=8, pathwise_runs=64, evaluation_runs=256)
    return codesign(oscillator, rng=np.random.default_rng(0), design=[STIFFNESS], config=config)


def test_the_policy_from_scratch_climbs_along_its_gradient(found):
    said = "\n".join(found.describe())
    assert found.method == "pathwise"
    assert "PPO learned from scratch what the policy began with" in said
    assert found.status.name == "CONVERGED"


def test_it_is_better_than_a_switch_that_takes_energy_at_once(oscillator, found):
    """Stiff on the way out, soft on the way back: -22.5, where the best constant stiffness is far below."""
    x0, w = oscillator.scenarios.sample(500, STEPS, np.random.default_rng(7))
    scenario = Scenario(oscillator.model, x0, w)
    switched, own = (
        scenario.run(law, design=[STIFFNESS]).returns(oscillator.objective).mean()
        for law in (lambda x: np.sign(x[..., :1] * x[..., 1:]), found.controller)
    )
    assert own > switched
