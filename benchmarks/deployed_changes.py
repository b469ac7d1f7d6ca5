"""Every change of what was in service, on every distribution that it served: by a simulator of its own.

``python benchmarks/deployed_changes.py FOLDER ... [--runs 2000] [--seed 9]`` drives the policies before and after each
redesign, update and roll-back on the real plant, in pairs, and prints a row per change and distribution: those that a
later deployment took back stand there as well, and what came after them. How far X is left at most, after / before, is
the mean over runs in half-widths. Of the package it takes the policies (states to inputs) and the roads that a driver
makes; plants, costs and limits are stated here a second time, or in `gallery.oracle`. The last line counts the changes
that are worse by more than 0.5 % beyond chance, apart from those that leave X less far beyond chance.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np
from gallery.oracle.cost import real_step
from gallery.oracle.statement import Statement
from gallery.reference import STATEMENTS
from scipy import stats
from scipy.linalg import solve_discrete_are

from ccdtools.controllers import LearnedPolicy, load_policy
from ccdtools.studies import RunFolder
from ccdtools.vehicles.roads import GeneratedRoad

TOLERANCE = 0.5  # per cent
LOST = 1e3  # half-widths of X
SUBSTEPS = 10

Array = np.ndarray
Step = Callable[[Array, Array, Array], Array]


def quarter_car() -> Statement:
    """The active suspension: spring and damper linear in the model, with a cubic and a quadratic part in truth."""
    sprung, unsprung, tyre = 325.0, 65.0, 232.5e3

    def matrices(p: Array) -> tuple[Array, Array, Array]:
        k, c = p
        A = [[0, 1, 0, 0], [-tyre / unsprung, -c / unsprung, k / unsprung, c / unsprung], [0, -1, 0, 1],
             [0, c / sprung, -k / sprung, -c / sprung]]  # fmt: skip
        return np.array(A), np.array([[0], [-1 / unsprung], [0], [1 / sprung]]), np.array([[-1.0], [0], [0], [0]])

    def real(x: Array, u: Array, w: Array, p: Array) -> Array:
        A, B, E = matrices(p)
        rate = x[:, 3] - x[:, 1]
        force = 0.01 * p[0] * x[:, 2] ** 3 + 0.01 * p[1] * np.abs(rate) * rate
        return x @ A.T + u @ B.T + w @ E.T + np.outer(force, [0, 1 / unsprung, 0, -1 / sprung])

    return Statement(matrices, Q=[10, 1, 50, 5], R=[1e-6], std=[0.3], x0=[-0.1, -1, -0.1, -0.5], p0=[27692, 1906.5],
                     lower=[1e4, 500], upper=[4e4, 3000], x_max=[0.25, 2.5, 0.5, 2.5], u_max=[1000], dt=0.05,
                     real=real)  # fmt: skip


@dataclass(frozen=True)
class Truth:
    """A real plant: its steps, its cost, its limits and where it is driven."""

    step: Callable[[Array], Step]
    model: Callable[[Array], tuple[Array, Array, Array]]
    Q: Array
    R: Array
    lower: Array
    upper: Array
    u_max: Array
    x0: Array
    drawn: dict[str, Callable[[int, np.random.Generator], tuple[Array, Array]]]


def illustrative(x0: Array) -> Truth:
    """The illustrative example: a bias, a drift, and a gain that varies with the state."""
    A = np.array([[0.8, 0.5], [0.5, 0.6]])

    def step(p: Array) -> Step:
        def following(x: Array, u: Array, w: Array) -> Array:
            a, b = x.T
            drift = np.column_stack([a * np.sin(a) + b * np.cos(b), b * np.sin(b) + a * np.cos(a)])
            gain = np.column_stack([np.sin(a), p[0] * np.cos(b)])
            return x @ A.T + u * [0.5, p[0]] + w + [0.1, -0.2] + 0.1 * drift + 0.5 * gain * u

        return following

    def noise(runs: int, rng: np.random.Generator) -> Array:
        return rng.standard_normal((runs, 100, 2)) * [0.1, 0.2] + rng.uniform(-0.1, 0.1, (runs, 100, 2))

    drawn = {"the study's start": lambda runs, rng: (np.tile(x0, (runs, 1)), noise(runs, rng))}
    return Truth(step, lambda p: (A, np.array([[0.5], [p[0]]]), np.eye(2)), np.ones(2), np.array([0.1]),
                 np.array([-10.0, -5]), np.array([5.0, 2]), np.array([1.0]), x0, drawn)  # fmt: skip


def suspension() -> Truth:
    """The active suspension, on the drives of both drivers and from the study's start."""
    s = quarter_car()
    found = _of_statement(s)
    rest = np.zeros(4)

    def drive(driver: str, start: Array, steps: int) -> Callable[[int, np.random.Generator], tuple[Array, Array]]:
        road = GeneratedRoad(driver)
        return lambda runs, rng: (np.tile(start, (runs, 1)), road.sample(runs, steps, rng))

    found.drawn["the study's start, mild road"] = drive("mild", s.x0, 100)
    found.drawn["mild driver"] = drive("mild", rest, 500)
    found.drawn["aggressive driver"] = drive("aggressive", rest, 500)
    return found


