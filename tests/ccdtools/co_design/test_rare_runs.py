"""Runs that are rare and cost much: what a method has not met it must not promise."""

from dataclasses import dataclass, replace

import casadi as ca
import numpy as np
import pytest
from small_plants import best_design, mass

from ccdtools import (
    CoDesignConfig,
    CoDesignProblem,
    CustomObjective,
    DesignSpace,
    FixedStart,
    Gaussian,
    Learned,
    Plant,
    codesign,
    discretise,
    saturated_lqr,
)
from ccdtools.co_design import CoDesignResult


def cliff():
    """A reach p that pays, until a rare push brings it over the edge."""
    x, u, w, p = ca.SX.sym("x", 2), ca.SX.sym("u"), ca.SX.sym("w"), ca.SX.sym("p")
    plant = Plant(x, u, w, p, [w, u], DesignSpace(["p"], [0.0], [2.0]), dt=1.0, continuous=False)

    def cost(x, u, p):
        """Cost of a sample."""
        return 2 - p[0] + u[0] ** 2 + x[1] ** 2 + 1e6 * ca.fmax(x[0] + p[0] - 1.5, 0) ** 2

    return CoDesignProblem(
        discretise(plant), X=([-5, -5], [5, 5]), U=(-1, 1), steps=4, limit_tolerance="off",
        objective=CustomObjective(cost, Q=np.eye(2), R=[[1.0]]), scenarios=FixedStart([0.0, 0.0], Gaussian([0.3])),
    )  # fmt: skip


@pytest.mark.check
@pytest.mark.parametrize("seed", [1, 2])
def test_a_climb_whose_runs_have_not_met_the_edge_goes_less_far_in_the_next_block(seed):
    """On 32 runs the best p is 0.7 to 0.8, beyond the edge of the runs that iterates are scored on, 0.4 to 0.65.

    One of these runs that is over the edge by 0.05 costs 6 and more; over all runs p = 0.19 is best. The climb begins
    at 0.1, and how far it comes in its budget is the processor's: 0.29 to 0.37.
    """
    config = CoDesignConfig(iterations=110, starts=1, pathwise_runs=32)
    found = Learned(config=config).run(cliff(), np.array([0.1]), np.random.default_rng(seed))
    assert 0.15 < found.design[0] < 0.65
    assert found.objective > -4 * (2 - found.design[0]) - 0.5


CoDesignStatus = type(CoDesignResult(design=np.zeros(1)).status)


@dataclass(frozen=True)
class Promising:
    """Method that hands out LQR and promises a return."""

    promise: float
    status: object = CoDesignStatus.CONVERGED
    name: str = "promising"

    def run(self, problem, design, rng, *, progress=False):
        return CoDesignResult(
            design=design, controller=saturated_lqr(problem, design), method=self.name, status=self.status,
            objective=self.promise,
        )  # fmt: skip


@pytest.mark.long
@pytest.mark.parametrize(("part", "kept"), [(0.0, True), (0.3, True), (0.9, False)])
def test_a_return_that_the_closed_loop_does_not_keep_is_unforeseen(part, kept):
    problem = mass()
    design, expected = best_design(problem)
    promising = Promising(expected + part * abs(expected))
    found = codesign(problem, method=promising, design=design, rng=np.random.default_rng(0))
    assert found.status is (CoDesignStatus.CONVERGED if kept else CoDesignStatus.UNFORESEEN)
    assert found.status.settled == kept
    unsettled = replace(promising, status=CoDesignStatus.BUDGET_SPENT)
    found = codesign(problem, method=unsettled, design=design, rng=np.random.default_rng(0))
    assert found.status is CoDesignStatus.BUDGET_SPENT
    assert (CoDesignStatus.UNFORESEEN.advice in found.describe()) != kept
