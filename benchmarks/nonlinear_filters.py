"""The cubature filter beside an extended and an unscented one, and 100 000 particles, all written here in NumPy.

    python benchmarks/nonlinear_filters.py [--runs 200] [--by-particles 6] [--particles 100000] [--only NAME ...]

Each plant moves with the noise that the filters are told, and a law of the state, or of an estimate, holds it. Of the
states it prints how much more other filters err than the cubature one on the same runs, root mean squares over time
and states, each in units of its usual error by the cubature filter and at most ten; of the laws behind the filters, how
much less they cost than behind the extended one, at most ten times the usual. Means with 95 % intervals over runs, in
%. Lost are runs with more than five units in their second half.
"""

from __future__ import annotations

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")

import argparse
import time
from dataclasses import dataclass, field
from types import SimpleNamespace

import casadi as ca
import numpy as np

from ccdtools import DesignSpace, Plant, discretise
from ccdtools.estimation import CubatureKalmanFilter
from ccdtools.plants import library
from ccdtools.studies.cases.semi_active_damper import REAL, study
from ccdtools.vehicles.semi_active import SemiActive
from mpc import lqr

NONE = DesignSpace([], [], [])


@dataclass
class Case:
    """A plant, what is told of it, and a law of its state."""

    plant: Plant
    W: np.ndarray
    V: np.ndarray
    P0: np.ndarray
    x0: np.ndarray
    law: object
    cost: np.ndarray  # weights of squares of states
    p: np.ndarray = field(default_factory=lambda: np.zeros(0))
    steps: int = 100

    def step(self, x, u):
        """x⁺ (n, nx) without noise."""
        return self.plant.stepper(self.p, batch=len(x))(x, u, np.zeros((len(x), self.plant.nw)))

    def see(self, x, u):
        """y (n, ny)."""
        return self.plant.observe(x, u, self.p)


def rubbing(wide=1.0, friction=1.0, unit=1.0, quiet=1.0):
    """Mass on a spring with dry friction, whose acceleration and position are measured; position in parts of `unit`."""
    x, u = ca.SX.sym("x", 2), ca.SX.sym("u")
    force = -x[0] / unit - 0.3 * x[1] - friction * ca.tanh(x[1] / 0.02) + u
    plant = Plant(x, u, None, None, [x[1] * unit, force], NONE, dt=0.02, substeps=4, outputs=[force, x[0] / unit])
    W, scale = quiet * np.diag([0.0, 0.04**2]), np.array([unit, 1.0])
    P0 = wide**2 * np.diag([0.3, 0.5]) ** 2 * np.outer(scale, scale)
    return Case(plant, W * np.outer(scale, scale), quiet * np.diag([0.2, 0.01]) ** 2, P0, np.zeros(2),
                lambda x: np.clip(-2.0 * x[:, :1] / unit - 1.5 * x[:, 1:], -3, 3),
                np.array([1.0 / unit**2, 0.1]))  # fmt: skip


def pole(wide=0.1, quiet=1.0):
    """Pole on a cart, seen from beside the cart: distance and angle of its tip."""
    own = library.pendulum_on_cart()
    across, up = own.x[0] + ca.sin(own.x[2]), 1.5 + ca.cos(own.x[2])
    plant = Plant(own.x, own.u, own.w, own.p, own.dynamics, own.design, own.dt,
                  outputs=[ca.sqrt(across**2 + up**2), ca.atan2(across, up)])  # fmt: skip
    p = own.design.centre
    A, B, _ = discretise(library.pendulum_on_cart(linear=True)).matrices(p)
    K, _ = lqr(A, B, Q=np.eye(4), R=[[1.0]])
    P0 = np.diag([0.1, 0.1, wide, 0.1]) ** 2
    return Case(plant, quiet * np.diag([0, 0.02, 0, 0.02]) ** 2, quiet * np.diag([0.005, 0.005]) ** 2, P0, np.zeros(4),
                lambda x: -x @ K.T, np.array([1.0, 0.1, 5.0, 0.1]), p)  # fmt: skip


def tank(wide=0.3, level=1.0):
    """Tank that runs out by the root of its level, whose outflow is measured."""
    x, u = ca.SX.sym("x"), ca.SX.sym("u")
    root = ca.sqrt(ca.fmax(x, 1e-6))
    plant = Plant(x, u, None, None, [u - root], NONE, dt=0.1, substeps=2, outputs=[root])
    return Case(plant, np.diag([0.03**2]), np.diag([0.05**2]), np.diag([wide**2]), np.array([level]),
                lambda x: np.clip(1.0 - 2.0 * (x - 1.0), 0, 3), np.array([1.0]))  # fmt: skip


