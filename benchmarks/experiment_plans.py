"""What `plan_experiment` predicts beside what its experiments tell: ``python benchmarks/experiment_plans.py``.

Per plant and seed: a log of LQR on the real plant, a fit, a plan, the planned experiment on the real plant, and a fit
of both logs. Printed are the half-widths of the intervals after the experiment over those predicted, least, mean and
most; the spread of the values over the seeds over the predicted deviation, which needs no interval of a fit; and how
many of the intervals after the experiment hold the truth.
"""

from __future__ import annotations

import argparse
import time
import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np
from scipy.stats import norm

from ccdtools import (
    CoDesignProblem,
    DesignSpace,
    FixedStart,
    Gaussian,
    Measurement,
    Plant,
    QuadraticObjective,
    deploy,
    discretise,
    saturated_lqr,
)
from ccdtools.co_design.measured import kalman_filter
from ccdtools.controllers.observed import Observed
from ccdtools.twin import fit_plant, plan_experiment

P, STEPS = np.array([2.0]), 60


@dataclass(frozen=True)
class Case:
    """Plant with unknown entries, at their nominal and true values."""

    unknown: dict[str, tuple[float, float, float, float]]  # nominal, true, least and largest value
    rates: Any  # (x, u, w, k, **unknown) → dx/dt
    sizes: tuple[float, float] = (1.0, 1.0)  # of a state and of an input, in the plant's units
    sensor: bool = False  # whether the first state alone is measured

    def plant(self, place: int | None) -> Plant:
        """Plant at nominal (0) or true values (1), or with unknown entries in its design."""
        names = tuple(self.unknown) if place is None else ()
        x, u, w, p = ca.SX.sym("x", 2), ca.SX.sym("u"), ca.SX.sym("w"), ca.SX.sym("p", 1 + len(names))
        entries = dict(zip(names, ca.vertsplit(p)[1:])) if names else {
            name: values[place or 0] for name, values in self.unknown.items()
        }  # fmt: skip
        lower, upper = ([self.unknown[name][at] for name in names] for at in (2, 3))
        box = DesignSpace(["k", *names], [0.5, *lower], [4.0, *upper])
        size, most = self.sizes
        rates = [size * rate for rate in self.rates(x / size, u / most, w, p[0], **entries)]
        return Plant(x, u, w, p, ca.vertcat(*rates), box, dt=0.1)

    def problem(self) -> CoDesignProblem:
        """Problem on the nominal plant."""
        size, most = self.sizes
        sensor = Measurement(np.array([[1.0, 0.0]]), noise=Gaussian([0.02 * size])) if self.sensor else None
        return CoDesignProblem(
            discretise(self.plant(0)), X=(-4 * size, 4 * size), U=(-3 * most, 3 * most), steps=STEPS,
            objective=QuadraticObjective(np.eye(2) / size**2, [[0.1 / most**2]]),
            scenarios=FixedStart([size, 0.0], Gaussian([0.3])), measurement=sensor,
        )  # fmt: skip


def cart(x: ca.SX, u: ca.SX, w: ca.SX, k: ca.SX, mass: Any, drag: Any) -> list[ca.SX]:
    """Cart behind a spring."""
    return [x[1], (u + w - k * x[0] - drag * x[1]) / mass]


def pendulum(x: ca.SX, u: ca.SX, w: ca.SX, k: ca.SX, gravity: Any, motor: Any) -> list[ca.SX]:
    """Pendulum that falls, whose motor pushes with a gain."""
    return [x[1], gravity * ca.sin(x[0]) - 0.1 * k * x[1] + motor * u + w]


def belt(x: ca.SX, u: ca.SX, w: ca.SX, k: ca.SX, belt: Any, motor: Any, drag: Any) -> list[ca.SX]:
    """Cart whose belt and motor act as one."""
    return [x[1], belt * motor * u + w - k * x[0] - drag * x[1]]


