"""What test_output_limits.py claims, seen from inside."""

import casadi as ca
import numpy as np
import pytest
import torch

from ccdtools import (
    CoDesignProblem,
    DesignSpace,
    FixedStart,
    Gaussian,
    OutputLimits,
    Plant,
    QuadraticObjective,
    discretise,
)
from ccdtools.co_design.differentiable_model import Stepper, simulated
from ccdtools.co_design.least_depth import warn_of_unavoidable_depth
from ccdtools.exceptions import LimitWarning

x, u, w, p = ca.SX.sym("x", 2), ca.SX.sym("u"), ca.SX.sym("w"), ca.SX.sym("p", 1)
FORCE = p[0] * x[0]
PLANT = Plant(
    x, u, w, p, ca.vertcat(x[1], -FORCE + u + w), DesignSpace(["k"], [0.5], [2.0]), dt=0.1,
    outputs=[FORCE, u - x[1]], output_names=["spring force [N]", "slip [m/s]"],
    output_limits=([-np.inf, -3.0], [0.8, 5.0]),
)  # fmt: skip
MODEL = discretise(PLANT)
OBJECTIVE = QuadraticObjective(np.eye(2), [[0.05]])
LIMITS = OutputLimits.of(PLANT)


def problem(**changes):
    given = {"scenarios": FixedStart([0.5, 0.0], Gaussian([0.05])), "steps": 60, "output_limits": LIMITS}
    return CoDesignProblem(MODEL, ([-2, -3], [2, 3]), ([-4], [4]), OBJECTIVE, **(given | changes))


def test_an_output_that_is_no_number_is_beyond_its_limit_in_training_too():
    root = OutputLimits(lambda x, u, p: ca.sqrt(x[0]), upper=2.0)
    z, v, q = np.array([[-1.0, 0.0], [1.0, 0.0]]), np.zeros((2, 1)), np.array([1.0])
    for of in (np.asarray, lambda part: torch.tensor(part, dtype=torch.float32)):
        np.testing.assert_allclose(root.depths(of(z), of(v), of(q)), [[np.inf], [-0.5]])
    scenarios = (torch.tensor([[-1.0, 0.0], [0.5, 0.0]]), torch.zeros(2, 1, 1))
    step = Stepper.at(problem(output_limits=root), torch.tensor([1.0]))
    seen = simulated(step, lambda x: torch.zeros(2, 1), scenarios, depths=True)
    np.testing.assert_array_equal(seen.peak, [np.inf, 0.0])
    np.testing.assert_array_equal(seen.outside, [1.0, 0.0])


def test_a_start_that_breaks_a_limit_at_the_first_design_alone_is_warned_of():
    own = problem(scenarios=FixedStart([0.5, 0.0], Gaussian([0.05])))
    warn_of_unavoidable_depth(own, [1.5])
    with pytest.warns(LimitWarning, match=r"the start breaks a limit .* whatever the input: spring force \[N\] > 0.8"):
        warn_of_unavoidable_depth(own, [1.7])
