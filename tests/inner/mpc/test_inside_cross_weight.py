"""What test_cross_weight.py claims, seen from inside."""

import numpy as np
import pytest
from weighted_outputs import output_case, output_cost, output_plan

from mpc.problem import MPCProblem
from mpc.rollout import spread_signals
from mpc.solving import stagewise_candidate


@pytest.mark.check
def test_stage_by_stage_the_plan_is_that_of_least_output_cost_with_blocks_and_references_too():
    held = 0
    for seed in range(40):
        data, outputs, x, signals = output_case(np.random.default_rng([15, seed]))
        if "X" in data and "soft" not in data:  # stage by stage, violations have a price
            del data["X"]
        problem = MPCProblem(**data)
        start = np.zeros((problem.horizon, problem.nu))
        found = stagewise_candidate(problem, x, spread_signals(problem, signals), start, 1.0)
        best = output_plan(data, outputs, problem.P, x, signals)
        assert found.residuals.stationarity < 1e-8  # of the last Newton step
        cost, least = (output_cost(data, outputs, problem.P, *plan, signals) for plan in
                       ((found.inputs, found.states), best))  # fmt: skip
        assert cost == pytest.approx(least, rel=1e-6, abs=1e-9)
        held += "blocks" in data
    assert held >= 5
