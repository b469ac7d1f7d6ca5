"""Closed-loop returns of a controller at a design."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import torch
from numpy.typing import ArrayLike
from torch import Tensor

from ccdtools.arrays import Array, Immutable, Indices, Mask
from ccdtools.co_design.differentiable_model import Stepper, fewer_runs, in_double, scenario_tensors, simulated
from ccdtools.co_design.limits import measured, measurement_errors
from ccdtools.co_design.problem import CoDesignProblem
from ccdtools.co_design.risk import MEAN, Mean, Risk, fewest_runs, measure
from ccdtools.co_design.risk_intervals import parts_of_risk, summarise_in_risk
from ccdtools.controllers.signals import Driver
from ccdtools.exceptions import InputError
from ccdtools.statistics import Summary
from ccdtools_ground.door import as_count, as_generator, as_instance

RUNS = 1000  # So many scenarios of 100 steps are taken, of longer ones fewer.
ONLINE_RUNS = 200  # A controller that plans ahead at every sample has so many.


@dataclass(frozen=True, eq=False, repr=False)
class ClosedLoopReturns(Immutable):
    """Returns of a controller at a design, run by run.

    Attributes
    ----------
    values : (n,) array
        Returns. A run that is lost has its whole, huge cost, which no summary counts.
    lost : (n,) array of bool
        Runs that diverged.
    outside, depth : float
        Fraction of the states outside the limits, and mean over the runs of the peak depth in half-widths; of the runs
        that are not lost.
    risk : Risk
        What of the returns counts.
    limit_errors : (float, float)
        Standard errors of both.
    beyond_inputs : float
        Furthest that an input is asked for beyond U, in half-widths of U; of lost runs, too.
    labels : (n,) int array, optional
        The logged run, or stretch of one, that each run is drawn from: intervals and `parts` are over these.
    warm_up : int
        First samples of every run, which do not count.
    """

    values: Array
    lost: Mask
    outside: float = 0.0
    depth: float = 0.0
    risk: Risk = MEAN
    limit_errors: tuple[float, float] = (0.0, 0.0)
    beyond_inputs: float = 0.0
    labels: Indices | None = None
    warm_up: int = 0

    def __repr__(self) -> str:
        return f"ClosedLoopReturns({self})"

    def __str__(self) -> str:
        """Value of the risk, with numbers of kept and lost runs."""
        found = self.summary
        low, high = found.ci95
        what = "" if isinstance(self.risk, Mean) else f"{measure(self.risk)} "
        ends = f" [{low:.6g}, {high:.6g}]" if np.isfinite(found.ci95).all() else ""
        lost = f"; {self.lost_share:.2%} of the runs lost, not counted" if self.lost.any() else ""
        logged = 0 if self.labels is None else len(np.unique(self.labels))
        drawn = f" drawn from {logged} logged stretch{'es' * (logged > 1)}" if logged else ""
        counted = f", from sample {self.warm_up} on" if self.warm_up else ""
        runs = f"{found.n} runs{drawn}{counted}"
        return f"{what}{found.mean:.6g}{ends}, {runs}{lost}{found.warning and f'; {found.warning}'}"

    @cached_property
    def summary(self) -> Summary:
        """Risk and 95 % interval of kept runs, see `summarise_in_risk`."""
        return summarise_in_risk(self.risk, self.values, self.lost, self.labels)

    def parts(self, runs: Indices) -> Array:
        """Parts (k,) of these runs, or of what was logged among them, in the risk, see `parts_of_risk`."""
        labels = None if self.labels is None else self.labels[runs]
        return parts_of_risk(self.risk, self.values[runs], labels, runs)

    @property
    def lost_share(self) -> float:
        """Fraction of the runs that diverged."""
        return float(self.lost.mean()) if len(self.lost) else float("nan")


def closed_loop_returns(
    problem: CoDesignProblem, controller: Any, design: ArrayLike, rng: np.random.Generator, *, runs: int | None = None
) -> ClosedLoopReturns:
    """Returns of a controller at a design, with learned errors included.

    Two controllers with generators of the same seed meet the same scenarios, the one with fewer runs the first of them.

    Parameters
    ----------
    problem : CoDesignProblem
    controller : callable
        Of the state, or of the measurement that the problem has; it may have memory.
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
    labels = stretches(problem, all_runs, rng)
    x0, w = (part.double() for part in scenario_tensors(problem, all_runs, rng))
    chosen = ONLINE_RUNS if hasattr(controller, "horizon") else RUNS
    n = fewer_runs(chosen, problem.steps) if runs is None else as_count("runs", runs)
    n = min(max(n, fewest_runs(problem.risk)), len(x0))
    x0, w = x0[:n], w[:n]
    sensor = None
    if problem.measurement is not None:
        noisy = problem.measurement.drawn(all_runs, problem.steps, rng).first(n, problem.steps)
        sensor = noisy.sensor(problem.model, p.numpy(), n, problem.steps, None)
    elif (x0 == x0[0]).all() and (w == w[0]).all():  # all runs are one
        x0, w = x0[:1], w[:1]
    nothing = np.zeros((len(x0), 0, 0))
    acting = behind_filter(problem, controller, p.numpy())
    driver = Driver(acting, len(x0), problem.model.nu, disturbances=nothing, recorded=False, output=sensor)
    sample = iter(range(problem.steps * 2))
    least, most = problem.input_bounds_at(p.numpy())
    beyond: list[float] = []

    def law(x: Tensor) -> Tensor:
        """Inputs (n, nu)."""
        known = x.nan_to_num(0.0, 0.0, 0.0).numpy()  # a run that is not finite is lost
        u = np.asarray(driver(next(sample), known), dtype=float)
        if u.shape != (len(x), len(least)):
            raise InputError("controller", f"inputs of shape {u.shape}", f"({len(x)}, {len(least)})")
        driver.remember(u)
        excess = np.maximum(least - u, u - most) / (most - least) * 2
        beyond.append(float(np.max(excess, initial=0.0, where=np.isfinite(excess))))
        return x.new_tensor(u)

    with torch.no_grad():
        seen = simulated(Stepper.at(in_double(problem), p), law, (x0, w), depths=True, guarded=True)
    limits = measured(seen)
    total, lost = (np.repeat(value.numpy(), n // len(x0)) for value in (seen.total, seen.diverged))
    alike = 1.0 if labels is None else n / len(np.unique(labels[:n]))
    fraction, depth = (alike**0.5 * error for error in measurement_errors(seen).values())
    return ClosedLoopReturns(
        total, lost, limits.fraction, limits.depth, problem.risk, (fraction, depth), max(beyond),
        None if labels is None else labels[:n], problem.warm_up,
    )  # fmt: skip


def stretches(problem: CoDesignProblem, runs: int, rng: np.random.Generator) -> Indices | None:
    """What was logged of each of the runs that a generator would draw; None of other scenarios than a log's."""
    drawn = getattr(problem.scenarios, "stretches", None)
    return None if drawn is None else drawn(runs, problem.steps, rng)


def behind_filter(problem: CoDesignProblem, controller: Any, design: Array) -> Any:
    """Controller, behind a filter where the state is measured."""
    if problem.measurement is None:
        return controller
    from ccdtools.co_design.measured import observed  # estimation is loaded where it is asked for

    return observed(problem, controller, design)


def scenarios_of(seed: int) -> np.random.Generator:
    """Generator of the scenarios that `codesign` measures on."""
    return np.random.default_rng(seed).spawn(1)[0]