def _of_statement(s: Statement) -> Truth:
    """A plant of the gallery, from the study's start under the noise that its model assumes."""

    def start(runs: int, rng: np.random.Generator) -> tuple[Array, Array]:
        return np.tile(s.x0, (runs, 1)), s.std * rng.standard_normal((runs, s.steps, len(s.std)))

    return Truth(lambda p: real_step(s, p, SUBSTEPS), s.sampled, s.Q, s.R, -s.x_max, s.x_max, s.u_max, s.x0,
                 {"the study's start": start})  # fmt: skip


def truth_of(results: dict) -> Truth:
    """The real plant of a run."""
    if results["study"] == "suspension":
        return suspension()
    if results["study"] == "illustrative":
        return illustrative(np.array(results["x0"]))
    return _of_statement(STATEMENTS[results["study"]]())


def returns(truth: Truth, policy: LearnedPolicy, x0: Array, w: Array) -> tuple[Array, Array, Array]:
    """Returns (n,), runs that are lost (n,), and how far runs leave X at most, in half-widths (n,)."""
    step = truth.step(np.asarray(policy.design, dtype=float))
    half = (truth.upper - truth.lower) / 2
    x, deepest = x0, np.zeros(len(x0))
    total = np.zeros(len(x0))
    lost = np.zeros(len(x0), dtype=bool)
    for k in range(w.shape[1]):
        u = np.clip(policy(x), -truth.u_max, truth.u_max)
        with np.errstate(over="ignore", invalid="ignore"):
            x = np.clip(np.nan_to_num(step(x, u, w[:, k])), -LOST * half, LOST * half)
        total -= x**2 @ truth.Q + u**2 @ truth.R
        lost |= (np.abs(x) >= LOST * half).any(axis=1)
        deepest = np.maximum(deepest, (np.maximum(x - truth.upper, truth.lower - x) / half).max(axis=1))
    return total, lost, deepest


def box(truth: Truth, design: Array, runs: int, rng: np.random.Generator) -> tuple[Array, Array]:
    """States uniform in X that clipped LQR keeps within X on the model, with disturbances."""
    A, B, _ = truth.model(np.asarray(design, dtype=float))
    P = solve_discrete_are(A, B, np.diag(truth.Q), np.diag(truth.R))
    K = np.linalg.solve(np.diag(truth.R) + B.T @ P @ B, B.T @ P @ A)
    _, w = truth.drawn["the study's start"](runs, rng)
    x0 = rng.uniform(truth.lower, truth.upper, (40 * runs, len(truth.lower)))
    inside = np.ones(len(x0), dtype=bool)
    x = x0
    for _ in range(w.shape[1]):
        x = x @ A.T + np.clip(-x @ K.T, -truth.u_max, truth.u_max) @ B.T
        inside &= ((x >= truth.lower) & (x <= truth.upper)).all(axis=1)
    kept = x0[inside][:runs]
    return kept, w[: len(kept)]


