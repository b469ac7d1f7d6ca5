"""What is at best possible at the first designs of studies, beside LQR, MPC or other laws.

    python benchmarks/study_bounds.py

The optimum of the pendulum's model is that of dynamic programming over angle, speed and time, on a grid of its own with
equations of its own. The bounds of the real servo and of the damper's model are those of plans that know every run's
disturbance, by L-BFGS from what LQR or other laws do: nothing that does not know it returns more, as far as their
optima are global. That of the study `wall` stands in `mass_and_wall.py`.
"""

from __future__ import annotations

import casadi as ca
import numpy as np
from scipy.ndimage import map_coordinates
from scipy.optimize import minimize

from ccdtools import LinearFeedback, saturated_lqr, simulate
from ccdtools.co_design.imitation import EXPERTS
from ccdtools.studies import load_study

STEPS, DT, PUSH = 50, 0.1, 0.02
ANGLES, SPEEDS, TORQUES = np.linspace(-np.pi, np.pi, 181)[:-1], np.linspace(-12, 12, 161), np.linspace(-2, 2, 21)
NODES, WEIGHTS = np.array([-(3**0.5), 0.0, 3**0.5]), np.array([1, 4, 1]) / 6


def swung(angle, speed, torque):
    """Angle and speed of a rod of 0.9 kg and 1 m after a sample, by two Runge-Kutta steps."""
    z, h = np.array(np.broadcast_arrays(angle, speed)), DT / 2

    def rate(z):
        return np.array([z[1], 15 * np.sin(z[0]) + 3 / 0.9 * np.broadcast_to(torque, z[1].shape)])

    for _ in range(2):
        a = rate(z)
        b = rate(z + h / 2 * a)
        c = rate(z + h / 2 * b)
        z = z + h / 6 * (a + 2 * b + 2 * c + rate(z + h * c))
    return z


def cost(angle, speed, torque):
    """Cost of Pendulum-v1."""
    return np.arctan2(np.sin(angle), np.cos(angle)) ** 2 + 0.1 * speed**2 + 0.001 * torque**2


def read(values, angle, speed):
    """Values between the points of the grid, whose angles go round."""
    places = [(angle - ANGLES[0]) / (ANGLES[1] - ANGLES[0]), (speed - SPEEDS[0]) / (SPEEDS[1] - SPEEDS[0])]
    places[0] = places[0] % len(ANGLES)
    around = np.vstack([values, values[:1]])
    return map_coordinates(around, places, order=1, mode="nearest")


def best(values, angle, speed):
    """Least cost to go, and the torque that has it."""
    found = []
    for torque in TORQUES:
        ahead = [read(values, *swung(angle, speed, torque + PUSH * node)) for node in NODES]
        found.append(cost(angle, speed, torque) + np.tensordot(WEIGHTS, ahead, 1))
    return np.min(found, axis=0), TORQUES[np.argmin(found, axis=0)]


def pendulum(runs: int = 200) -> None:
    """Print the returns on the model, without the design's cost."""
    grid = np.meshgrid(ANGLES, SPEEDS, indexing="ij")
    ahead = [np.zeros_like(grid[0])]
    for _ in range(STEPS - 1):
        ahead.insert(0, best(ahead[0], *grid)[0])
    w = PUSH * np.random.default_rng(0).standard_normal((runs, STEPS, 1))
    state, total = (np.full(runs, 2.6), np.zeros(runs)), np.zeros(runs)
    for k in range(STEPS):
        _, torque = best(ahead[k], *state)
        total -= cost(*state, torque)
        state = swung(*state, torque + w[:, k, 0])
    print(f"swing_up: dynamic programming {total.mean():.2f} ± {1.96 * total.std() / runs**0.5:.2f}, {runs} runs")
    study = load_study("swing_up")
    for name, few in (("LQR", runs), ("nonlinear MPC", 8), ("economic MPC", 8)):
        law = EXPERTS[name](study.problem(), study.p0)
        run = simulate(study.model, law, x0=study.x0, steps=STEPS, design=study.p0, disturbance=w[:few])
        found = -cost(*np.moveaxis(run.states[:, :-1], 2, 0), run.inputs[..., 0]).sum(axis=1)
        beside = 100 * (found - total[:few]) / abs(total[:few].mean())
        print(f"  {name} {found.mean():.2f}, beside it {beside.mean():+.2f} %, {few} runs", flush=True)


