"""What the loop must reach, measured: one function per row of the README's table.

``python benchmarks/loop_targets.py [SEED ...]`` prints the table. The tests assert the same measurements.
"""

from __future__ import annotations

import copy
import os
import sys
import tempfile
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path

import numpy as np
import torch

from ccdtools.co_design.codesign import codesign
from ccdtools.co_design.configuration import CoDesignConfig
from ccdtools.co_design.design_controllers import saturated_lqr
from ccdtools.co_design.environment import EpisodeEnv
from ccdtools.co_design.expert import expert_dataset
from ccdtools.co_design.problem import CoDesignProblem
from ccdtools.controllers.learned import LearnedPolicy
from ccdtools.simulation import simulate
from ccdtools.statistics import paired_difference
from ccdtools.studies import Generations, RunFolder, Study, configuration, load_study
from ccdtools.twin.deployment import deploy
from ccdtools.twin.replay import updated_problem
from ccdtools.twin.twin import DigitalTwin
from learning import PPOConfig, fit_actor_critic, train
from learning.networks import ActorCritic

RUNS = 4000


@dataclass(frozen=True)
class Against:
    """A learned policy beside LQR at the same design, on common random numbers.

    Attributes
    ----------
    design : tuple of float
    learned, lqr : float
        Mean returns.
    difference : float
        Paired mean, learned − LQR, as a fraction of |LQR|.
    low, high : float
        Its 95 % interval.
    best : float
        Best return of LQR over a grid of designs; NaN if not asked for.
    """

    design: tuple[float, ...]
    learned: float
    lqr: float
    difference: float
    low: float
    high: float
    best: float = float("nan")


def against_lqr(problem: CoDesignProblem, agent: ActorCritic, design, *, plant=None, disturbance=None) -> Against:
    """The comparison, on the nominal model or on another plant."""
    rng = np.random.default_rng(987_654_321)
    x0, w = problem.scenarios.sample(RUNS, problem.steps, rng)
    if disturbance is not None:
        w = disturbance.sample(RUNS, problem.steps, rng)
    own, other = (
        simulate(
            plant or problem.model, controller, x0=x0, steps=problem.steps, disturbance=w, design=design,
            limit=problem.limit,
        )
        for controller in (LearnedPolicy(agent, design), saturated_lqr(problem, design))
    )  # fmt: skip
    kept = ~(own.diverged | other.diverged)
    if own.diverged.mean() > other.diverged.mean():
        raise RuntimeError(
            f"the policy diverged in {own.diverged.mean():.2%} of runs, LQR in {other.diverged.mean():.2%}"
        )
    a, b = own.returns(problem.objective)[kept], other.returns(problem.objective)[kept]
    gain = paired_difference(a, b)
    scale = abs(b.mean())
    return Against(
        tuple(np.asarray(design, dtype=float)), a.mean(), b.mean(), gain.mean / scale, gain.ci95[0] / scale,
        gain.ci95[1] / scale,
    )  # fmt: skip


def best_over_designs(problem: CoDesignProblem, points: int = 51) -> float:
    """Best LQR return over a grid of a single design parameter, diverged runs counted at their full cost."""
    x0, w = problem.scenarios.sample(2000, problem.steps, np.random.default_rng(55))
    returns = []
    for design in problem.design.from_unit(np.linspace(0, 1, points)[:, None]):
        run = simulate(
            problem.model, saturated_lqr(problem, design), x0=x0, steps=problem.steps, disturbance=w, design=design,
            limit=problem.limit,
        )  # fmt: skip
        returns.append(run.returns(problem.objective).mean())
    return float(max(returns))


@lru_cache(maxsize=8)
def cloned(name: str, seed: int) -> ActorCritic:
    """Step 0 of a study: expert data and a clone."""
    torch.set_num_threads(1)
    study = load_study(name)
    problem, rng = study.problem(), np.random.default_rng(seed)
    data = expert_dataset(problem, samples=study.samples, rng=rng)
    return fit_actor_critic(
        data.inputs, data.actions, data.values, action_bounds=problem.input_bounds,
        input_bounds=problem.observation_bounds, rng=rng,
    )  # fmt: skip


