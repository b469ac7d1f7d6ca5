"""Decisions by experiment beside the truth: switchback trials, drifts and redesigns in money.

    python benchmarks/trials.py [switchback] [drift] [redesign] [--trials 1000] [--processes 2]

Switchback: on a real plant that is not the model, the law in service and a candidate whose effect is 0, ± 0.5 or ± 2 %
of its return, as the Lyapunov equation of the real loop says, take turns over one deployment; predicted by the nominal
model, and by the plant that a log before it tells.
Drift: streams of residuals of one kind, looked at for as long as they calibrate, without a change and with one.
Redesign: products whose gain is drawn from a prior; what is decided beside the decision of Bayes in closed form.
"""

from __future__ import annotations

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")

import argparse
from itertools import product

import casadi as ca
import numpy as np
from joblib import Parallel, delayed
from scipy import stats
from scipy.linalg import solve_discrete_lyapunov
from scipy.optimize import brentq

from ccdtools import CoDesignProblem, DesignSpace, FixedStart, Gaussian, Plant, QuadraticObjective, deploy, discretise
from ccdtools.controllers import LinearFeedback
from ccdtools.evidence.drift import detect_drift
from ccdtools.evidence.switchback import TrialStatus
from ccdtools.studies.redesign_cost import RedesignAction, RedesignCost, decide_redesign
from ccdtools.twin import TrialConfig, identified_plant, switchback_on
from mpc import lqr

EFFECTS = (0.0, 0.005, -0.005, 0.02, -0.02)
WRONG = {"near": 1.05, "near, bad model": 1.2, "beyond": 1.05}  # so strongly does the real input act beside the model's
KINDS = tuple(WRONG)
ASIDE = 0.03  # a near one has another direction, so far away, in parts of the gain
STEPS = 10_000  # of a deployment
LOGGED = (0, 2000)  # steps logged before a trial, which its prediction rests on; of none: the nominal model
WORSE = 1.04  # the law in service costs so many times as much as the best one along its gain


# ── switchback ──


class Loop:
    """A linear plant, its wrong model, and laws of stated effect."""

    def __init__(self, name: str, A, B, E, std, kind: str) -> None:
        self.name, self.kind = name, kind
        self.A, self.B = np.array(A), WRONG[kind] * np.array(B)
        self.noise = np.array(E) @ np.diag(std) ** 2 @ np.array(E).T
        self.Q, self.R, self.std = np.eye(len(A)), np.eye(self.B.shape[1]), np.array(std)
        nx, nu, nw = len(A), self.B.shape[1], len(std)
        space = DesignSpace(["p"], [0.5], [1.5])

        def plant(share: float) -> Plant:
            x, u, w, p = (ca.SX.sym(s, n) for s, n in (("x", nx), ("u", nu), ("w", nw), ("p", 1)))
            after = ca.DM(A) @ x + share * p * ca.DM(B) @ u + ca.DM(E) @ w
            return Plant(x, u, w, p, after, space, dt=0.1, continuous=False)

        far = 1e3 * np.ones(nx)
        self.real = plant(WRONG[kind])
        self.problem = CoDesignProblem(
            discretise(plant(1.0)), X=(-far, far), U=(-1e3 * np.ones(nu), 1e3 * np.ones(nu)),
            objective=QuadraticObjective(self.Q, self.R), scenarios=FixedStart(np.zeros(nx), Gaussian(std)), steps=100,
        )  # fmt: skip
        best = -lqr(self.A, self.B, Q=self.Q, R=self.R)[0]
        peak = self.cost(best)
        self.served = brentq(lambda s: self.cost(s * best) - WORSE * peak, 1.0, 3.0) * best
        self.candidates = {effect: self.candidate(effect, best) for effect in EFFECTS}

    def candidate(self, effect: float, best):
        """Law of an effect: near the law in service, as an update is, or beyond the optimum."""
        asked = self.cost(self.served) * (1 - effect)
        if self.kind == "beyond":
            return brentq(lambda s: self.cost(s * best) - asked, 0.05, 1.0) * best
        aside = np.linalg.svd(self.served)[2][-1:] * np.linalg.norm(self.served) * ASIDE
        return (
            brentq(lambda s: self.cost(s * self.served + aside) - asked, best[0, 0] / self.served[0, 0], 1.6)
            * self.served
            + aside
        )

    def cost(self, K) -> float:
        """Mean cost of a sample in the real loop u = Kx; infinite if it is not stable."""
        closed = self.A + self.B @ K
        if np.abs(np.linalg.eigvals(closed)).max() >= 1:
            return 1e9
        after = solve_discrete_lyapunov(closed, self.noise)
        before = solve_discrete_lyapunov(closed, self.noise)
        return float(np.trace(self.Q @ after) + np.trace(K.T @ self.R @ K @ before))

    def decided(self, effect: float, seed: int, logged: int) -> tuple[TrialStatus, int, bool]:
        """Status and pairs of one deployment after a log, and whether its interval holds the truth."""
        rng = np.random.default_rng([seed, 77])
        w = Gaussian(self.std).sample(1, STEPS, rng)[0]
        laws = [LinearFeedback(-K) for K in (self.served, self.candidates[effect])]
        model = None
        if logged:
            former = Gaussian(self.std).sample(1, logged, np.random.default_rng([seed, 99]))
            log = deploy(self.real, laws[0], [1.0], former, x0=np.zeros(len(self.A)))
            model = identified_plant(self.problem, log)
        trial = switchback_on(
            self.problem, self.real, *laws, [1.0], x0=np.zeros(len(self.A)), disturbance=w, rng=rng,
            config=TrialConfig(), model=model,
        ).trial  # fmt: skip
        low, high = trial.interval
        gain = effect * self.cost(self.served) * TrialConfig().block
        return trial.status, trial.pairs, bool(low <= gain <= high)


