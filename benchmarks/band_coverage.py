"""Do bands of 80 % hold 80 % on fresh drives? Per output, per regime, jointly over outputs, and over 1 to 100 steps.

Fresh drives come from simulators of this file: both case studies, a plant under Student's t noise of three degrees, one
under noise of two regimes that change at random, and one under noise whose size changes slowly. A twin learns one log
and its bands are judged on others. Regimes are the calmest and the roughest third of windows by the disturbance of the
last 25 samples before each.

    python benchmarks/band_coverage.py free [--cases ...] [--seeds 24]   bands of a twin
    python benchmarks/band_coverage.py few                               200 fits at n = 50 … 300
    python benchmarks/band_coverage.py stream                            adaptive factors after a shift
    python benchmarks/band_coverage.py time                              beside scikit-learn's gradient boosting
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import casadi as ca
import numpy as np
from scipy.linalg import solve_discrete_are
from scipy.signal import lfilter

from ccdtools import DesignSpace, DigitalTwin, Plant, discretise, load_study
from ccdtools.trajectory import Trajectory
from ccdtools.twin import free_running_bands
from learning import AdaptiveConformal, Conformal, InputError, QuantileConfig, fit_quantiles

Array = np.ndarray
STEPS = (1, 10, 50, 100)
DRAWS = 60
BEFORE = 25  # samples of disturbance that tell the regime of a window


@dataclass(frozen=True)
class World:
    """A nominal model, a real step (x, u, w) → x⁺, a gain with limits, and disturbances (runs, steps, nw)."""

    model: object
    design: Array
    step: Callable[[Array, Array, Array], Array]
    gain: Array
    limit: float
    start: Array
    disturbance: Callable[[int, int, np.random.Generator], Array]
    learned: tuple[int, int]  # runs and steps of the log
    judged: tuple[int, int]

    def law(self, x: Array) -> Array:
        """Saturated state feedback."""
        return np.clip(-x @ self.gain.T, -self.limit, self.limit)

    def drives(self, runs: int, steps: int, rngs: Sequence[np.random.Generator]) -> list[Trajectory]:
        """A log of so many runs by each generator, all simulated at once."""
        w = np.concatenate([self.disturbance(runs, steps, rng) for rng in rngs])
        states, inputs = [np.tile(self.start, (len(w), 1))], []
        for k in range(steps):
            inputs.append(self.law(states[-1]))
            states.append(self.step(states[-1], inputs[-1], w[:, k]))
        x, u = np.stack(states, axis=1), np.stack(inputs, axis=1)
        parts = [slice(i * runs, (i + 1) * runs) for i in range(len(rngs))]
        return [Trajectory(x[i], u[i], w[i], np.full(runs, -1), self.design, self.model.dt) for i in parts]


def regulator(A: Array, B: Array, Q: Array, R: Array) -> Array:
    """Gain of the linear quadratic regulator."""
    P = solve_discrete_are(A, B, Q, R)
    return np.linalg.solve(R + B.T @ P @ B, B.T @ P @ A)


def illustrative() -> World:
    """The unstable example with its bias, drift and varying gain; 200 runs of 100 steps."""
    A, p = np.array([[0.8, 0.5], [0.5, 0.6]]), 3.0
    B = np.array([[0.5], [p]])

    def step(x: Array, u: Array, w: Array) -> Array:
        a, b = x.T
        drift = np.stack([a * np.sin(a) + b * np.cos(b), b * np.sin(b) + a * np.cos(a)], axis=1)
        gain = np.stack([np.sin(a), p * np.cos(b)], axis=1)
        return x @ A.T + u @ B.T + w + [0.1, -0.2] + 0.1 * drift + 0.5 * gain * u

    def noise(runs: int, steps: int, rng: np.random.Generator) -> Array:
        return rng.normal(0, [0.1, 0.2], (runs, steps, 2)) + rng.uniform(-0.1, 0.1, (runs, steps, 2))

    gain = regulator(A, B, np.eye(2), np.array([[0.1]]))
    return World(load_study("illustrative").model, np.array([p]), step, gain, 1.0, np.array([-3.5, -2.0]), noise,
                 (200, 100), (1000, 100))  # fmt: skip


def suspension() -> World:
    """The quarter car with a hardening strut on the study's mild roads; one drive of 12.5 minutes."""
    study = load_study("suspension")
    spring, damper, sprung, unsprung, tyre = 1e4, 3e3, 325.0, 65.0, 232.5e3

    def slope(x: Array, u: Array, w: Array) -> Array:
        deflection, wheel, travel, body = x.T
        rate = body - wheel
        force = spring * (travel + 0.01 * travel**3) + damper * (rate + 0.01 * np.abs(rate) * rate) - u[:, 0]
        return np.stack([wheel - w[:, 0], (force - tyre * deflection) / unsprung, rate, -force / sprung], axis=1)

    def step(x: Array, u: Array, w: Array) -> Array:
        h = 0.05 / 6
        for _ in range(6):
            a = slope(x, u, w)
            b = slope(x + h / 2 * a, u, w)
            c = slope(x + h / 2 * b, u, w)
            x = x + h / 6 * (a + 2 * b + 2 * c + slope(x + h * c, u, w))
        return x

    p = np.array([spring, damper])
    A, B, _ = study.model.matrices(p)
    gain = regulator(A, B, np.diag([10.0, 1.0, 50.0, 5.0]), np.array([[1e-6]]))
    road = study.real.disturbance
    return World(study.model, p, step, gain, 1000.0, np.zeros(4), road.sample, (1, 15000), (3, 15000))