def clone(name: str, seed: int, x0=None, design=None) -> Against:
    """The clone before any reinforcement learning."""
    study = load_study(name).started(x0=x0)
    return against_lqr(study.problem(), cloned(name, seed), study.p0 if design is None else design)


def first_codesign(name: str, seed: int, x0=None, p0=None) -> Against:
    """The first co-design from a start."""
    study = load_study(name).started(x0=x0, p0=p0)
    problem = study.problem()
    result = codesign(problem, agent=cloned(name, seed), design=study.p0, rng=np.random.default_rng(1000 + seed))
    reached = against_lqr(problem, result.agent, result.design)
    return replace(reached, best=best_over_designs(problem)) if problem.design.dim == 1 else reached


def half_gain(agent: ActorCritic) -> ActorCritic:
    """A copy whose mean action, before the clip, is halved."""
    halved = copy.deepcopy(agent)
    network = halved.mean_network
    assert network.skip is not None
    with torch.no_grad():
        for tensor in (network.head.weight, network.head.bias, network.skip.weight):
            tensor.mul_(0.5)
    return halved


def ppo_alone(seed: int, steps: int = 2_000_000) -> tuple[float, float, float]:
    """PPO without any gradient through the dynamics: returns before, after and of LQR; illustrative, p = 2.45."""
    problem = load_study("illustrative").started(x0=np.array([-2.0, -2.0])).problem()
    design = np.array([2.45])
    agent = half_gain(cloned("illustrative", seed))
    before = against_lqr(problem, agent, design)
    env = EpisodeEnv(problem, torch.tensor(design, dtype=torch.float32), runs=128, rng=np.random.default_rng(seed))
    train(
        env, agent, iterations=steps // (128 * problem.steps), steps=problem.steps,
        config=PPOConfig.warm(final_std=0.03), generator=torch.Generator().manual_seed(seed),
    )  # fmt: skip
    return before.learned, against_lqr(problem, agent, design).learned, before.lqr


def after_one_update(seed: int) -> Against:
    """Illustrative, real plant, p = 2.0, x0 = (−2, −2): deploy the clone, update the model, learn on it, compare."""
    study = load_study("illustrative").started(x0=np.array([-2.0, -2.0]))
    problem, design, rng = study.problem(), np.array([2.0]), np.random.default_rng(2000 + seed)
    agent, real = cloned("illustrative", seed), study.real
    log = deploy(
        real.plant, LearnedPolicy(agent, design), design, real.disturbance.sample(real.runs, real.steps, rng),
        x0=study.x0, limit=problem.limit,
    )  # fmt: skip
    twin = DigitalTwin(study.model).update(log, weight=study.weight, rng=rng)
    result = codesign(
        updated_problem(problem, twin), agent=agent, design=design, rng=rng, config=CoDesignConfig(design_rate=0.0)
    )
    return against_lqr(problem, result.agent, design, plant=real.plant, disturbance=real.disturbance)


def whole_study(name: str, seed: int, *, disturbance=None, folder: str | Path | None = None) -> dict:
    """results.json of a run of two generations."""
    torch.set_num_threads(1)
    study: Study = load_study(name)
    if disturbance is not None:
        study = replace(study, real=replace(study.real, disturbance=disturbance))
    with tempfile.TemporaryDirectory() as temporary:
        run = RunFolder.create(Path(folder or temporary, f"{name}-{seed}"))
        return Generations(study, configuration(study), run, seed=seed, progress=False, echo=lambda line: None).run()


