"""Plants fitted to outputs, and generations of LQG on sensors.

    python benchmarks/sensor_generations.py fits [--seeds 20] [--states]
    python benchmarks/sensor_generations.py generations [--seeds 10]

Fits: a log of LQG on a real plant that differs, without its states, or with `--states` of LQR whose inputs have white
noise of a tenth of their range besides; intervals beside the truth. The first four rows are
an oscillator whose position is measured, as in the table of smoothed states; the change is in the nominal model. Of the
other plants of the library a servo (mass, friction and gain unknown) and a pole on a cart held upright (nonlinear: gain
and friction) are stated with what is unknown, and the change of two tanks (nonlinear) is fitted where w enters.

Generations: two of nested LQG; the truth is LQG designed for the real plant. Gains are on fresh common runs of the real
plant, and again by a simulator, regulator and filter of this script, which take designs and fitted parameters alone.
"""

from __future__ import annotations

import argparse
import time
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import casadi as ca
import numpy as np
from scipy.linalg import expm, solve_discrete_are

from ccdtools import (
    CoDesignProblem,
    DesignSpace,
    FixedStart,
    Gaussian,
    Measurement,
    Nested,
    Plant,
    QuadraticObjective,
    RandomStarts,
    RealPlant,
    Scenario,
    codesign,
    deploy,
    discretise,
    saturated_lqr,
)
from ccdtools.co_design import kalman_filter
from ccdtools.controllers import Observed
from ccdtools.plants.library import dc_servo, mass_chain, pendulum_on_cart, two_tanks
from ccdtools.studies import fitted_generations
from ccdtools.twin import fit_plant


@dataclass(frozen=True)
class Case:
    """A problem with sensors, a real plant, and what is unknown."""

    name: str
    problem: CoDesignProblem
    real: Plant
    truth: np.ndarray  # of what is fitted
    design: list[float]
    wide: Plant | None = None
    spread: tuple[float, ...] = (0.3,)  # of w
    start: tuple[float, ...] = ()  # of every run, where there is one
    matrices: Callable[..., Any] | None = None  # by hand: design and unknown values → continuous A, B, E
    nominal: tuple[float, ...] = ()  # the unknown values of the model


def unknown(plant: Plant, names: Sequence[str], lower: Any, upper: Any, dynamics: Callable[..., Any]) -> Plant:
    """Plant with unknown entries q in its design."""
    q = ca.SX.sym("q", len(names))
    space = plant.design
    box = DesignSpace((*space.names, *names), np.r_[space.lower, lower], np.r_[space.upper, upper])
    return replace(plant, p=ca.vertcat(plant.p, q), dynamics=dynamics(plant, q), design=box)


def known(wide: Plant, plant: Plant, values: Sequence[float]) -> Plant:
    """Plant with these entries known."""
    count = len(values)
    p, q = wide.p[:-count], wide.p[-count:]
    dynamics = ca.substitute(wide.dynamics, q, ca.DM(values))
    return replace(wide, p=p, dynamics=dynamics, design=plant.design)


def spring(gain: float = 1.0, push: float = 0.0) -> Plant:
    """Oscillator whose stiffness is designed."""
    x, u, w, k = ca.SX.sym("x", 2), ca.SX.sym("u"), ca.SX.sym("w"), ca.SX.sym("k")
    box = DesignSpace(["k"], [0.5], [4.0], ["N/m"])
    return Plant(x, u, w, k, ca.vertcat(x[1], -k * x[0] - 0.3 * x[1] + gain * u + w + push), box, dt=0.33)


def oscillator(noise: float, gain: float, push: float = 0.0) -> Case:
    """Weak or strong actuator, and a push."""
    problem = CoDesignProblem(
        discretise(spring()), X=(-4, 4), U=(-3, 3), steps=100, limit_tolerance="off",
        objective=QuadraticObjective(np.eye(2), [[0.1]], design_cost=lambda p: 2 * p[0]),
        scenarios=FixedStart([1.0, 0.0], Gaussian([0.3])), measurement=Measurement([[1.0, 0.0]], noise=[noise]),
    )  # fmt: skip

    def matrices(p: Any, value: Any) -> Any:
        """A, B, E."""
        A = np.array([[0, 1], [-p[0] + value[0], -0.3 + value[1]]])
        return A, np.array([[0], [1 + value[2]]]), np.array([[0], [1.0]])

    name = f"oscillator, noise {noise:g}, actuator {gain:.0%}" + " and a push" * (push > 0)
    return Case(name, problem, spring(gain, push), np.array([0, 0, gain - 1, push]), [2.0], start=(1.0, 0.0),
                matrices=matrices, nominal=(0.0,) * 4)  # fmt: skip