def served(folder: Path) -> list[tuple[str, LearnedPolicy]]:
    """Every policy that was ever in service, in the order of time, and by what it came there."""
    run = RunFolder(folder)
    entries = json.loads((folder / "results.json").read_text())["generations"]
    found: list[tuple[str, LearnedPolicy]] = []
    kept = 0  # where the deployment begins that the next one is compared with
    for entry in entries:
        g = entry["generation"]
        of = f"of generation {g}"
        codesign, deployment = run.read_stage(f"codesign-{g}"), run.read_stage(f"deployment-{g}")
        design = codesign.arrays["design"]
        begun = len(found)
        found.append((f"design {of}", LearnedPolicy(codesign.networks["agent"], design)))
        for k, update in enumerate(entry["online_updates"], 1):
            if f"update-{k}" in deployment.networks:  # in service, if only for its trial
                before = found[-1][1]
                found.append((f"update {k} {of}", LearnedPolicy(deployment.networks[f"update-{k}"], design)))
                found += [] if update["accepted"] else [(f"update {k} {of}, taken back", before)]
        delivery = entry["delivery"]
        if delivery["replaces"]:
            kept = begun
        else:
            back = found[kept if delivery["carried"] else begun - 1][1]
            found.append((f"what followed the deployment {of}, rolled back", back))
    if not same(load_policy(folder / "policy.safetensors"), found[-1][1]):
        raise ValueError(f"{folder}: the policy left in service is not the last one found there")
    return found


def same(one: LearnedPolicy, other: LearnedPolicy) -> bool:
    """Whether two policies have the same design and weights."""
    weights = zip(one.agent.state_dict().values(), other.agent.state_dict().values(), strict=True)
    return np.array_equal(one.design, other.design) and all(bool((a == b).all()) for a, b in weights)


def changes(folder: Path) -> Iterator[tuple[str, LearnedPolicy, LearnedPolicy]]:
    """Every change of what was in service, those taken back included: name, after, before."""
    for (_, before), (name, after) in pairwise(served(folder)):
        if not same(after, before):
            yield name, after, before


def rows(folder: Path, runs: int, seed: int) -> Iterator[tuple[str, ...]]:
    """A row per change and distribution: percentages of the return before."""
    results = json.loads((folder / "results.json").read_text())
    truth = truth_of(results)
    for name, after, before in changes(folder):
        drawn = {place: draw(runs, np.random.default_rng(seed)) for place, draw in truth.drawn.items()}
        drawn["the box of starts"] = box(truth, before.design, runs, np.random.default_rng(seed + 1))
        for place, (x0, w) in drawn.items():
            if not len(x0):
                continue
            (own, lost, deep), (other, lost_before, deeper) = (returns(truth, one, x0, w) for one in (after, before))
            kept = ~(lost | lost_before)
            difference, half = in_pairs(100 * (own - other)[kept] / abs(other[kept].mean()))
            back, chance = in_pairs((deep - deeper)[kept])
            nearer = back + chance < 0 and lost.sum() <= lost_before.sum()
            word = "less return, nearer to X" if nearer else "**worse**"
            worse = difference + half < -TOLERANCE or lost.sum() > lost_before.sum()
            yield (folder.name, name, place, f"{difference:+.2f} ± {half:.2f}", f"{lost.sum()} / {lost_before.sum()}",
                   f"{deep[kept].mean():.3f} / {deeper[kept].mean():.3f}", word if worse else "")  # fmt: skip


def in_pairs(differences: Array) -> tuple[float, float]:
    """Mean and half width of its 95 % interval."""
    n = len(differences)
    return differences.mean(), stats.t.ppf(0.975, n - 1) * differences.std(ddof=1) / np.sqrt(n)


def main(arguments: Sequence[str] | None = None) -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folders", nargs="+", type=Path)
    parser.add_argument("--runs", type=int, default=2000)
    parser.add_argument("--seed", type=int, default=9)
    given = parser.parse_args(arguments)
    head = ("run", "change", "distribution", "change of the return [%]", "lost after / before", "outside X", "")
    print(f"| {' | '.join(head)} |\n{'|---' * len(head)}|")
    found = []
    for folder in given.folders:
        for row in rows(folder, given.runs, given.seed):
            print(f"| {' | '.join(row)} |", flush=True)
            found.append(row)
    worse, back = (sum(row[-1] == word for row in found) for word in ("**worse**", "less return, nearer to X"))
    print(f"\n{worse} of {len(found)} are worse by more than {TOLERANCE} %, or lose more runs; {back} are nearer to X")


if __name__ == "__main__":
    main()
