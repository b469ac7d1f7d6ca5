"""Places where laws are measured, and what LQR does there."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, TypeAlias

import numpy as np

from ccdtools.arrays import Array
from ccdtools.co_design.closed_loop import closed_loop_returns
from ccdtools.co_design.design_controllers import saturated_lqr
from ccdtools.co_design.problem import CoDesignProblem
from ccdtools.controllers.controllers import Controller
from ccdtools.plants.design_space import DesignSpace
from ccdtools.scenario import Scenario
from ccdtools.studies.reproduce.budget import Budget
from ccdtools.studies.reproduce.paper_figures import BOX, FIRST, SECOND, SIGNALS, STARTS
from ccdtools.studies.stage_storage import Stage
from ccdtools.studies.study import Study
from ccdtools.trajectory import Trajectory
from learning.quantile import pinball

Seen: TypeAlias = Callable[[Controller, Array], dict[str, Array]]  # values of runs by the name of a row's first part
COMMON = 20_240_917  # seed of what every law meets
SIGMA_WINDOW = slice(50, 100)  # samples that count as steady state: the second half of the paper's 100
STRETCHES = 50  # stretches of the road that are driven from each of the paper's three starts
DRIVE = 3000  # samples of the road on which comfort and effort are measured
LOST = 0.01  # A design of a grid that loses a larger part of its runs is no optimum.
LAGS = 50  # samples of the road that its next one is predicted from
LEVELS = (0.1, 0.5, 0.9)  # quantiles of the paper


def on_model(name: str, problem: CoDesignProblem, runs: int) -> Seen:
    """Returns on the scenarios of a problem, the same ones for every law."""

    def seen(controller: Controller, design: Array) -> dict[str, Array]:
        """Returns (n,), NaN of a run that is lost."""
        found = closed_loop_returns(problem, controller, design, np.random.default_rng(COMMON), runs=runs)
        return {name: np.where(found.lost, np.nan, found.values)}

    return seen


def fixed_places(study: Study, budget: Budget) -> dict[str, Seen]:
    """Places that do not depend on what was learned."""
    problem = study.problem()
    places = {"nominal": on_model("nominal", problem, budget.runs)}
    if study.name != "suspension":
        return places
    rng = np.random.default_rng(COMMON)
    steps = study.steps
    starts = rng.uniform(*BOX, (200, study.plant.nx))
    road = study.real.disturbance.sample(len(starts), steps, rng)
    alone = study.real.disturbance.sample(1, DRIVE, rng)
    named = np.tile(road[:STRETCHES], (len(STARTS), 1, 1))

    def driven(x0: Any, w: Array, measure: Callable[[Trajectory], dict[str, Array]]) -> Seen:
        scenario = Scenario(study.real.plant, x0, w)
        return lambda law, design: measure(scenario.run(law, design=design, limit=problem.limit))

    def returned(name: str) -> Callable[[Trajectory], dict[str, Array]]:
        return lambda run: {name: np.where(run.diverged, np.nan, run.returns(study.objective))}

    def ridden(run: Trajectory) -> dict[str, Array]:
        assert study.metrics is not None
        comfort = study.metrics(run)["weighted body acceleration [m/s²]"]
        return {"comfort": np.array([comfort]), "effort": np.sqrt(np.mean(run.inputs**2, axis=(1, 2)))}

    return places | {
        "quiet": driven(starts, 0 * road, returned("starts-quiet")),
        "road": driven(starts, road, returned("starts-road")),
        "sigma": driven(np.repeat(STARTS, STRETCHES, axis=0), named, steady),
        "drive": driven(study.real.x0, alone, ridden),
    }


def steady(run: Trajectory) -> dict[str, Array]:
    """Standard deviations of x₃, x₄ and u in steady state, by start and stretch."""
    signals = np.concatenate([run.states[:, 1:, 2:4], run.inputs], axis=2)[:, SIGMA_WINDOW]
    sigma = signals.std(axis=1).reshape(len(STARTS), STRETCHES, len(SIGNALS))
    return {f"sigma-{i + 1}-{name}": sigma[i, :, k] for i in range(len(sigma)) for k, name in enumerate(SIGNALS)}


def paper_designs(study: Study) -> dict[str, Array]:
    """Designs of the paper, before and after each of its optimisations."""
    first, second = (np.array(found[study.name]) for found in (FIRST, SECOND))
    return {"before": np.asarray(study.p0), "after": first, "1": first, "2": second}


def grid(space: DesignSpace, points: int) -> Array:
    """Designs of a grid of the box, `points` on each axis."""
    axes = np.meshgrid(*[np.linspace(0, 1, points)] * space.dim, indexing="ij")
    return np.asarray(space.from_unit(np.stack(axes, axis=-1).reshape(-1, space.dim)))


def lqr_beside(problem: CoDesignProblem, seen: Seen, designs: Mapping[str, Array], points: int) -> Stage:
    """Returns of saturated LQR at the paper's designs and the best of a grid."""
    arrays = {}
    for tag, design in designs.items():
        for name, values in seen(saturated_lqr(problem, design), design).items():
            arrays[f"{name}-{tag}.lqr"] = values
    every = grid(problem.design, points)
    found = [seen(saturated_lqr(problem, design), design) for design in every]
    texts = {}
    for name in found[0]:
        values = np.array([one[name] for one in found])
        best = best_of(values, lower=values[np.isfinite(values)].min() >= 0)
        arrays[f"{name}.optimum"] = values[best]
        texts[f"{name}.optimum"] = f"LQR at {problem.design.describe(every[best])}"
    return Stage({"designs": texts}, arrays)


def best_of(values: Array, *, lower: bool) -> int:
    """Row of values (designs, runs) with the best mean and few losses."""
    kept = np.isfinite(values)
    means = np.where(kept, values, 0.0).sum(axis=1) / np.maximum(kept.sum(axis=1), 1)
    score = np.where(kept.mean(axis=1) >= 1 - LOST, -means if lower else means, -np.inf)
    return int(np.argmax(score))


def floors(study: Study, steps: int) -> dict[str, Array]:
    """Least root mean square and pinball loss of a one-step error, over all states.

    Of the illustrative example those of the noise that enters its real plant. Of the suspension, where no floor is
    known, what linear prediction of the road from its last samples leaves at the paper's first design.
    """
    rng = np.random.default_rng(COMMON)
    if study.name == "illustrative":
        noise = study.real.disturbance.sample(500, 1000, rng).reshape(-1, 2)
    else:
        road = study.real.disturbance.sample(1, steps, rng)[0, :, 0]
        past = np.lib.stride_tricks.sliding_window_view(road[:-1], LAGS)
        left = road[LAGS:] - past @ np.linalg.lstsq(past, road[LAGS:], rcond=None)[0]
        noise = left[:, None] * study.model.matrices(np.array(FIRST[study.name]))[2][:, 0]
    noise = noise - noise.mean(axis=0)
    quantiles = np.broadcast_to(np.quantile(noise, LEVELS, axis=0), (len(noise), len(LEVELS), noise.shape[1]))
    rmse = np.sqrt(np.mean(noise**2))
    return {"rmse.optimum": np.array([rmse]), "pinball.optimum": np.array([pinball(noise, quantiles, LEVELS).mean()])}