def servo(truth: Sequence[float] = (1.3, 1e-3, 0.7)) -> Case:
    """Servo whose angle is measured; inertia, friction and gain beside the model's."""
    plant = dc_servo()

    def dynamics(own: Plant, q: ca.SX) -> ca.SX:
        """Changed rates."""
        p = own.p
        inertia = 1e-3 + p[1] + 3.2284e-6 * p[0] ** 2
        torque = inertia * ca.substitute(own.dynamics[1], own.u, q[2] * own.u) - q[1] * own.x[1]
        return ca.vertcat(own.x[1], torque / (q[0] * inertia))

    wide = unknown(plant, ("inertia", "friction", "gain"), [0.4, -0.003, 0.3], [3.0, 0.01, 2.0], dynamics)
    start = (0.5, 0.0)
    problem = CoDesignProblem(
        discretise(plant), X=([-3, -30], [3, 30]), U=(-24, 24), steps=100, limit_tolerance="off",
        objective=QuadraticObjective(np.diag([1.0, 1e-3]), [[1e-3]], design_cost=lambda p: 0.02 * p[0] + 400 * p[1]),
        scenarios=FixedStart(start, Gaussian([0.05])), measurement=Measurement([[1.0, 0.0]], noise=[0.005]),
    )  # fmt: skip

    def matrices(p: Any, value: Any) -> Any:
        """A, B, E by the motor's data sheet."""
        inertia = 1e-3 + p[1] + 3.2284e-6 * p[0] ** 2
        drag = 1e-3 + 3.5077e-6 * p[0] ** 2 + (0.0274 * p[0]) ** 2 / 4.0 + value[1]
        push = value[2] * 0.0274 * p[0] / 4.0
        own = value[0] * inertia
        return np.array([[0, 1], [0, -drag / own]]), np.array([[0], [push / own]]), np.array([[0], [1 / own]])

    return Case("servo", problem, known(wide, plant, truth), np.array(truth), [20.0, 1e-3], wide, (0.05,), start,
                matrices, (1.0, 0.0, 1.0))  # fmt: skip


def load(heavier: float = 2.0) -> Case:
    """Servo of which the inertia alone is unknown."""
    case = servo((heavier, 0.0, 1.0))
    assert case.wide is not None
    by_all: Any = case.matrices
    wide = case.wide
    dynamics = ca.substitute(wide.dynamics, wide.p[3:], ca.DM([0.0, 1.0]))
    box = DesignSpace(wide.design.names[:3], wide.design.lower[:3], wide.design.upper[:3])
    alone = replace(wide, p=wide.p[:3], dynamics=dynamics, design=box)
    return replace(
        case, truth=np.array([heavier]), wide=alone, nominal=(1.0,),
        matrices=lambda p, value: by_all(p, (value[0], 0.0, 1.0)),
    )  # fmt: skip


def chain(truth: float = 0.3) -> Case:
    """Two masses between walls whose positions are measured; the dampers' part that is left."""
    plant = mass_chain(2)
    wide = unknown(
        plant, ("damping",), [0.02], [3.0], lambda own, q: ca.substitute(own.dynamics, own.p[1], q[0] * own.p[1])
    )
    start = (0.3, 0.0, 0.0, 0.0)
    problem = CoDesignProblem(
        discretise(plant), X=(-4, 4), U=(-10, 10), steps=100, limit_tolerance="off",
        objective=QuadraticObjective(
            np.diag([1.0, 1.0, 0.1, 0.1]), [[0.3]], design_cost=lambda p: 0.02 * p[0] + 1.0 * p[1]
        ),
        scenarios=FixedStart(start, Gaussian([1.0])), measurement=Measurement(np.eye(4)[:2], noise=[0.05, 0.05]),
    )  # fmt: skip

    def matrices(p: Any, value: Any) -> Any:
        """A, B, E by Newton's law."""
        link = np.array([[-2.0, 1.0], [1.0, -2.0]])
        A = np.block([[np.zeros((2, 2)), np.eye(2)], [p[0] * link, value[0] * p[1] * link]])
        return A, np.eye(4)[:, 2:3], np.eye(4)[:, 3:4]

    return Case("chain of two masses", problem, known(wide, plant, [truth]), np.array([truth]), [60.0, 1.0], wide,
                (1.0,), start, matrices, (1.0,))  # fmt: skip


