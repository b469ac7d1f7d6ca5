"""Experiments that would tell what a log leaves open."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from scipy.stats import norm

from ccdtools.arrays import Array
from ccdtools.co_design.problem import CoDesignProblem
from ccdtools.controllers.excited import Excited
from ccdtools.controllers.signals import as_controller
from ccdtools.exceptions import InputError
from ccdtools.scenario import Scenario
from ccdtools.trajectory import Trajectory
from ccdtools.twin.budgets import EXCITATIONS
from ccdtools.twin.plant_fit import PlantFit
from ccdtools_ground.door import as_count, as_generator, as_instance, as_positive
from ccdtools_ground.outcome import Outcome


class ExperimentStatus(Outcome):
    """Outcome of a plan; the value is the advice."""

    FOUND = "Found: deploy `best.controller` from `best.x0`, and fit all logs."
    LONGER = "No candidate within the limits makes the intervals short enough in so few runs: make more (runs=)."
    OPEN = (
        "No candidate within the limits tells the parameters apart: measure another output, or state a plant with "
        "fewer of them."
    )


@dataclass(frozen=True, eq=False)
class PlannedExperiment:
    """Experiment, and what it would tell with the logs of a fit.

    Attributes
    ----------
    words : str
    controller : callable
        The law with the excitation on its inputs, within U.
    x0 : (runs, nx) array
    half_widths : (m,) array
        Of the predicted 95 % intervals, in the units of the parameters; infinite where nothing is told.
    open : tuple of dict
        Combinations that would stay open.
    outside : float
        Share of samples outside X.
    cost : float
        Mean return that a run gives up beside the loop as it is.
    """

    words: str
    controller: Any
    x0: Array
    half_widths: Array
    open: tuple[dict[str, float], ...]
    outside: float
    cost: float


@dataclass(frozen=True, eq=False, repr=False)
class ExperimentPlan:
    """Experiments that were compared.

    Attributes
    ----------
    status : ExperimentStatus
    best : PlannedExperiment
        The one that gives up least return of those that suffice, else the one that tells most.
    candidates : tuple of PlannedExperiment
        The first is the loop as it is.
    names : tuple of str
        Parameters that are to be told.
    asked : (k,) array
        Half-widths of their intervals that are short enough.
    places : (k,) array
        Of these parameters among those of the fit.
    """

    status: ExperimentStatus
    best: PlannedExperiment
    candidates: tuple[PlannedExperiment, ...]
    names: tuple[str, ...]
    asked: Array
    places: Array

    @property
    def advice(self) -> str:
        """Advice, with the experiment and the intervals that it promises."""
        told = zip(self.names, self.best.half_widths[self.places], self.asked)
        found = ", ".join(f"{name} ± {half:.2g} (asked {most:.2g})" for name, half, most in told)
        return f"{self.status.advice} {self.best.words}: {found}; it costs {self.best.cost:.3g} a run."

    def __repr__(self) -> str:
        return f"ExperimentPlan({self.status.name}, {self.best.words}, {len(self.candidates)} candidates)"


def plan_experiment(
    problem: CoDesignProblem, fit: PlantFit, controller: Any, design: ArrayLike, *, runs: int = 10,
    within: float = 0.1, rng: np.random.Generator,
) -> ExperimentPlan:  # fmt: skip
    """Cheapest experiment that tells what a fit leaves open.

    Candidates are the loop as it is, and the loop with a binary signal by chance that is held for a sample or a tenth
    of a run, a sum of sines, or steps on every input, of a tenth, three tenths and all of U's half-width, clipped to U;
    where states are seen also starts half-way to X along each state. Each is simulated on the plant of the fit, under
    the problem's disturbance, and its Fisher information is added to that of the logs. Only those count that leave X
    no more often than the loop as it is. Where values are far from the truth, so may be what is predicted: plan again
    after the experiment.

    Parameters
    ----------
    problem : CoDesignProblem
        Of the fit.
    fit : PlantFit
        Its open combinations are to be told; of one that leaves none open all its parameters.
    controller : callable
        As deployed.
    design : (np,) array_like
    runs : int
        Of the experiment, each as long as an episode of the problem.
    within : float
        Half-widths of 95 % intervals that are short enough, as shares of half the ranges of the bounds that were
        stated; of a change of the model as shares of its largest effect.

    Raises
    ------
    InputError
        If an argument is of the wrong kind, all parameters are at bounds, or the loop loses a run on the plant of the
        fit.

    References
    ----------
    Goodwin and Payne, *Dynamic System Identification: Experiment Design and Data Analysis*, 1977, chapter 6.

    Examples
    --------
    >>> plan = plan_experiment(problem, fit, law, design, rng=rng)  # doctest: +SKIP
    >>> print(plan.advice)  # doctest: +SKIP
    """
    as_instance("problem", problem, CoDesignProblem, "a CoDesignProblem")
    as_instance("fit", fit, PlantFit, "a PlantFit, as fit_plant returns")
    p, law = problem.design.check_one(design), as_controller(controller)
    runs, within = as_count("runs", runs), as_positive("within", within)
    as_generator("rng", rng)
    free = fit.unknown.free
    told = zip(free, fit.deviations > 0)  # not of a parameter that a bound holds
    names = tuple(name for name, loose in told if loose and (not fit.open or any(name in one for one in fit.open)))
    if not names:
        raise InputError("fit", "parameters at their bounds alone", "one within its bounds", "State wider bounds.")
    places = np.array([free.index(name) for name in names])
    known = fit.unknown.known(problem, fit.values[: len(free)])
    x0, w = known.scenarios.sample(runs, problem.steps, rng)
    seed = int(rng.integers(2**31))
    kept: list[tuple[str, Any, Array, Trajectory]] = []
    for words, one, start in _candidates(problem, law, p, x0, rng):
        scenario = Scenario(known.model, start, w, output=known.measurement, seed=seed)
        log = scenario.run(one, design=p, limit=problem.limit)
        if log.diverged.any():
            if not kept:
                got = f"a loop that loses {log.diverged.sum()} of {runs} runs on the plant of the fit"
                raise InputError("controller", got, "one that loses none", "Fit a log that tells more of the plant.")
            continue
        kept.append((words, one, start, log))
    tried = []
    for (words, one, start, log), more in zip(kept, fit.with_each(problem, [log for *_, log in kept])):
        half = norm.ppf(0.975) * more.deviations
        inside = problem.state_limits(p).contains(log.states.reshape(-1, log.states.shape[2])).mean()
        loss = float(-log.returns(problem.objective).mean())
        tried.append(PlannedExperiment(words, one, start, half, more.open, 1 - float(inside), loss))
    usual = tried[0]
    allowed = [replace(one, cost=one.cost - usual.cost) for one in tried if one.outside <= usual.outside]
    asked = within * fit.information.units[places]
    missing = [float((one.half_widths[places] / asked).max()) for one in allowed]
    enough = [one for one, share in zip(allowed, missing) if share <= 1 and not one.open]
    nearest = allowed[int(np.argmin(missing))]
    best = min(enough, key=lambda one: one.cost, default=nearest)
    status = ExperimentStatus.FOUND if enough else ExperimentStatus.OPEN if best.open else ExperimentStatus.LONGER
    return ExperimentPlan(status, best, tuple(allowed), names, asked, places)


def _candidates(
    problem: CoDesignProblem, law: Any, p: Array, x0: Array, rng: np.random.Generator
) -> Iterator[tuple[str, Any, Array]]:
    """Words, controllers and starts; the loop as it is first."""
    yield "The loop as it is", law, x0
    lower, upper = (np.broadcast_to(bound, problem.model.nu) for bound in problem.input_bounds_at(p))
    for share in EXCITATIONS:
        for words, signal in _signals(problem.steps, problem.model.nu, rng):
            excited = Excited(law, share * (upper - lower) / 2 * signal, lower, upper)
            yield f"{words}, {share:.0%} of U's half-width", excited, x0
    if problem.measurement is None:
        low, high = problem.state_limits(p).bounding_box()
        far = np.where(high >= -low, high, low)
        for name, start in zip(problem.state_names, np.diag(far / 2)):
            yield f"Starts half-way to X along {name}", law, np.broadcast_to(start, x0.shape)


def _signals(steps: int, nu: int, rng: np.random.Generator) -> Iterator[tuple[str, Array]]:
    """Words and signals (steps, nu) within ±1."""
    for held in sorted({1, max(steps // 10, 1)}):
        signs = rng.choice([-1.0, 1.0], (-(-steps // held), nu)).repeat(held, axis=0)
        yield f"A binary signal by chance, held {held} sample{'s' * (held > 1)}", signs[:steps]
    periods = np.geomspace(1, max(steps / 4, 1), 8)  # a run: from one sine to four samples each
    angle = 2 * np.pi * (np.arange(steps)[:, None, None] * periods / steps + rng.uniform(0, 1, (nu, len(periods))))
    sines = np.sin(angle).sum(axis=2)
    yield "A sum of sines", sines / np.abs(sines).max(axis=0)
    yield "Steps", np.where(np.arange(steps) < steps / 2, 1.0, -1.0)[:, None] * np.ones(nu)