MASS, DRAG = (1.0, 1.4, 0.2, 3.0), (0.5, 0.8, 0.1, 3.0)
CASES = {
    "cart": Case({"mass": MASS, "drag": DRAG}, cart),
    "cart, mm and kN": Case({"mass": MASS, "drag": DRAG}, cart, (1e3, 1e-3)),
    "cart, position measured": Case({"mass": MASS, "drag": DRAG}, cart, sensor=True),
    "pendulum, unstable": Case({"gravity": (3.0, 4.0, 1.0, 8.0), "motor": (1.0, 0.8, 0.3, 2.0)}, pendulum),
    "belt and motor, drag": Case({"belt": MASS, "motor": (1.0, 0.8, 0.3, 2.0), "drag": DRAG}, belt),
}


def run(case: Case, seed: int) -> tuple[Any, Any, Any, float]:
    """First fit, plan, fit of both logs, and processor time [s] of the plan."""
    problem, real = case.problem(), case.plant(1)
    law: Any = saturated_lqr(problem, P)
    law = Observed(law, kalman_filter(problem, P)) if case.sensor else law
    x0 = problem.scenarios.x0

    def logged(controller: Any, seed: int) -> Any:
        rng = np.random.default_rng(seed)
        w = Gaussian([0.3]).sample(10, STEPS, rng)
        return deploy(real, controller, P, w, x0=x0, output=problem.measurement, rng=rng)

    log = logged(law, seed)
    fit = fit_plant(problem, log, plant=case.plant(None))
    began = time.process_time()
    plan = plan_experiment(problem, fit, law, P, within=0.03, rng=np.random.default_rng(seed))
    took = time.process_time() - began
    x0 = plan.best.x0
    return fit, plan, fit_plant(problem, [log, logged(plan.best.controller, 1000 + seed)], plant=case.plant(None)), took


def main(arguments: Sequence[str] | None = None) -> None:
    """Print a row per plant."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("cases", nargs="*", default=[*CASES])
    parser.add_argument("--seeds", type=int, default=20)
    given = parser.parse_args(arguments)
    warnings.simplefilter("ignore")
    print("| plant | statuses of fit, plan, fit | interval over predicted | spread over predicted | hold the truth "
          "| s a plan |\n|" + "---|" * 6)  # fmt: skip
    for name in given.cases:
        case, statuses, ratios, errors, held, times = CASES[name], {}, [], [], [], []
        for seed in range(given.seeds):
            fit, plan, after, took = run(case, seed)
            words = "/".join(one.status.name for one in (fit, plan, after))
            statuses[words] = statuses.get(words, 0) + 1
            told = np.isfinite(plan.best.half_widths[: len(case.unknown)])
            truth = np.array([values[1] for values in case.unknown.values()])
            ends = after.intervals()[: len(truth)]
            ratios.append(np.where(told, np.diff(ends, axis=1)[:, 0] / 2 / plan.best.half_widths[: len(truth)], np.nan))
            predicted = plan.best.half_widths[: len(truth)] / norm.ppf(0.975)
            errors.append((after.values[: len(truth)] - truth) / np.where(told, predicted, np.nan))
            held.append(np.where(told, (ends[:, 0] <= truth) & (truth <= ends[:, 1]), np.nan))
            times.append(took)
        told = np.isfinite(ratios).all(axis=0)
        rows = [np.array(column)[:, told] for column in (ratios, errors, held)]
        words = ", ".join(f"{count} {which}" for which, count in statuses.items())
        spread = np.sqrt((rows[1] ** 2).mean(axis=0))
        print(f"| {name} ({', '.join(np.array(list(case.unknown))[told])}) | {words} | {rows[0].min():.2f}, "
              f"{rows[0].mean():.2f}, {rows[0].max():.2f} | {', '.join(f'{one:.2f}' for one in spread)} | "
              f"{int(rows[2].sum())} of {rows[2].size} | {np.median(times):.2f} |", flush=True)  # fmt: skip


if __name__ == "__main__":
    main()