def worst_row(results: dict) -> float:
    """Lowest end of the paired intervals of the learned policy to LQR over all designs, as a fraction of |LQR|.

    A recording whose level drifts has no interval; then the difference itself counts.
    """
    rows = {(r["plant"], r["generation"], r["controller"]): r for r in results["comparison"]}

    def lowest(gain: dict) -> float:
        """The lower end of a gain, or the gain where there is no interval."""
        return gain["mean"] if gain["ci95"][0] is None else gain["ci95"][0]

    return min(
        lowest(row["paired_to_lqr"]) / abs(rows[plant, generation, "LQR"]["mean"])
        for (plant, generation, controller), row in rows.items()
        if controller == "learned"
    )


def recorded_road():
    """The authors' recorded ż₀, or None where it is not at hand."""
    from ccdtools.disturbances.disturbance import Recorded
    from ccdtools.disturbances.recordings import read_disturbance

    default = Path(__file__).resolve().parents[2] / "shared" / "data"
    path = Path(os.environ.get("CCDTOOLS_DATA", default)) / "dz_dt_mild_driver1.csv"
    return Recorded(read_disturbance(path, dt=0.05)) if path.is_file() else None


def main(seeds: list[int]) -> None:
    """Print the README's table."""
    rows: dict[str, list[str]] = {}

    def add(label: str, value: str) -> None:
        rows.setdefault(label, []).append(value)
        print(f"{label}: {value}", flush=True)

    def text(a: Against) -> str:
        return f"{a.learned:.2f} ({100 * a.difference:+.2f} %)"

    for seed in seeds:
        add("clone, suspension start", text(clone("suspension", seed)))
        for x0 in ((0.0, 0.0), (-2.0, -2.0)):
            add(f"clone, illustrative {x0}", text(clone("illustrative", seed, np.array(x0))))
        a = first_codesign("suspension", seed)
        add("co-design, suspension", f"{text(a)} at ({a.design[0]:.0f}, {a.design[1]:.0f})")
        for x0, p0 in (((-3.5, -2.0), 1.0), ((-2.0, -2.0), 1.0), ((-3.0, 0.0), 0.8)):
            a = first_codesign("illustrative", seed, np.array(x0), np.array([p0]))
            add(f"co-design, illustrative {x0}, p0 = {p0}", f"{text(a)} at {a.design[0]:.2f}; best {a.best:.2f}")
        before, after, reference = ppo_alone(seed)
        closed = (after - before) / (reference - before)
        add("PPO alone", f"{before:.2f} → {after:.2f}, LQR {reference:.2f}: {100 * closed:.1f} %")
        a = after_one_update(seed)
        add("real plant after one update", f"{a.learned:.2f}, LQR {a.lqr:.2f}")
        road = recorded_road()
        results = whole_study("suspension", seed, disturbance=road)
        last = results["generations"][-1]
        add(
            "deployment, final generation",
            f"{last['deployed_return']['mean']:.0f}{'' if road else ' (generated road)'}",
        )
        for name, whole in (("suspension", results), ("illustrative", whole_study("illustrative", seed))):
            scores = whole["generations"][-1]["quantiles"]
            rmse = max(np.divide(scores["rmse"], scores["nominal_rmse"]))
            loss = max(np.divide(scores["pinball"], scores["constant_pinball"]))
            coverage = scores["coverage"]
            add(
                f"updated model, {name}",
                f"RMSE × {rmse:.2f}, pinball × {loss:.2f}, {100 * min(coverage):.0f}–{100 * max(coverage):.0f} %",
            )
            add(f"learned − LQR, worst comparison, {name}", f"{100 * worst_row(whole):+.2f} %")
            if name == "suspension":
                add("wall time of the suspension study", f"{whole['wall_seconds']:.0f} s")
    print("\n| | " + " | ".join(f"seed {s}" for s in seeds) + " |\n|---|" + "---|" * len(seeds))
    for label, values in rows.items():
        print(f"| {label} | " + " | ".join(values) + " |")


if __name__ == "__main__":
    main([int(s) for s in sys.argv[1:]] or [0, 1, 2])