def bent(noise: Callable[[int, int, np.random.Generator], Array]) -> World:
    """A plant of two states that the real one bends, under two signals (runs, steps, 2) that enter both."""
    A, B = np.array([[0.9, 0.2], [-0.2, 0.8]]), np.array([[0.2], [1.0]])
    E = np.array([[1.0, 0.3], [0.5, -1.0]])
    x, u, w, p = ca.SX.sym("x", 2), ca.SX.sym("u"), ca.SX.sym("w", 2), ca.SX.sym("p")
    after = ca.DM(A) @ x + p * (ca.DM(B) @ u) + ca.DM(E) @ w
    model = discretise(Plant(x, u, w, p, after, DesignSpace(["b"], [0.5], [2.0]), dt=0.1, continuous=False))

    def step(x: Array, u: Array, w: Array) -> Array:
        return x @ A.T + u @ B.T + w @ E.T + 0.05 * np.sin(x)

    gain = regulator(A, B, np.eye(2), np.eye(1))
    return World(model, np.ones(1), step, gain, 1e6, np.zeros(2), noise, (1, 15000), (3, 15000))


def student() -> World:
    """Noise of Student's t, three degrees of freedom."""
    return bent(lambda runs, steps, rng: rng.standard_t(3, (runs, steps, 2)))


def regimes() -> World:
    """Normal noise, now calm, now three times as large; a change once in 200 samples on average."""

    def noise(runs: int, steps: int, rng: np.random.Generator) -> Array:
        changes = np.cumsum(rng.random((runs, steps)) < 1 / 200, axis=1) + rng.integers(0, 2, (runs, 1))
        return np.where(changes % 2, 1.0, 1 / 3)[:, :, None] * rng.standard_normal((runs, steps, 2))

    return bent(noise)


def slow() -> World:
    """Noise of an oscillation with memory, whose size changes slowly: by e^0.5, over some 300 samples."""

    def noise(runs: int, steps: int, rng: np.random.Generator) -> Array:
        keep, before = np.exp(-1 / 300), 1000
        size = lfilter([0.5 * np.sqrt(1 - keep**2)], [1, -keep], rng.standard_normal((runs, steps + before)), axis=1)
        signal = rng.standard_normal((runs, steps + before, 2)) * np.exp(size)[:, :, None]
        return lfilter([1], [1, -1.2, 0.5], signal, axis=1)[:, before:]

    return bent(noise)


WORLDS = {
    "illustrative": illustrative, "student": student, "suspension": suspension, "regimes": regimes, "slow": slow,
}  # fmt: skip