def pole() -> Case:
    """Pole on a cart held upright: position and angle are measured."""
    plant = pendulum_on_cart()
    wide = unknown(
        plant, ("gain", "friction"), [0.4, -0.5], [1.8, 2.0],
        lambda own, q: ca.substitute(own.dynamics, own.u, q[0] * own.u - q[1] * own.x[1]),
    )  # fmt: skip
    X, truth = ([-2, -4, -0.6, -4], [2, 4, 0.6, 4]), [0.75, 1.0]
    problem = CoDesignProblem(
        discretise(plant, X=X, U=(-12, 12), accuracy=1e-4), X=X, U=(-12, 12), steps=100, limit_tolerance="off",
        objective=QuadraticObjective(np.diag([1.0, 0.1, 5.0, 0.1]), [[0.05]]),
        scenarios=RandomStarts(Gaussian([0.2, 0.1, 0.1, 0.1]), Gaussian([0.3])),
        measurement=Measurement(np.eye(4)[::2], noise=[0.005, 0.005]),
    )  # fmt: skip
    return Case("pole on a cart", problem, known(wide, plant, truth), np.array(truth), [0.6, 0.5], wide)


def tanks() -> Case:
    """Two tanks with a pump of 70 %; both levels are measured."""
    plant = two_tanks(dt=4.0)
    problem = CoDesignProblem(
        discretise(plant, X=(-5, 5), U=(-2, 2), accuracy=1e-3), X=(-5, 5), U=(-2, 2), steps=100,
        objective=QuadraticObjective(np.eye(2), [[0.1]]), limit_tolerance="off",
        scenarios=RandomStarts(Gaussian([1.0, 1.0]), Gaussian([1.0, 1.0])),
        measurement=Measurement(np.eye(2), noise=[0.1, 0.1]),
    )  # fmt: skip
    real = replace(plant, dynamics=ca.substitute(plant.dynamics, plant.u, 0.7 * plant.u))
    truth = np.array([0, 0, 0, 0, -0.3 * 3.33, 0, 0, 0])
    return Case("two tanks", problem, real, truth, [28.0, 28.0, 0.071], spread=(1.0, 1.0))


OSCILLATORS = ((0.01, 0.5), (0.01, 1.5, 0.2), (0.1, 0.5), (0.1, 1.5, 0.2))


def fits(seeds: int, noise: str, states: bool) -> None:
    """Print a row per plant."""
    print("| plant | unknown | truth | mean of fits | intervals that hold it | signs | statuses | s |")
    print("|---|---|---|---|---|---|---|---|")
    cases = (*(oscillator(*of) for of in OSCILLATORS), replace(servo(), name="servo, noise known"), pole(), tanks())
    if states:  # of the servo's three they tell ratios alone
        cases = (*(oscillator(*of) for of in OSCILLATORS[2:]), load(), chain(), pole(), tanks())
    for case in cases:  # with its noise the servo's three are open
        problem, p = case.problem, np.array(case.design)
        if states:
            problem = replace(problem, measurement=None)
        found, began = [], time.process_time()
        runs = 60 if case.matrices is not None and case.wide is None else 30
        for seed in range(seeds):
            rng = np.random.default_rng(seed)
            x0, w = problem.scenarios.sample(runs, 100, rng)
            law = dithered(problem, p, rng) if states else lqg(problem, p)
            log = deploy(case.real, law, p, w, x0=x0, output=problem.measurement, rng=rng)
            found.append(fit_plant(problem, log, plant=case.wide, noise="known" if "known" in case.name else noise))
        took = (time.process_time() - began) / seeds
        statuses = sorted({one.status.name for one in found})
        for i, name in enumerate(found[0].names[: len(case.truth)]):
            held = sum(one.intervals()[i, 0] <= case.truth[i] <= one.intervals()[i, 1] for one in found)
            moved = case.truth[i] - (case.nominal[i] if case.nominal else 1.0 if case.wide is not None else 0.0)
            away = case.truth[i] - moved
            right = sum((one.values[i] - away) * moved > 0 for one in found)
            signs = f"{right} of {seeds}" if moved else ""
            mean = np.mean([one.values[i] for one in found])
            print(f"| {case.name} | {name} | {case.truth[i]:.3g} | {mean:.3g} | {held} of {seeds} | {signs} | "
                  f"{', '.join(statuses)} | {took:.1f} |", flush=True)  # fmt: skip
    named = pairs_named(seeds, noise, states)
    print(f"two gains in a row, of which the log tells the product: named, and nothing else, {named} of {seeds}")