def foreseen(study, plant, x0, w, starts, limit):
    """Returns (n,) of plans that know each run's disturbance w (n, N, nw), the best of L-BFGS from starts (m, n, N)."""
    steps, Q, R = w.shape[1], study.weights.Q, study.weights.R
    u, push = ca.MX.sym("u", 1, steps), ca.MX.sym("w", w.shape[2], steps)
    x = plant.step.mapaccum(steps)(x0, u, push, ca.repmat(ca.DM(study.p0), 1, steps))
    total = ca.sum2(ca.sum1(x * (Q @ x))) + R[0, 0] * ca.sumsqr(u)
    value = ca.Function("value", [u, push], [total, ca.gradient(total, u)])

    def plan(first, k):
        def cost_of(inputs):
            worth, slope = value(inputs[None], w[k].T)
            return float(worth), np.asarray(slope).ravel()

        return -minimize(cost_of, np.clip(first, -limit, limit), jac=True, method="L-BFGS-B",
                         bounds=[(-limit, limit)] * steps, options={"maxiter": 500, "maxfun": 1000}).fun  # fmt: skip

    return np.array([max(plan(start[k], k) for start in starts) for k in range(len(w))])


def beside(name, found, laws):
    """Print a bound, and how far each law's returns (n,) are below it."""
    print(f"{name}: with foresight {found.mean():.1f}, {len(found)} runs")
    for law, rewards in laws.items():
        gap = 100 * (rewards - found) / abs(found.mean())
        print(
            f"  {law} {rewards.mean():.1f}, {gap.mean():+.2f} ± {1.96 * gap.std() / len(gap) ** 0.5:.2f} %", flush=True
        )


def servo(runs: int = 8) -> None:
    """Print the returns on the real plant."""
    study = load_study("backlash_servo")
    plant, steps = study.real.plant, study.steps
    w = study.disturbance.sample(runs, steps, np.random.default_rng(0))
    lqr = simulate(plant, saturated_lqr(study.problem(), study.p0), x0=study.x0, steps=steps, design=study.p0,
                   disturbance=w)  # fmt: skip
    rewards = study.objective.rewards(lqr.states[:, 1:], lqr.inputs, lqr.states[:, :-1], study.p0).sum(axis=1)
    beside("backlash_servo", foreseen(study, plant, study.x0, w, [lqr.inputs[..., 0]], 24), {"LQR": rewards})


def damper(runs: int = 16) -> None:
    """Print the returns on the model without the price of the design, whose halves of the runs are two drivers'."""
    study = load_study("semi_active_damper")
    w = study.disturbance.sample(runs, study.steps, np.random.default_rng(0))
    laws = {"best constant input": None} | {name: law(study.problem(), study.p0) for name, law in study.laws.items()}
    rewards, starts = {}, []
    for name, law in laws.items():
        held = [law] if law else [LinearFeedback(np.zeros((1, 6)), offset=[u]) for u in (-1.0, -0.5, 0.0, 0.5, 1.0)]
        tried = [simulate(study.model, one, x0=study.x0, steps=study.steps, design=study.p0, disturbance=w)
                 for one in held]  # fmt: skip
        found = [study.objective.rewards(one.states[:, 1:], one.inputs, one.states[:, :-1], study.p0).sum(axis=1)
                 for one in tried]  # fmt: skip
        best = int(np.argmax([one.mean() for one in found]))
        rewards[name] = found[best]
        starts.append(tried[best].inputs[..., 0])
    beside("semi_active_damper", foreseen(study, study.model, study.x0, w, starts, 1.0), rewards)


if __name__ == "__main__":
    servo()
    damper()
    pendulum()
