"""Free-running bands of the updated model on drives it has not seen: is 80 % covered per state, with the right spread?

The suspension's real plant on generated roads of both drivers, the illustrative real plant, and some made for this
purpose: skewed innovations, correlated across the states, with a second-order memory; two heavy-tailed signals that
enter four states, now calm, now rough; and two random plants under such signals. Each twin learns one log; others of
the same kind judge it.

The energy score of one step, in standard deviations of the errors, says how good joint draws are: less is better.

    python benchmarks/free_running_bands.py [--cases mild,aggressive,…] [--seeds 0,1] [--roads 4] [--independent]
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from dataclasses import dataclass

import casadi as ca
import numpy as np
import torch
from scipy.signal import lfilter

from ccdtools import DesignSpace, DigitalTwin, Plant, deploy, discretise
from ccdtools.co_design.design_controllers import saturated_lqr
from ccdtools.controllers.controllers import Controller, LinearFeedback
from ccdtools.plants.linear_model import LinearModel
from ccdtools.studies.cases import illustrative, suspension
from ccdtools.twin import free_running_bands
from ccdtools.twin.discrepancy import Discrepancy
from ccdtools.twin.residuals import Residuals, residuals
from ccdtools.vehicles.roads import GeneratedRoad
from mpc import lqr

Array = np.ndarray


@dataclass(frozen=True)
class Case:
    """A model, the plant that it stands for, a controller, and disturbances (runs, steps, nw) from a generator."""

    model: LinearModel
    plant: Plant
    controller: Controller
    design: Array
    x0: Array
    disturbance: Callable[[int, np.random.Generator], Array]
    training_runs: int = 1


def suspension_case(driver: str) -> Case:
    """The suspension at its best known design under saturated LQR, on generated roads of 12.5 minutes."""
    study = suspension.study
    p = np.array([1e4, 3e3])
    road = GeneratedRoad(driver)  # type: ignore[arg-type]
    return Case(study.model, study.real.plant, saturated_lqr(study.problem(), p), p, np.zeros(4),
                lambda runs, rng: road.sample(runs, 15000, rng))  # fmt: skip


def illustrative_case() -> Case:
    """The illustrative example at its best known design: runs of 100 steps."""
    study = illustrative.study
    p = np.array([3.0])
    noise = study.real.disturbance
    return Case(study.model, study.real.plant, saturated_lqr(study.problem(), p), p, study.x0,
                lambda runs, rng: noise.sample(100 * runs, 100, rng), training_runs=2)  # fmt: skip


def memory_case() -> Case:
    """Three masses on a chain; skewed innovations with correlation 0.7, and a disturbance of second order."""
    x, u, w, p = ca.SX.sym("x", 3), ca.SX.sym("u"), ca.SX.sym("w", 3), ca.SX.sym("p")
    A = ca.DM([[0.9, 0.1, 0.0], [0.1, 0.8, 0.1], [0.0, 0.1, 0.95]])
    plant = Plant(x, u, w, p, A @ x + ca.vertcat(0.0, 0.3, p) * u + w, DesignSpace(["b"], [0.5], [2.0]), dt=0.1,
                  continuous=False)  # fmt: skip
    mixing = np.linalg.cholesky(0.3 * np.eye(3) + 0.7)

    def disturbance(runs: int, rng: np.random.Generator) -> Array:
        """Filtered, correlated, centred exponential noise."""
        innovations = (rng.exponential(size=(runs, 8000, 3)) - 1) @ mixing.T * [0.1, 0.02, 5.0]
        return lfilter([1.0], [1.0, -0.9, 0.5], innovations, axis=1)

    return _regulated(plant, np.array([1.0]), disturbance)


def regimes_case() -> Case:
    """Two carts on a nonlinear spring; two signals with Student's t₅ tails, calm or rough, enter four states."""
    x, u, w, p = ca.SX.sym("x", 4), ca.SX.sym("u"), ca.SX.sym("w", 2), ca.SX.sym("p")
    space = DesignSpace(["k"], [1.0], [4.0])

    def plant(cubic: float) -> Plant:
        """The carts, with a share of cubic stiffness."""
        stretch = x[0] - x[2]
        force = p * (stretch + cubic * stretch**3) + 0.3 * (x[1] - x[3])
        change = ca.vertcat(x[1] + 0.1 * w[1], -force + w[0] - x[0], x[3], force + u + 0.5 * w[0] + w[1])
        return Plant(x, u, w, p, change, space, dt=0.1)

    def disturbance(runs: int, rng: np.random.Generator) -> Array:
        """First-order noise whose size changes every ten to thirty seconds."""
        size = np.repeat(rng.choice([0.3, 1.0], (runs, 80)), 100, axis=1)
        return lfilter([1.0], [1.0, -0.6], size[:, :, None] * rng.standard_t(5, (runs, 8000, 2)), axis=1)

    return _regulated(plant(0.0), np.array([2.0]), disturbance, real=plant(0.05))