def car(quiet=1.0):
    """Real semi-active car with accelerometers and the travel, white road of class D at 20 m/s."""
    p = np.array([22754.0, 3742.0])
    _, _, E = discretise(REAL, sampling_guard="ignore").matrices(p)
    W = E @ E.T * 0.15**2 * quiet
    law = SemiActive(np.array([0.0, -600.0, 0.0, 2500.0, 0.0, 0.0]), p[1])
    P0 = np.diag([1e-3, 0.05, 5e-3, 0.05, 0.3, 5.0]) ** 2
    return Case(REAL, W, np.diag([0.1, 0.5, 0.002]) ** 2 * quiet, P0, np.zeros(6), law, np.diag(study.objective.Q), p,
                steps=150)  # fmt: skip


CASES = {
    "rubbing mass": rubbing, "rubbing mass, wide start": lambda: rubbing(10.0),
    "rubbing mass, a hundredth of the noise": lambda: rubbing(quiet=1e-4),
    "rubbing mass, position in µ": lambda: rubbing(unit=1e6), "rubbing mass, position in M": lambda: rubbing(unit=1e-6),
    "pole on a cart": pole, "pole on a cart, wide start": lambda: pole(0.5),
    "pole on a cart, a hundredth of the noise": lambda: pole(quiet=1e-4),
    "pole on a cart, known start": lambda: known(pole()),
    "tank": tank, "tank, nearly empty": lambda: tank(0.1, 0.2), "tank, wide start": lambda: tank(0.9, 1.5),
    "semi-active car": car, "semi-active car, a tenth of the noise": lambda: car(1e-2),
}  # fmt: skip


def known(case):
    """Case whose start is known exactly."""
    case.P0 = 0 * case.P0
    return case


def product(A, B):
    """A B, batched."""
    return np.einsum("nij,njk->nik", A, B)


class Hand:
    """Filters of the textbook on batches: extended, by differences, or unscented with a point at the middle."""

    def __init__(self, case, kind):
        self.case, self.kind, self.nu, self.ny = case, kind, case.plant.nu, len(case.V)

    def start(self, n):
        """Belief of n runs."""
        return SimpleNamespace(mean=np.tile(self.case.x0, (n, 1)), P=np.tile(self.case.P0, (n, 1, 1)))

    def moments(self, f, belief, u):
        """Mean, covariance and covariance with the state of f(x, u)."""
        x, P = belief.mean, belief.P
        n, nx = x.shape
        if self.kind == "extended":
            size = 1e-4 * np.sqrt(np.maximum(np.einsum("nii->ni", P), 1e-16 * (1 + x**2)))
            columns = []
            for i in range(nx):
                away = size * np.eye(nx)[i]
                columns.append((f(x + away, u) - f(x - away, u)) / (2 * size[:, i : i + 1]))
            J = np.stack(columns, axis=2)
            PJ = product(P, J.swapaxes(1, 2))
            return f(x, u), product(J, PJ), PJ
        values, vectors = np.linalg.eigh(P)  # a root of its own
        L = vectors * np.sqrt(np.maximum(values, 0))[:, None, :]
        middle = max(3.0 - nx, 0.5) / (nx + max(3.0 - nx, 0.5))
        weights = np.r_[middle, np.full(2 * nx, (1 - middle) / (2 * nx))]
        away = np.sqrt(nx / (1 - middle)) * L.swapaxes(1, 2)
        at = np.concatenate([x[:, None], x[:, None] + away, x[:, None] - away], axis=1)
        y = f(at.reshape(-1, nx), np.repeat(u, 2 * nx + 1, axis=0)).reshape(n, 2 * nx + 1, -1)
        mean = np.einsum("k,nki->ni", weights, y)
        dx, dy = at - x[:, None], y - mean[:, None]
        return mean, np.einsum("k,nki,nkj->nij", weights, dy, dy), np.einsum("k,nki,nkj->nij", weights, dx, dy)

    def predict(self, belief, u):
        """Belief a sample later."""
        mean, P, _ = self.moments(self.case.step, belief, u)
        return SimpleNamespace(mean=mean, P=P + self.case.W)

    def update(self, belief, y, u):
        """Belief after outputs."""
        expected, S, C = self.moments(self.case.see, belief, u)
        K = np.linalg.solve(S + self.case.V, C.swapaxes(1, 2)).swapaxes(1, 2)
        P = belief.P - product(product(K, S + self.case.V), K.swapaxes(1, 2))
        return SimpleNamespace(
            mean=belief.mean + np.einsum("nij,nj->ni", K, y - expected), P=(P + P.swapaxes(1, 2)) / 2
        )


def sampled(P, shape, rng):
    """Normal numbers of covariance P."""
    values, vectors = np.linalg.eigh(P)
    return rng.standard_normal((*shape, len(P))) @ (vectors * np.sqrt(np.maximum(values, 0))).T