def lqg(problem: CoDesignProblem, p: np.ndarray) -> Observed:
    """LQR of the Kalman filter's estimate."""
    return Observed(saturated_lqr(problem, p), kalman_filter(problem, p))


def dithered(problem: CoDesignProblem, p: np.ndarray, rng: np.random.Generator) -> Callable[[np.ndarray], np.ndarray]:
    """LQR with white noise on its inputs."""
    law, (low, high) = saturated_lqr(problem, p), problem.input_bounds
    return lambda x: np.clip(law(x) + (high - low) / 10 * rng.standard_normal((len(x), len(low))), low, high)


def pairs_named(seeds: int, noise: str, states: bool) -> int:
    """Logs of which a pair of gains that cannot be told apart is named."""
    case = oscillator(0.1, 0.5)
    if states:
        case = replace(case, problem=replace(case.problem, measurement=None))
    wide = unknown(
        spring(), ("one", "other"), [0.2, 0.2], [3.0, 3.0],
        lambda own, q: ca.substitute(own.dynamics, own.u, q[0] * q[1] * own.u),
    )  # fmt: skip
    p, named = np.array(case.design), 0
    for seed in range(seeds):
        rng = np.random.default_rng(seed)
        x0, w = case.problem.scenarios.sample(60, 100, rng)
        law = dithered(case.problem, p, rng) if states else lqg(case.problem, p)
        log = deploy(case.real, law, p, w, x0=x0, output=case.problem.measurement, rng=rng)
        fit = fit_plant(case.problem, log, plant=wide, noise=noise)
        named += fit.status.name == "OPEN" and [set(one) for one in fit.open] == [{"one", "other"}]
    return named


def sampled(case: Case, p: Any, value: Any) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A, B, E of a held sample, by SciPy."""
    assert case.matrices is not None
    A, B, E = case.matrices(p, value)
    nx, dt = len(A), case.problem.model.dt
    whole = expm(dt * np.block([[A, B, E], [np.zeros((B.shape[1] + E.shape[1], nx + B.shape[1] + E.shape[1]))]]))
    return whole[:nx, :nx], whole[:nx, nx : nx + B.shape[1]], whole[:nx, nx + B.shape[1] :]


def by_hand(case: Case, p: Any, believed: Any, rng: np.random.Generator, runs: int = 4000) -> np.ndarray:
    """Returns of LQG that believes in these parameters, on the real plant, by this script's own loop."""
    problem, C = case.problem, np.asarray(case.problem.measurement.output)
    A, B, E = sampled(case, p, case.truth)
    Am, Bm, Em = sampled(case, p, believed)
    Q, R = np.asarray(problem.objective.Q), np.asarray(problem.objective.R)
    S = solve_discrete_are(Am, Bm, Q, R)
    K = np.linalg.solve(R + Bm.T @ S @ Bm, Bm.T @ S @ Am)
    V, W = np.diag(np.square(problem.measurement.noise.std)), Em @ np.diag(np.square(case.spread)) @ Em.T
    low, high = problem.input_bounds
    x = np.tile(case.start, (runs, 1))
    guess, P, total = x.copy(), np.zeros((x.shape[1],) * 2), np.zeros(runs)
    for _ in range(problem.steps):
        y = x @ C.T + rng.standard_normal((runs, len(C))) * np.sqrt(np.diag(V))
        M = P @ C.T @ np.linalg.inv(C @ P @ C.T + V)
        guess, P = guess + (y - guess @ C.T) @ M.T, (np.eye(len(P)) - M @ C) @ P
        u = np.clip(-guess @ K.T, low, high)
        w = rng.standard_normal((runs, E.shape[1])) * case.spread
        x = x @ A.T + u @ B.T + w @ E.T
        guess, P = guess @ Am.T + u @ Bm.T, Am @ P @ Am.T + W
        total -= np.einsum("ni,ij,nj->n", x, Q, x) + np.einsum("ni,ij,nj->n", u, R, u)
    return total - float(problem.objective.cost_of_design(np.asarray(p), problem.steps))