def judge(name: str, seeds: int, windows: int) -> None:
    """Print coverage of the bands of so many twins, its mean and the standard error of that."""
    world = WORLDS[name]()
    train, test, learning, drawing = zip(*(np.random.default_rng([seed, len(name)]).spawn(4) for seed in range(seeds)))
    found: dict[int, list[list[float]]] = {k: [] for k in STEPS}
    crossed = 0
    for seed, (log, fresh) in enumerate(zip(world.drives(*world.learned, train), world.drives(*world.judged, test))):
        twin = DigitalTwin(world.model).update(log, weight=np.eye(world.model.nx), rng=learning[seed])
        bands = free_running_bands(twin, fresh, world.law, rng=drawing[seed], steps=STEPS, windows=windows, draws=DRAWS)
        run, first = starts(fresh, int(bands.steps[-1]), windows)
        third = rough_third(fresh.disturbances, run, first)
        for i, k in enumerate(bands.steps.tolist()):
            actual = np.stack([fresh.states[run, first + h] for h in range(1, k + 1)])
            lower, upper = bands.tube(k)
            crossed += int((lower > upper).sum() + (bands.lower > bands.upper).sum())
            inside = (actual[-1] >= bands.lower[i]) & (actual[-1] <= bands.upper[i])
            held = ((actual >= lower) & (actual <= upper)).all(axis=(0, 2))
            row = [*inside.mean(axis=0), *(inside[third == j].mean() for j in (0, 2)), held.mean(),
                   *(held[third == j].mean() for j in (0, 2))]  # fmt: skip
            found[k].append(row)
    print(f"{name}: {seeds} twins, {windows} windows each, {crossed} crossings")
    for k, rows in found.items():
        if not rows:
            print(f"  {k:3d} steps: too few windows calibrate")
            continue
        error = np.std(rows, axis=0, ddof=1) / np.sqrt(seeds)
        cells = [f"{c:.1%} ± {e:.1%}" for c, e in zip(np.mean(rows, axis=0), error)]
        print(f"  {k:3d} steps: outputs {', '.join(cells[:-5])}; in calm, rough {', '.join(cells[-5:-3])}; joint "
              f"{cells[-3]} (deviation {np.std(rows, axis=0, ddof=1)[-3]:.1%}); in calm, rough "
              f"{', '.join(cells[-2:])}", flush=True)  # fmt: skip


def starts(log: Trajectory, length: int, windows: int) -> tuple[Array, Array]:
    """Run and first sample of windows, evenly spread: as documented."""
    runs, steps = log.inputs.shape[:2]
    each = steps - length + 1
    chosen = np.unique(np.linspace(0, runs * each - 1, min(windows, runs * each)).round().astype(int))
    return chosen // each, chosen % each


def rough_third(w: Array, run: Array, first: Array) -> Array:
    """0 for windows in the calmest third, 2 in the roughest, by the disturbance before them; 1 for all of none."""
    size = np.array([np.sqrt((w[i, max(k - BEFORE, 0) : k] ** 2).mean()) if k else np.nan for i, k in zip(run, first)])
    if np.isnan(size).mean() > 0.5:
        return np.arange(len(size)) % 3
    edges = np.nanquantile(size, (1 / 3, 2 / 3))
    return np.where(np.isnan(size), 1, np.searchsorted(edges, size))


# ── few samples, streams, time ──


def heteroscedastic(n: int, rng: np.random.Generator) -> tuple[Array, Array]:
    """y = sin(2 x₁) + (0.2 + 0.4 x₂²) ε."""
    x = rng.uniform(-1, 1, (n, 2))
    return x, np.sin(2 * x[:, 0]) + (0.2 + 0.4 * x[:, 1] ** 2) * rng.standard_normal(n)


