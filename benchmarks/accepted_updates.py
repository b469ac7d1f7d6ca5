"""What a deployment measures of an accepted update, beside the truth: ``python benchmarks/accepted_updates.py``.

Random unstable and stable plants of two states are driven by a real plant whose input is weaker or stronger, biased and
bent. Each loop updates its policy from the first log and deploys it in a second generation; a redesign would cost too
much. The change that is measured there, with its interval, stands beside that of 2000 fresh pairs of runs, by a
simulator of its own. The last line says how many intervals hold the truth, and how many updates stayed that are worse
than what was deployed before by more than 0.5 % beyond chance.
"""

from __future__ import annotations

import argparse
import json
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import casadi as ca
import numpy as np
from deployed_changes import served
from joblib import Parallel, delayed
from scipy import stats

from ccdtools import DesignSpace, Gaussian, Plant, QuadraticObjective, RealPlant, Study
from ccdtools.controllers.learned import LearnedPolicy
from ccdtools.studies import Generations, RunFolder, configuration
from invariant_sets import Polytope

STEPS = 60
LOGGED = 100  # runs of a deployment, of which every second one meets the same disturbance again
TOLERANCE = 0.5  # per cent
R = 0.1

Array = np.ndarray


@dataclass(frozen=True)
class Case:
    """A random plant x⁺ = A x + B u + w, in truth A x + B (gain u + bias) + bend sin(2 x) + w."""

    seed: int
    A: Array
    B: Array
    gain: float
    bias: float
    bend: Array
    std: Array
    x0: Array

    @classmethod
    def drawn(cls, seed: int) -> Case:
        """The case of a seed."""
        rng = np.random.default_rng([seed, 40])
        radius, angle = rng.uniform(0.7, 1.1), rng.uniform(0.1, 1.2)
        turn = radius * np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]])
        T = np.diag(rng.uniform(0.5, 2, 2))
        return cls(seed, T @ turn @ np.linalg.inv(T), rng.uniform(0.2, 1, 2), rng.uniform(0.6, 1.4),
                   rng.choice([-1, 1]) * rng.uniform(0.2, 0.6), rng.uniform(-0.1, 0.1, 2), rng.uniform(0.05, 0.2, 2),
                   rng.uniform(-1.5, 1.5, 2))  # fmt: skip

    def plant(self, real: bool) -> Plant:
        """For the package."""
        x, u, w, p = ca.SX.sym("x", 2), ca.SX.sym("u"), ca.SX.sym("w", 2), ca.SX.sym("p")
        pushed = self.gain * u + self.bias if real else u
        following = self.A @ x + p * self.B * pushed + w + (self.bend * ca.sin(2 * x) if real else 0)
        return Plant(x, u, w, p, following, DesignSpace(["b"], [0.9], [1.1]), dt=1.0, continuous=False)

    def study(self) -> Study:
        """For the package."""
        noise = Gaussian(self.std)
        return Study(
            name=f"case_{self.seed}", title=f"Case {self.seed}", plant=self.plant(False),
            X=Polytope.from_bounds([-8.0] * 2, [8.0] * 2), U=Polytope.from_bounds([-4.0], [4.0]),
            objective=QuadraticObjective(np.eye(2), [[R]]), disturbance=noise, x0=self.x0, p0=[1.0], steps=STEPS,
            samples=200, redesign_price="1e9 return",
            real=RealPlant(self.plant(True), noise, x0=self.x0, runs=LOGGED, steps=STEPS),
        )  # fmt: skip

    def returns(self, policy: LearnedPolicy, runs: int) -> Array:
        """Returns (runs,) on the real plant, the same disturbances for every policy."""
        rng = np.random.default_rng([self.seed, 2000])
        design = float(policy.design[0])
        x = np.tile(self.x0, (runs, 1))
        total = np.zeros(runs)
        for _ in range(STEPS):
            u = np.clip(policy(x), -4, 4)
            x = (x @ self.A.T + np.outer(self.gain * u[:, 0] + self.bias, design * self.B) + self.bend * np.sin(2 * x)
                 + self.std * rng.standard_normal(x.shape))  # fmt: skip
            x = np.clip(x, -1e3, 1e3)
            total -= (x**2).sum(axis=1) + R * u[:, 0] ** 2
        return total