def random_case(states: int) -> Case:
    """A random linear plant that the real one bends; two heavy-tailed signals, now calm, now rough."""
    rng = np.random.default_rng(97 + states)
    A = rng.standard_normal((states, states))
    A *= 0.95 / np.abs(np.linalg.eigvals(A)).max()
    B, E = rng.standard_normal((states, 1)), rng.standard_normal((states, 2))
    x, u, w, p = ca.SX.sym("x", states), ca.SX.sym("u"), ca.SX.sym("w", 2), ca.SX.sym("p")

    def plant(bend: float) -> Plant:
        """The plant, with a share of sin(x)."""
        after = ca.DM(A) @ x + p * (ca.DM(B) @ u) + ca.DM(E) @ w + bend * ca.sin(x)
        return Plant(x, u, w, p, after, DesignSpace(["b"], [0.5], [2.0]), dt=0.1, continuous=False)

    def disturbance(runs: int, rng: np.random.Generator) -> Array:
        """First-order noise with Student's t₅ tails, whose size changes every hundred samples."""
        size = np.repeat(rng.choice([0.3, 1.0], (runs, 40)), 100, axis=1)
        return lfilter([1.0], [1.0, -0.5], size[:, :, None] * rng.standard_t(5, (runs, 4000, 2)), axis=1)

    return _regulated(plant(0.0), np.array([1.0]), disturbance, real=plant(0.05))


def _regulated(
    plant: Plant, p: Array, disturbance: Callable[[int, np.random.Generator], Array], real: Plant | None = None
) -> Case:
    """A case under LQR with unit weights."""
    model = discretise(plant)
    A, B, _ = model.matrices(p)
    K, _ = lqr(A, B, Q=np.eye(model.nx), R=np.eye(model.nu))
    law = LinearFeedback(K, [-1e6] * model.nu, [1e6] * model.nu)
    return Case(model, real or plant, law, p, np.zeros(model.nx), disturbance)


CASES: dict[str, Callable[[], Case]] = {
    "mild": lambda: suspension_case("mild"), "aggressive": lambda: suspension_case("aggressive"),
    "illustrative": illustrative_case, "memory": memory_case, "regimes": regimes_case,
    "random3": lambda: random_case(3), "random4": lambda: random_case(4),
}  # fmt: skip


def measure(name: str, seed: int, roads: int, independent: bool) -> None:
    """Print coverage and spread of one twin on so many other logs."""
    case = CASES[name]()
    train, test, learning, drawing = np.random.default_rng([seed, len(name)]).spawn(4)
    logs = [
        deploy(case.plant, case.controller, case.design, case.disturbance(runs, rng), x0=case.x0)
        for runs, rng in ((case.training_runs, train), (roads, test))
    ]
    begin = time.perf_counter()
    twin = DigitalTwin(case.model).update(logs[0], weight=np.eye(case.model.nx), rng=learning)
    taken = time.perf_counter() - begin
    assert twin.scores is not None
    assert twin.discrepancy is not None
    if independent:
        positions = twin.discrepancy.network.positions.numpy()
        np.random.default_rng(0).permuted(positions, axis=0, out=positions)
    bands = free_running_bands(twin, logs[1], case.controller, rng=drawing, windows=1500, draws=60)
    sizes = [np.sqrt((residuals(case.model, log).e_next ** 2).mean(axis=(0, 1))) for log in logs]
    score = _energy_score(twin.discrepancy, residuals(case.model, logs[1]))
    print(f"{name}, seed {seed}: learned in {taken:.0f} s, one step {_percent(twin.scores.coverage)}, "
          f"energy score {score:.4f}; errors of its log ÷ those judged on "
          f"{', '.join(f'{ratio:.2f}' for ratio in sizes[0] / sizes[1])}")  # fmt: skip
    for step, covered, joint, spread in zip(bands.steps, bands.coverage, bands.joint, bands.spread):
        sizes = ", ".join(f"{value:.2f}" for value in spread)
        print(f"    {step:3d} steps: {_percent(covered)} (jointly {joint:.0%}); spread {sizes}", flush=True)


def _energy_score(discrepancy: Discrepancy, log: Residuals, *, draws: int = 40) -> float:
    """Energy score of draws of the error after 2000 samples of a log."""
    e, x, u, _, actual = log.columns()
    some = np.random.default_rng(0).permutation(len(x))[:2000]
    given = (torch.tensor(np.repeat(part[some], draws, axis=0), dtype=torch.float32) for part in (e, x, u))
    uniform = torch.tensor(np.random.default_rng(1).random((len(some) * draws, 1)), dtype=torch.float32)
    with torch.no_grad():
        quantiles = discrepancy.network(discrepancy.features(*given, torch.tensor(log.p, dtype=torch.float32)))
        drawn = discrepancy.network.draw(quantiles, uniform).double().numpy()
    drawn = (drawn / actual.std(axis=0)).reshape(len(some), draws, -1)
    off = np.linalg.norm(drawn - (actual[some] / actual.std(axis=0))[:, None], axis=2).mean()
    apart = np.linalg.norm(drawn[:, :, None] - drawn[:, None], axis=3).mean() * draws / (draws - 1)
    return float(off - apart / 2)


def _percent(values: Array | tuple[float, ...]) -> str:
    """Whole per cents, one after the other."""
    return ", ".join(f"{value:.0%}" for value in values)


def main() -> None:
    """All cases and seeds that the command line asks for."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("--cases", default=",".join(CASES))
    parser.add_argument("--seeds", default="0")
    parser.add_argument("--roads", type=int, default=4, help="logs that judge each twin")
    parser.add_argument("--independent", action="store_true", help="draw each state alone")
    options = parser.parse_args()
    for name in options.cases.split(","):
        for seed in options.seeds.split(","):
            measure(name, int(seed), options.roads, options.independent)


if __name__ == "__main__":
    main()