def generations(seeds: int, noise: str) -> None:
    """Print a row per plant and seed, and their means."""
    print("| plant | seed | design | redesign | predicted | measured | by hand | truth's worth | share |")
    print("|---|---|---|---|---|---|---|---|---|")
    outside = replace(load(), name="servo, library's real one", real=dc_servo(real=True), matrices=None)
    for case in (oscillator(0.1, 0.5), load(), chain(), outside):
        problem = case.problem
        real = RealPlant(case.real, Gaussian(case.spread), case.start, 60, 100)
        shares = []
        for seed in range(seeds):
            first, second = fitted_generations(
                problem, real, method=Nested("lqg"), plant=case.wide, noise=noise, rng=np.random.default_rng(seed)
            )
            best = second
            if case.matrices is not None:
                true = replace(problem, model=discretise(case.real))
                best = codesign(true, method=Nested("lqg"), rng=np.random.default_rng(seed))
            rng = np.random.default_rng(1000 + seed)
            w = Gaussian(case.spread).sample(2000, 100, rng)
            runs = Scenario(case.real, case.start, w, output=problem.measurement, seed=seed)
            value = [runs.run(one.controller, design=one.design).returns(problem.objective)
                     for one in (first, second, best)]  # fmt: skip
            size = abs(value[0].mean())
            worth = value[2] - value[0]
            share = (value[1] - value[0]).mean() / worth.mean()
            shares.append(share)
            told = [f"{100 * one.mean / size:+.2f} [{100 * one.ci95[0] / size:.2f}, {100 * one.ci95[1] / size:.2f}]"
                    if one is not None else "none" for one in (second.predicted, second.gain)]  # fmt: skip
            if case.matrices is None:
                told += ["", "", ""]
            else:
                fitted = second.fit.values if second.fit is not None else case.nominal
                own = [by_hand(case, p, q, np.random.default_rng(seed))
                       for p, q in ((first.design, case.nominal), (second.design, fitted))]  # fmt: skip
                told += [around(own[1] - own[0], size), around(worth, size), f"{share:.1%}"]
            designs = [np.round(one.design, 4) for one in (first, second)]
            print("|", " | ".join(map(str, (case.name, seed, *designs, *told))), "|", flush=True)
        if case.matrices is not None:
            print(f"| {case.name} | all | | | | | | | {np.mean(shares):.1%}, least {np.min(shares):.1%} |", flush=True)


def around(values: np.ndarray, size: float) -> str:
    """Mean and half an interval, in per cent of a size."""
    return f"{100 * values.mean() / size:+.2f} ± {196 * values.std() / len(values) ** 0.5 / size:.2f}"


def main() -> None:
    """Print the table that is asked for."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("table", choices=("fits", "generations"))
    parser.add_argument("--seeds", type=int)
    parser.add_argument("--noise", choices=("fitted", "known"), default="fitted")
    parser.add_argument("--states", action="store_true")
    asked = parser.parse_args()
    warnings.simplefilter("ignore")
    if asked.table == "fits":
        fits(asked.seeds or 20, asked.noise, asked.states)
    else:
        generations(asked.seeds or 10, asked.noise)


if __name__ == "__main__":
    main()
