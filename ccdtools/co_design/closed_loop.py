"""What a controller brings in closed loop on the scenarios of a problem."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from numpy.typing import ArrayLike
from torch import Tensor

from ccdtools.checks import as_count, as_generator, as_instance
from ccdtools.co_design.differentiable_model import Stepper, in_double, scenario_tensors
from ccdtools.co_design.episodes import fewer_runs, simulated
from ccdtools.co_design.limit_tolerance import measured, measurement_errors
from ccdtools.co_design.problem import CoDesignProblem
from ccdtools.co_design.result import ClosedLoopReturns
from ccdtools.co_design.risk import fewest_runs
from ccdtools.controllers.signals import Driver, Surroundings

RUNS = 1000  # scenarios of 100 steps; of longer ones fewer are taken,
ONLINE_RUNS = 200  # and of a controller that plans ahead at every sample


def closed_loop_returns(
    problem: CoDesignProblem, controller: Any, design: ArrayLike, rng: np.random.Generator, *, runs: int | None = None
) -> ClosedLoopReturns:
    """Returns of a controller at a design on scenarios of a problem, with its learned errors if it has any.

    Two controllers with generators of the same seed meet the same scenarios, the one with fewer runs the first of them.

    Parameters
    ----------
    problem : CoDesignProblem
    controller : callable
        Of the state; it may have memory.
    design : (np,) array_like
    rng : numpy.random.Generator
    runs : int, optional
        At most, and by default, as many as 1000 of 100 steps; by default 200 of a controller with a horizon. Of a worst
        case at least one of every case.

    Raises
    ------
    InputError
        If the design is outside its bounds, or the controller returns the wrong shape or asks for unknown signals.
    """
    as_instance("problem", problem, CoDesignProblem, "a CoDesignProblem")
    as_generator("rng", rng)
    p = torch.tensor(problem.design.check_one(design))
    all_runs = fewer_runs(RUNS, problem.steps)
    x0, w = (part.double() for part in scenario_tensors(problem, all_runs, rng))
    chosen = ONLINE_RUNS if hasattr(controller, "horizon") else RUNS
    n = fewer_runs(chosen, problem.steps) if runs is None else as_count("runs", runs)
    n = min(max(n, fewest_runs(problem.risk)), len(x0))
    x0, w = x0[:n], w[:n]
    if (x0 == x0[0]).all() and (w == w[0]).all():  # all runs are one
        x0, w = x0[:1], w[:1]
    own = Surroundings(np.zeros((len(x0), 0, 0)), None, None, recorded=False)
    driver = Driver(controller, own, len(x0), problem.model.nu)
    sample = iter(range(problem.steps * 2))

    def law(x: Tensor) -> Tensor:
        """Inputs (n, nu)."""
        u = np.asarray(driver(next(sample), x.numpy()), dtype=float)
        driver.remember(u)
        return x.new_tensor(u)

    with torch.no_grad():
        seen = simulated(Stepper.at(in_double(problem), p), law, (x0, w), depths=True)
    limits = measured(seen)
    total, lost = (np.repeat(value.numpy(), n // len(x0)) for value in (seen.total, seen.diverged))
    errors = measurement_errors(seen).values()
    return ClosedLoopReturns(total, lost, limits.fraction, limits.depth, problem.risk, errors)