def few(fits: int) -> None:
    """Print coverage of fits to few samples on fresh ones."""
    for n in (30, 50, 100, 200, 300):
        covered, refused, crossed = [], "", 0
        for seed in range(fits):
            rng = np.random.default_rng([n, seed])
            x, y = heteroscedastic(n, rng)
            fresh, after = heteroscedastic(5000, rng)
            try:
                q = fit_quantiles(x, y, rng=rng, config=QuantileConfig()).predict(fresh)[:, :, 0]
            except InputError as error:
                refused = str(error)
                break
            crossed += int((np.diff(q, axis=1) < 0).sum())
            covered.append(np.mean((after >= q[:, 0]) & (after <= q[:, 2])))
        shown = refused or f"{np.mean(covered):.1%} ± {1.96 * np.std(covered) / np.sqrt(fits):.1%}, {crossed} crossings"
        print(f"n = {n:3d}: {shown}", flush=True)


def stream(streams: int) -> None:
    """Print coverage of fixed and adaptive factors before a shift and from 250 and 500 samples after it."""
    shifts = {
        "none": lambda e: e, "twice the noise": lambda e: 2 * e, "a bias of one deviation": lambda e: e + 1,
        "half the noise": lambda e: e / 2, "four times": lambda e: 4 * e,
    }  # fmt: skip
    noises = {"normal": lambda rng, n: rng.standard_normal(n), "Student's t₃": lambda rng, n: rng.standard_t(3, n)}
    for noise, draw in noises.items():
        for shift, change in shifts.items():
            rows = []
            for seed in range(streams):
                rng = np.random.default_rng(seed)
                known = Conformal.fit(np.abs(draw(rng, 500)), 0.8).factor
                scores = np.abs(np.concatenate([draw(rng, 1000), change(draw(rng, 1500))]))
                one = AdaptiveConformal(0.8, float(known))
                inside, fixed, lost = np.zeros((2, len(scores))), scores <= known, np.zeros(len(scores))
                for k, score in enumerate(scores):
                    inside[0, k], lost[k] = score <= one.factor, one.lost
                    one = one.after(float(score))
                flagged = np.flatnonzero(lost[1000:])
                rows.append(
                    [
                        inside[0, :1000].mean(),
                        fixed[1000:].mean(),
                        inside[0, 1250:1500].mean(),
                        inside[0, 1500:2000].mean(),
                        lost[:1000].any(),
                        flagged[0] if len(flagged) else np.nan,
                    ]
                )
            before, fixed_after, half, after, alarm, delay = (np.array(column) for column in zip(*rows))
            seen = np.isfinite(delay)
            when = f"flagged in {seen.mean():.0%}" + (f", after {np.median(delay[seen]):.0f}" if seen.any() else "")
            print(f"{noise}, {shift}: before {before.mean():.1%}, fixed after {fixed_after.mean():.1%}, adaptive from "
                  f"250: {half.mean():.1%}, from 500: {after.mean():.1%}; false alarms {alarm.mean():.1%}; {when}",
                  flush=True)  # fmt: skip


def timed(repeats: int) -> None:
    """Print processor time of one fit at 1000 samples beside three levels of boosting."""
    from sklearn.ensemble import GradientBoostingRegressor

    own, others = [], []
    for seed in range(repeats):
        x, y = heteroscedastic(1000, np.random.default_rng(seed))
        begin = time.process_time()
        fit_quantiles(x, y, rng=np.random.default_rng(seed))
        own.append(time.process_time() - begin)
        begin = time.process_time()
        for level in (0.1, 0.5, 0.9):
            GradientBoostingRegressor(loss="quantile", alpha=level).fit(x, y)
        others.append(time.process_time() - begin)
    print(
        f"one fit {np.median(own):.2f} s, boosting {np.median(others):.2f} s: {np.median(own) / np.median(others):.1f}"
    )


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=("free", "few", "stream", "time"))
    parser.add_argument("--cases", default=",".join(WORLDS))
    parser.add_argument("--seeds", type=int, default=24)
    parser.add_argument("--windows", type=int, default=400)
    parser.add_argument("--fits", type=int, default=200)
    asked = parser.parse_args()
    if asked.what == "free":
        for case in asked.cases.split(","):
            judge(case, asked.seeds, asked.windows)
    else:
        {"few": few, "stream": stream, "time": timed}[asked.what](5 if asked.what == "time" else asked.fits)