def loops(kind: str) -> list[Loop]:
    """Three plants: an oscillator, an unstable one, and a chain with a weak input."""
    c, s = np.cos(0.3), np.sin(0.3)
    return [
        Loop("oscillator", [[c, s], [-s, c]], [[0.0], [0.3]], np.eye(2), [0.1, 0.1], kind),
        Loop("unstable", [[1.05, 0.1], [0.0, 0.9]], [[0.0], [0.5]], [[0.0], [1.0]], [0.2], kind),
        Loop("chain", [[0.98, 0.1, 0], [-0.1, 0.95, 0.05], [0.02, 0, 0.9]], [[0.0], [0.1], [0.4]], np.eye(3),
             [0.3, 0.05, 0.1], kind),
    ]  # fmt: skip


def switchback_table(trials: int, processes: int) -> None:
    """Print rows per candidate, plant, effect and log: all trials of near candidates, a tenth of the others."""
    print("| log | candidate | plant | effect | adopted | rejected | undecided | pairs, median | interval holds |")
    print("|---|---|---|---|---|---|---|---|---|")
    for kind in KINDS:
        for loop, effect, logged in product(loops(kind), EFFECTS, LOGGED):
            count = max(1, trials // (15 if kind == "near" else 150))
            found = Parallel(processes)(delayed(loop.decided)(effect, seed, logged) for seed in range(count))
            states = [sum(status is one for status, *_ in found) for one in TrialStatus]
            told = [f"{share} of {count}" for share in (*states, sum(held for *_, held in found))]
            told.insert(3, f"{np.median([pairs for _, pairs, _ in found]):.0f}")
            print(f"| {logged} | {kind} | {loop.name} | {100 * effect:+.1f} % | {' | '.join(told)} |", flush=True)


# ── drift ──


def residuals_of(kind: str, n: int, rng) -> np.ndarray:
    """Residuals (n, 2) of a kind."""
    if kind == "independent":
        return rng.standard_normal((n, 2)) @ np.array([[1.0, 0.6], [0.0, 0.2]])
    if kind == "heavy tails":
        return stats.t(3).rvs((n, 2), random_state=rng)
    noise = rng.standard_normal((n + 200, 2))
    share = {"correlated 0.5": 0.5, "correlated 0.9": 0.9}[kind]
    e = np.zeros_like(noise)
    for k in range(1, len(e)):
        e[k] = share * e[k - 1] + np.sqrt(1 - share**2) * noise[k]
    return e[200:]


CHANGES = {"none": lambda e: e, "offset 0.5 σ": lambda e: e + 0.5 * e.std(0), "spread × 1.3": lambda e: 1.3 * e}


def alarmed(kind: str, change: str, seed: int) -> tuple[bool, float]:
    """Whether there is an alarm, and after which part of the stream."""
    rng = np.random.default_rng([seed, 78])
    e = residuals_of(kind, 6000, rng)
    found = detect_drift(e[:3000], CHANGES[change](e[3000:]))
    return found.found is not None, np.nan if found.found is None else found.found


def drift_table(trials: int, processes: int) -> None:
    """Print a row per kind of residual and change."""
    print("| residuals | change | alarms in 3000 samples | known after, median |")
    print("|---|---|---|---|")
    for kind in ("independent", "heavy tails", "correlated 0.5", "correlated 0.9"):
        for change in CHANGES:
            found = Parallel(processes)(delayed(alarmed)(kind, change, seed) for seed in range(trials))
            after = [known for alarm, known in found if alarm]
            median = f"{np.median(after):.0f}" if after else "–"
            print(f"| {kind} | {change} | {np.mean([alarm for alarm, _ in found]):.1%} | {median} |", flush=True)


# ── redesign ──


class Product:
    """Gains N(mean, spread), measured with a noise N(0, noise); the decision of Bayes in closed form beside ours."""

    def __init__(self, name, mean, spread, noise, cost, serves, logging, first, *, known=("noise", "prior")) -> None:
        self.name, self.mean, self.spread, self.noise, self.first, self.known = name, mean, spread, noise, first, known
        self.terms = RedesignCost(cost, serves, "EUR", worth=1.0, logging=logging)

    def posterior(self, gains) -> tuple[float, float]:
        """Mean and standard deviation of the gain after measurements."""
        precision = self.spread**-2 + len(gains) * self.noise**-2
        return (self.mean * self.spread**-2 + np.sum(gains) * self.noise**-2) / precision, precision**-0.5

    def bayes(self, gains) -> str:
        """Best of redesign, stop and k more logs, by the expected maximum of a normal posterior mean."""
        mean, error = self.posterior(gains)
        terms = self.terms
        worths = {"stop": 0.0, "redesign now": terms.serves * mean - terms.cost}
        logged = [-np.inf]
        for k in range(1, int(terms.serves)):
            left = terms.serves - k
            moved = np.sqrt(error**2 - 1 / (error**-2 + k * self.noise**-2)) * left
            excess = left * mean - terms.cost
            z = excess / moved
            logged.append(excess * stats.norm.cdf(z) + moved * stats.norm.pdf(z) - k * terms.logging)
        worths["log longer"] = max(logged)
        return max(worths, key=worths.get)

    def ours(self, gains) -> str:
        """The library's decision."""
        known = {"noise": self.noise, "prior": (self.mean, self.spread)}
        return decide_redesign(gains, self.terms, **{name: known[name] for name in self.known}).status.value

    def served(self, seed: int) -> tuple[float, float, float, str, str]:
        """Worth of ours, of Bayes and of knowing the gain; and the first decision of both."""
        rng = np.random.default_rng([seed, 79])
        gain = rng.normal(self.mean, self.spread)
        stream = gain + self.noise * rng.standard_normal(int(self.terms.serves) + self.first)
        ends = [self._followed(decide, gain, stream) for decide in (self.ours, self.bayes)]
        known = max(0.0, self.terms.serves * gain - self.terms.cost)
        return ends[0][0], ends[1][0], known, ends[0][1], ends[1][1]

    def _followed(self, decide, gain: float, stream) -> tuple[float, str]:
        """Worth of a rule that decides anew after every log, and its first decision."""
        logs, first = 0, ""
        while True:
            left = self.terms.serves - logs
            rule = Product(self.name, self.mean, self.spread, self.noise, self.terms.cost, left, self.terms.logging,
                           self.first, known=self.known)  # fmt: skip
            said = (rule.ours if decide == self.ours else rule.bayes)(stream[: self.first + logs])
            first = first or said
            if said != "log longer" or left < 2:
                worth = left * gain - self.terms.cost if said == "redesign now" else 0.0
                return worth - logs * self.terms.logging, first
            logs += 1


PRODUCTS = (
    Product("one log tells", 0.0, 10.0, 3.0, 200.0, 40, 5.0, 1),
    Product("many logs tell", 2.0, 5.0, 20.0, 200.0, 60, 1.0, 2),
    Product("noise estimated", 0.0, 10.0, 5.0, 200.0, 40, 5.0, 3, known=("prior",)),
    Product("no prior", 0.0, 10.0, 5.0, 200.0, 40, 5.0, 3, known=("noise",)),
    Product("noise estimated, no prior", 0.0, 10.0, 5.0, 200.0, 40, 5.0, 3, known=()),
)


def redesign_table(trials: int, processes: int) -> None:
    """Print a row per product."""
    print("| product | regret, Bayes | regret, ours | ratio | stops where Bayes stops |")
    print("|---|---|---|---|---|")
    for one in PRODUCTS:
        rows = Parallel(processes)(delayed(one.served)(seed) for seed in range(trials))
        ours, bayes, known = np.array([row[:3] for row in rows]).T
        stops = [row[3] == RedesignAction.STOP.value for row in rows if row[4] == "stop"]
        regrets = (known - bayes).mean(), (known - ours).mean()
        print(f"| {one.name} | {regrets[0]:.2f} | {regrets[1]:.2f} | {regrets[1] / regrets[0]:.3f} | "
              f"{np.mean(stops):.1%} of {len(stops)} |", flush=True)  # fmt: skip


TABLES = {"switchback": switchback_table, "drift": drift_table, "redesign": redesign_table}


def main() -> None:
    """Print the tables that are asked for."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("tables", nargs="*", choices=[*TABLES, []], default=list(TABLES))
    parser.add_argument("--trials", type=int, default=1000)
    parser.add_argument("--processes", type=int, default=2)
    asked = parser.parse_args()
    for name in asked.tables:
        print(f"\n{name}, {asked.trials} each\n")
        TABLES[name](asked.trials, asked.processes)


if __name__ == "__main__":
    main()
