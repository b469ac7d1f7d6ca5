"""What goes on where a climb ended behind a baseline: from its design, by what leads there."""

from dataclasses import dataclass, field, replace

import casadi as ca
import numpy as np
import pytest
import torch
from small_plants import best_design, clone_of, mass

from ccdtools import CoDesignConfig, CoDesignProblem, Learned, Plant, codesign, discretise, saturated_lqr
from ccdtools.co_design import CoDesignResult

CoDesignStatus = type(CoDesignResult(design=np.zeros(1)).status)


@dataclass(frozen=True)
class Named:
    """Another method under a name of its own."""

    name: str
    method: object

    def run(self, problem, design, rng, *, progress=False):
        return replace(self.method.run(problem, design, rng, progress=progress), method=self.name)

    def instead(self, result, problem):
        return replace(self, name="going on") if result.status is CoDesignStatus.WORSE_THAN_BASELINE else None


@dataclass(frozen=True)
class Staying:
    """Method that hands out LQR where it begins, and has another that goes on."""

    begun: list = field(default_factory=list)
    name: str = "staying"

    def run(self, problem, design, rng, *, progress=False):
        self.begun.append(design)
        controller = saturated_lqr(problem, design)
        return CoDesignResult(design=design, controller=controller, method=self.name, status=CoDesignStatus.CONVERGED)

    def instead(self, result, problem):
        return self if result.status is CoDesignStatus.WORSE_THAN_BASELINE else None


@pytest.mark.long
def test_behind_a_baseline_the_next_climb_begins_at_its_design():
    problem, method = mass(), Staying()
    best, _ = best_design(problem)
    found = codesign(problem, method=method, design=[2.8], rng=np.random.default_rng(0))
    assert [one.tolist() for one in method.begun] == [[2.8], found.design.tolist()]
    assert found.design == pytest.approx(best, rel=0.05)
    assert found.status is CoDesignStatus.CONVERGED
    assert any("staying ended with worse than a baseline; staying went on and gained" in note for note in found.notes)


@pytest.mark.long
def test_a_result_is_named_by_what_was_asked_for_and_what_went_on():
    found = codesign(mass(), method=Named("asked", Staying()), design=[2.8], rng=np.random.default_rng(0))
    assert found.method == "asked, then going on"
    assert found.describe()[1].startswith("asked, then going on: converged")


def bouncing():
    """The mass, whose speed jumps at a wall."""
    x, u, w, p = ca.SX.sym("x", 2), ca.SX.sym("u"), ca.SX.sym("w"), ca.SX.sym("p")
    step = ca.vertcat(x[0] + 0.1 * x[1], 0.97 * x[1] + 0.1 * (u - 2 * x[0] + w) / p)
    hit = step[0] < -0.8
    after = ca.vertcat(ca.if_else(hit, -1.6 - step[0], step[0]), ca.if_else(hit, -0.5 * step[1], step[1]))
    stated = mass()
    plant = Plant(x, u, w, p, after, stated.design, dt=0.1, continuous=False)
    return CoDesignProblem(
        discretise(plant), X=stated.X, U=stated.U, objective=stated.objective, scenarios=stated.scenarios,
        steps=stated.steps, limit_tolerance="off",
    )  # fmt: skip


@pytest.mark.long
@pytest.mark.filterwarnings("ignore::UserWarning")
@pytest.mark.parametrize(("make", "by"), [(mass, "pathwise"), (bouncing, "ppo")])
def test_a_gradient_that_leads_is_followed_on_and_another_gives_way_to_ppo(make, by):
    problem = make()
    agent = clone_of(mass())
    climb = Learned(agent=agent, config=CoDesignConfig(iterations=2, starts=1))
    found = climb.run(problem, np.array([1.0]), np.random.default_rng(0))
    behind = replace(found, status=CoDesignStatus.WORSE_THAN_BASELINE)
    further = climb.instead(behind, problem)
    assert (further.by, further.agent) == (by, behind.agent)
    assert Learned(by="ppo").instead(behind, problem) is None


@pytest.mark.check
def test_the_gradient_of_a_policy_is_compared_before_a_climb():
    problem = mass()
    weak = replace(problem, U=(-1e-3, 1e-3))  # so that a policy that does its utmost in all states is hardly worse
    bound = clone_of(weak)
    torch.nn.init.constant_(bound.mean_network.head.bias, 50.0)
    short = CoDesignConfig(iterations=2, block=2, pathwise_runs=16, evaluation_runs=16, starts=1)
    rng = np.random.default_rng(0)
    found, blind = (
        Learned(agent=agent, config=short).run(one, np.array([1.0]), rng)
        for one, agent in ((problem, clone_of(problem)), (weak, bound))
    )
    assert found.first_policy_gradients.trusted
    assert not any("at the first design" in line for line in found.describe())
    assert blind.first_policy_gradients.blind == 1.0
    assert "at the first design the policy has no gradient in 100% of the runs" in blind.describe()