@dataclass(frozen=True)
class Outcome:
    """The measured and the true change of a loop's updates, in per cent of the return before."""

    seed: int
    measured: float
    interval: tuple[float, float]
    truth: float
    margin: float
    stays: bool

    @property
    def covered(self) -> bool:
        """Whether the interval holds the truth, as far as that is known."""
        low, high = self.interval
        return low - self.margin <= self.truth <= high + self.margin

    @property
    def worse(self) -> bool:
        """Whether what stays is worse than before beyond the tolerance and chance."""
        return self.stays and self.truth + self.margin < -TOLERANCE

    def __str__(self) -> str:
        low, high = self.interval
        marks = ("" if self.covered else "**not held**") + (" **worse**" if self.worse else "")
        return (f"| {self.seed} | {self.measured:+.2f} [{low:+.2f}, {high:+.2f}] | {self.truth:+.2f} ± "
                f"{self.margin:.2f} | {'stays' if self.stays else 'rolled back'} | {marks} |")  # fmt: skip


class NothingAcceptedError(Exception):
    """The first deployment left its policy as it was: what follows would tell nothing."""


def listen(line: str) -> None:
    """Give a loop up whose first deployment says that it accepted no update."""
    if "generation 1 designed" in line and "; 0 of" in line:
        raise NothingAcceptedError


def outcome(seed: int, runs: int) -> Outcome | None:
    """One loop; None where no update was accepted, or no deployment measured one."""
    case = Case.drawn(seed)
    study = case.study()
    config = configuration(study, quick=True, sets="lqr")
    few = replace(config.codesign, iterations=20, evaluate_every=10)
    least = replace(few, iterations=1, evaluate_every=1)  # its price forbids it
    config = replace(config, codesign=few, redesign=least, real_runs=50, model_runs=50, mpc_runs=2, held_out_runs=10)
    with tempfile.TemporaryDirectory() as place:
        path = Path(place) / "run"
        folder = RunFolder.create(path)
        try:
            Generations(study, config, folder, generations=2, seed=seed, echo=listen, progress=False).run()
        except NothingAcceptedError:
            return None
        entries = json.loads((path / "results.json").read_text())["generations"]
        delivery = entries[-1]["delivery"]
        first, *updates = [policy for name, policy in served(path) if name.endswith("of generation 1")]
    if not updates or not delivery["carried"]:
        return None
    after, before = (case.returns(policy, runs) for policy in (updates[-1], first))
    change = 100 * (after - before) / abs(before.mean())
    margin = stats.t.ppf(0.975, runs - 1) * change.std(ddof=1) / np.sqrt(runs)
    scale = 100 / delivery["size"]
    low, high = (scale * end for end in delivery["change"]["ci95"])
    return Outcome(seed, scale * delivery["change"]["mean"], (low, high), change.mean(), margin, delivery["replaces"])


def main(arguments: Sequence[str] | None = None) -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--loops", type=int, default=60, help="tried; those with an accepted update count")
    parser.add_argument("--first", type=int, default=0, help="seed")
    parser.add_argument("--runs", type=int, default=2000)
    parser.add_argument("--jobs", type=int, default=1)
    given = parser.parse_args(arguments)
    seeds = range(given.first, given.first + given.loops)
    print("| seed | measured [%] | truth [%] | | |\n|---|---|---|---|---|")
    found = []
    for one in Parallel(n_jobs=given.jobs, return_as="generator")(delayed(outcome)(s, given.runs) for s in seeds):
        if one is not None:
            found.append(one)
            print(one, flush=True)
    covered, worse = (sum(getattr(one, name) for one in found) for name in ("covered", "worse"))
    print(f"\n{covered} of {len(found)} intervals hold the truth; {worse} stay that are worse by over {TOLERANCE} %")


if __name__ == "__main__":
    main()
