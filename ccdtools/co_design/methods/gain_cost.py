"""One feedback gain found with the design, by closed-loop cost within the limits.

References
----------
Levine and Athans, "On the determination of the optimal constant output feedback gains for linear multivariable
systems", IEEE Transactions on Automatic Control 15, 1970 (gains by gradient, without saturation or limits).
"""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import numpy as np
import torch

from ccdtools.arrays import Array
from ccdtools.co_design.design_controllers import DesignLaw, fed_back, saturated_lqr
from ccdtools.co_design.differentiable_model import ScenarioTensors, Stepper, in_double, to_design, visited
from ccdtools.co_design.methods.loop_cost import LoopCost
from ccdtools.co_design.problem import CoDesignProblem
from ccdtools.co_design.tolerances import SATURATION
from ccdtools.controllers.controllers import LinearFeedback
from ccdtools.plants.design_space import DesignSpace
from mpc import NotStabilisableError


def gain_cost(problem: CoDesignProblem, v: Array, scenarios: ScenarioTensors) -> LoopCost:
    """Cost over designs p with ΔK of u = clip(−(K(p) + ΔK) x), K(p) that of LQR.

    A search begins at ΔK = 0. An entry of ΔK goes no further than takes its state, of the size that LQR's loop gives it
    at the point `v` (np,), to the largest input there; where LQR has no gain, the cost has no value either.
    """
    try:
        return LoopCost(problem, GAIN, scenarios, searched=_with_gain(problem, v, scenarios))
    except NotStabilisableError:
        return LoopCost(problem, GAIN, scenarios)


def _with_gain(problem: CoDesignProblem, v: Array, scenarios: ScenarioTensors) -> DesignSpace:
    """Box of designs with ΔK, by rows."""
    own, space = in_double(problem), problem.design
    p = to_design(own, torch.tensor(v, dtype=torch.float64))
    step = Stepper.at(own, p)
    x, u, _ = visited(step, fed_back(own, p), (scenarios[0].double(), scenarios[1].double()))
    size = x.clamp(-step.limit, step.limit).square().mean(dim=0).sqrt().clamp(min=1e-12)
    reach = (u.abs().amax(dim=0)[:, None] / size).flatten().clamp(min=1e-12).numpy()
    names = [f"ΔK {i + 1},{j + 1}" for i in range(len(reach) // len(size)) for j in range(len(size))]
    limits = space.constraints
    return DesignSpace(
        [*space.names, *names], np.r_[space.lower, -reach], np.r_[space.upper, reach], integer=space.integer,
        constraints=None if limits is None else lambda p: limits(p[: space.dim]),
        constraint_names=space.constraint_names,
    )  # fmt: skip


def _controller(problem: CoDesignProblem, at: Array) -> LinearFeedback:
    """Gain of a point (p, ΔK), clipped to U."""
    own = saturated_lqr(problem, at[: problem.design.dim])
    return replace(own, K=own.K + at[problem.design.dim :].reshape(own.K.shape))


# From a fixed start the best gain often just reaches a bound at once in all runs, where clipping has a kink.
GAIN = DesignLaw("one saturated gain", _controller, partial(fed_back, rounding=SATURATION))