def run(case, estimator, data, closed):
    """States, estimates (n, T, nx) and costs (n,) of a law of the estimate, or of the state."""
    x, w, v = data
    n = len(x)
    belief, u, cost, kept = estimator.start(n), np.zeros((n, case.plant.nu)), np.zeros(n), []
    for k in range(case.steps):
        belief = estimator.update(belief, case.see(x, u) + v[:, k], u)
        kept.append((x, belief.mean))
        cost += (x**2 * case.cost).sum(axis=1) if case.plant.nx > 1 else ((x - 1) ** 2)[:, 0]
        u = np.asarray(case.law(belief.mean if closed else x)).reshape(n, -1)
        x = case.step(x, u) + w[:, k]
        belief = estimator.predict(belief, u)
    return *(np.stack(part, axis=1) for part in zip(*kept)), cost / case.steps


def by_particles(case, data, particles, rng):
    """Estimates (n, T, nx) of the first runs; the law sees the state."""
    x, w, v = data
    found, inverse = [], np.linalg.inv(case.V)
    for i in range(len(x)):
        true, at, rows = x[i : i + 1], case.x0 + sampled(case.P0, (particles,), rng), []
        u = np.zeros((1, case.plant.nu))
        for k in range(case.steps):
            y = case.see(true, u) + v[i, k]
            miss = y - case.see(at, np.repeat(u, particles, axis=0))
            fit = -0.5 * np.einsum("ni,ij,nj->n", miss, inverse, miss)
            weight = np.exp(fit - fit.max())
            weight /= weight.sum()
            rows.append(weight @ at)
            chosen = np.searchsorted(np.cumsum(weight), (np.arange(particles) + rng.random()) / particles)
            at = at[np.minimum(chosen, particles - 1)]
            u = np.asarray(case.law(true)).reshape(1, -1)
            true = case.step(true, u) + w[i, k]
            at = case.step(at, np.repeat(u, particles, axis=0)) + sampled(case.W, (particles,), rng)
        found.append(rows)
    return np.array(found)


def interval(parts):
    """Text of a mean and its 95 % interval."""
    return f"{parts.mean():.1f} ± {1.96 * parts.std(ddof=1) / len(parts) ** 0.5:.1f}"


def main():
    """Print a row a case."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--runs", type=int, default=200)
    parser.add_argument("--by-particles", type=int, default=6)
    parser.add_argument("--particles", type=int, default=100_000)
    parser.add_argument("--only", nargs="*")
    asked = parser.parse_args()
    print("| case | error: extended | unscented | particles, runs so far | cost less than behind the extended |"
          " lost: extended, cubature | µs a step and run: extended, cubature |\n|" + "---|" * 7)  # fmt: skip
    for name, make in CASES.items():
        if asked.only and name not in asked.only:
            continue
        case, rng = make(), np.random.default_rng(0)
        told = {"W": case.W, "V": case.V, "P0": case.P0, "x0": case.x0, "design": case.p}
        own = CubatureKalmanFilter(case.plant, **told)
        filters = {"cubature": own, **{kind: Hand(case, kind) for kind in ("extended", "unscented")}}
        n = asked.runs
        data = (case.x0 + sampled(case.P0, (n,), rng), sampled(case.W, (n, case.steps), rng),
                sampled(case.V, (n, case.steps), rng))  # fmt: skip
        errors, costs, lost, times, after, unit = {}, {}, {}, {}, case.steps // 10, 1.0
        with np.errstate(all="ignore"):
            for kind, estimator in filters.items():
                began = time.process_time()
                x, mean, _ = run(case, estimator, data, closed=False)
                times[kind] = 1e6 * (time.process_time() - began) / n / case.steps
                unit = np.nanmedian(np.abs(mean - x)[:, after:], axis=(0, 1)) / 0.6745 if kind == "cubature" else unit
                error = np.clip(np.nan_to_num((mean - x) / unit, nan=10.0), -10, 10)
                errors[kind] = np.sqrt((error[:, after:] ** 2).mean(axis=(1, 2)))
                lost[kind] = int((np.sqrt((error[:, case.steps // 2 :] ** 2).mean(axis=(1, 2))) > 5).sum())
                costs[kind] = run(case, estimator, data, closed=True)[2]
            few = slice(asked.by_particles)
            if asked.by_particles:
                mean = by_particles(case, tuple(part[few] for part in data), asked.particles, rng)
                left = np.clip((mean - x[few]) / unit, -10, 10)
                errors["particles"] = np.sqrt((left[:, after:] ** 2).mean(axis=(1, 2)))
        base = errors["cubature"]
        shown = [interval(100 * (errors[kind] / base.mean() - base[: len(errors[kind])] / base.mean()))
                 for kind in errors if kind != "cubature"]  # fmt: skip
        usual = np.nanmedian(costs["extended"])
        most = {kind: np.minimum(np.nan_to_num(cost, nan=np.inf), 10 * usual) for kind, cost in costs.items()}
        less = 100 * (most["extended"] - most["cubature"]) / most["extended"].mean()
        print("| " + " | ".join([name, *shown, interval(less), f"{lost['extended']}, {lost['cubature']} of {n}",
                                 f"{times['extended']:.0f}, {times['cubature']:.0f}"]) + " |", flush=True)  # fmt: skip


if __name__ == "__main__":
    main()
