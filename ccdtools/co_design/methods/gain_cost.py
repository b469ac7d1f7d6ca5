"""One feedback gain found with the design, by closed-loop cost within the limits.

References
----------
Levine and Athans, "On the determination of the optimal constant output feedback gains for linear multivariable
systems", IEEE Transactions on Automatic Control 15, 1970 (gains by gradient, without saturation or limits).
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import torch

from ccdtools.arrays import Array
from ccdtools.co_design.design_controllers import DesignLaw, fed_back, saturated_lqr
from ccdtools.co_design.differentiable_model import Law, ScenarioTensors, Stepper, in_double, to_design, visited
from ccdtools.co_design.methods.loop_cost import LoopCost
from ccdtools.co_design.problem import CoDesignProblem
from ccdtools.co_design.tolerances import SATURATION
from ccdtools.controllers.controllers import LinearFeedback
from ccdtools.plants.design_space import DesignSpace
from mpc import NotStabilisableError


def gain_cost(problem: CoDesignProblem, v: Array, scenarios: ScenarioTensors) -> LoopCost:
    """Cost over designs p with ΔK of u = clip(k(p) − (K(p) + ΔK) x), k(p) and K(p) those of LQR.

    A search begins at ΔK = 0. Its unit of an entry of ΔK is what takes its state, of the size that LQR's loop gives it
    at the point `v` (np,), to the largest input there; the further, the longer its steps. Where LQR has no gain, the
    cost has no value either.
    """
    try:
        reach = _reach(problem, v, scenarios)
    except NotStabilisableError:
        return LoopCost(problem, _law(np.zeros(0)), scenarios)
    space, limits = problem.design, problem.design.constraints
    nx = problem.model.nx
    ends = np.ones(len(reach))
    searched = DesignSpace(
        [*space.names, *(f"ΔK {i // nx + 1},{i % nx + 1}" for i in range(len(reach)))], np.r_[space.lower, -ends],
        np.r_[space.upper, ends], integer=space.integer,
        constraints=None if limits is None else lambda p: limits(p[: space.dim]),
        constraint_names=space.constraint_names,
    )  # fmt: skip
    return LoopCost(problem, _law(reach), scenarios, searched=searched)


def _reach(problem: CoDesignProblem, v: Array, scenarios: ScenarioTensors) -> Array:
    """Units of the entries of ΔK, by rows."""
    own = in_double(problem)
    p = to_design(own, torch.tensor(v, dtype=torch.float64))
    step = Stepper.at(own, p)
    x, u, _ = visited(step, fed_back(own, p), (scenarios[0].double(), scenarios[1].double()))
    size = x.clamp(-step.limit, step.limit).square().mean(dim=0).sqrt().clamp(min=1e-12)
    return np.asarray((u.abs().amax(dim=0)[:, None] / size).flatten().clamp(min=1e-12))


def _law(reach: Array) -> DesignLaw:
    """Gain of a point (p, z), z from −1 to 1 for each entry of ΔK, clipped to U.

    Clipping is rounded off: from a fixed start the best gain often just reaches a bound at once in all runs, where it
    has a kink.
    """
    units = torch.tensor(reach)

    def controller(problem: CoDesignProblem, at: Array) -> LinearFeedback:
        own = saturated_lqr(problem, at[: problem.design.dim])
        return replace(own, K=own.K + _stretched(at[problem.design.dim :], reach).reshape(own.K.shape))

    def law(problem: CoDesignProblem, at: torch.Tensor) -> Law:
        n = problem.design.dim
        return fed_back(problem, torch.cat([at[:n], _stretched(at[n:], units)]), rounding=SATURATION)

    return DesignLaw("one saturated gain", controller, law)


def _stretched(z: Any, reach: Any, *, most: float = 100.0) -> Any:
    """Entries of ΔK at z, `most` units at its ends."""
    return reach * z / (1.0 - (1.0 - 1.0 / most) * z * z)
