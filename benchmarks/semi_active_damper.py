"""A quarter car with a damper between two bounds: what learning finds from three starts, beside its engineers' laws.

    python benchmarks/semi_active_damper.py [--seeds 5] [--free] [--optimal-control RUNS]

Every row is the mean of the same 400 runs of 2 s on a white road, beside clipped LQR, with the 95 % interval of the
paired difference. The plain program plans 25 samples with Ipopt in every sample, the road taken as zero ahead, on the
first runs. `--free` designs the spring with the policy; the plain program then stands beside it twice, at the spring
that was learned and at the best of a grid of springs of its own.
"""

from __future__ import annotations

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")

import argparse
import time
from timeit import repeat

import casadi as ca
import numpy as np
import torch
from scipy.linalg import expm, solve_discrete_are
from scipy.optimize import minimize

from ccdtools import (
    CoDesignConfig,
    CoDesignProblem,
    CustomObjective,
    DesignSpace,
    FixedStart,
    Gaussian,
    LearnedPolicy,
    Plant,
    Scenario,
    codesign,
    discretise,
)
from learning import fit_actor_critic

SPRUNG, UNSPRUNG, TYRE, SPRING, SOFT, HARD, DT, STEPS, RUNS = 300.0, 50.0, 2e5, 2e4, 300.0, 4000.0, 0.01, 200, 400
MIDDLE, HALF = (HARD + SOFT) / 2, (HARD - SOFT) / 2
X = np.array([0.05, 5.0, 0.2, 2.5])  # tyre deflection, wheel speed, travel, body speed


def dynamics(x, c, road, k):
    """Rates and body acceleration with damping c and spring k."""
    force = k * x[2] + c * (x[3] - x[1])
    rates = [x[1] - road, (force - TYRE * x[0]) / UNSPRUNG, x[3] - x[1], -force / SPRUNG]
    return rates, rates[3]


def stage_cost(x, u, p):
    """Squares of body acceleration, tyre deflection and travel."""
    _, acceleration = dynamics(x, MIDDLE + HALF * u[0], 0.0, p[0])
    return acceleration**2 + 2e4 * x[0] ** 2 + 10 * x[2] ** 2


def problem() -> CoDesignProblem:
    """Co-design problem: damping as input from −1 to 1, the spring as design."""
    x, u, w, p = ca.SX.sym("x", 4), ca.SX.sym("u"), ca.SX.sym("w"), ca.SX.sym("k_s")
    rates, _ = dynamics(x, MIDDLE + HALF * u, w, p)
    space = DesignSpace(["k_s"], [1e4], [4e4], ["N/m"])
    model = discretise(Plant(x, u, w, p, ca.vertcat(*rates), space, dt=DT), X=(-X, X), U=(-1, 1), W=(-1, 1))
    objective = CustomObjective(stage_cost, Q=np.diag([2e4, 0.0, 10.0, 0.0]), R=[[1.0]])
    scenarios = FixedStart(np.zeros(4), Gaussian([0.25]))
    return CoDesignProblem(model, X=(-X, X), U=(-1, 1), objective=objective, scenarios=scenarios, steps=STEPS,
                           limit_tolerance="off")  # fmt: skip


def asked(demand, x):
    """Input whose damper comes nearest to a demanded force on the body."""
    speed = x[..., 1] - x[..., 3]
    c = np.where(np.abs(speed) > 1e-9, demand / np.where(np.abs(speed) > 1e-9, speed, 1.0), MIDDLE)
    return ((np.clip(c, SOFT, HARD) - MIDDLE) / HALF)[..., None]


def skyhook(gains):
    """Force that a damper to the sky would give, and one to the ground on the wheel."""
    return lambda x: asked(-gains[0] * x[..., 3] + gains[1] * x[..., 1], x)


def clipped_lqr(k: float):
    """LQR of a damper that could push, by SciPy's Riccati equation, clipped to what it can."""
    A = np.array([[0, 1, 0, 0], [-TYRE / UNSPRUNG, 0, k / UNSPRUNG, 0], [0, -1, 0, 1], [0, 0, -k / SPRUNG, 0]])
    B = np.array([[0], [-1 / UNSPRUNG], [0], [1 / SPRUNG]])
    Ad, Bd = np.split(expm(DT * np.block([[A, B], [np.zeros((1, 5))]]))[:4], [4], axis=1)
    acceleration = np.array([0, 0, -k / SPRUNG, 0])
    Q = np.outer(acceleration, acceleration) + np.diag([2e4, 0, 10, 0])
    S, R = acceleration[:, None] / SPRUNG, np.array([[1 / SPRUNG**2]])
    P = solve_discrete_are(Ad, Bd, Q, R, s=S)
    K = np.linalg.solve(R + Bd.T @ P @ Bd, Bd.T @ P @ Ad + S.T)
    return lambda x: asked(-(x @ K.T)[..., 0], x)


class Predictive:
    """Plan of 25 samples by Ipopt in every sample, the road zero ahead; counts programs that were not solved."""

    def __init__(self, own: CoDesignProblem, k: float, samples: int = 25) -> None:
        x, u, start = ca.MX.sym("x", 4, samples + 1), ca.MX.sym("u", 1, samples), ca.MX.sym("start", 4)
        after = own.model.step.map(samples)(x[:, :-1], u, ca.DM.zeros(1, samples), ca.DM(k))
        cost = sum(stage_cost(x[:, i], u[:, i], [k]) for i in range(samples))
        gaps = ca.veccat(x[:, 0] - start, after - x[:, 1:])
        options = {"ipopt.print_level": 0, "ipopt.sb": "yes", "print_time": False}
        program = {"x": ca.veccat(x, u), "f": cost, "g": gaps, "p": start}
        self.solver, self.cut, self.failed = ca.nlpsol("plan", "ipopt", program, options), x.numel(), 0
        self.bound = np.r_[np.full(self.cut, np.inf), np.ones(samples)]
        self.reset(1)

    def reset(self, n: int) -> None:
        """Forget the plans of n runs."""
        self.plans = [np.zeros(len(self.bound)) for _ in range(n)]

    def __call__(self, x):
        """Inputs (n, 1)."""
        given = []
        for i, state in enumerate(np.atleast_2d(x)):
            found = self.solver(x0=self.plans[i], lbx=-self.bound, ubx=self.bound, lbg=0, ubg=0, p=state)
            self.failed += not self.solver.stats()["success"]
            self.plans[i] = np.array(found["x"]).ravel()
            given.append(self.plans[i][self.cut])
        return np.array(given)[:, None]


def agent_of(own: CoDesignProblem, law, seed: int):
    """Networks that imitate a law on the states of its own runs, widened."""
    rng = np.random.default_rng(seed)
    designs = own.design.latin_hypercube(64, rng)
    states, inputs, values = [], [], []
    for p in designs:
        run = Scenario(own.model, np.zeros((4, 4)), 0.25 * rng.standard_normal((4, STEPS, 1))).run(law, design=p)
        x = run.states[:, :-1].reshape(-1, 4)
        states.append(np.hstack([x, np.tile(p, (len(x), 1))]))
        inputs.append(run.inputs.reshape(-1, 1))
        values.append(np.full(len(x), run.returns(own.objective).mean() / 2))
    return fit_actor_critic(
        np.concatenate(states), np.concatenate(inputs), np.concatenate(values), rng=rng,
        action_bounds=own.input_bounds, input_bounds=own.observation_bounds,
    )  # fmt: skip


def main() -> None:
    """Print a row for each law, and for each start and seed of learning."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--free", action="store_true", help="design the spring, too")
    parser.add_argument("--optimal-control", type=int, default=0, metavar="RUNS", help="runs of the plain program")
    parser.add_argument("--springs", nargs="+", type=float, default=np.linspace(1e4, 4e4, 7), help="its own grid, N/m")
    parser.add_argument("--starts", nargs="*", default=["clipped LQR", "skyhook", "nothing"])
    given = parser.parse_args()
    torch.set_num_threads(1)
    own = problem()
    w = own.scenarios.sample(RUNS, STEPS, np.random.default_rng(2026))[1]
    scenario = Scenario(own.model, np.zeros((RUNS, 4)), w)

    def returns(law, k=SPRING, runs=RUNS):
        return scenario.first(runs).run(law, design=[k]).returns(own.objective)

    best = minimize(lambda g: -returns(skyhook(g), runs=100).mean(), [2000.0, 500.0], method="Nelder-Mead",
                    options={"maxfev": 120, "initial_simplex": [[2000, 500], [4000, 500], [2000, 2000]]})  # fmt: skip
    passive = max((returns(lambda x, u=u: np.full((*x.shape[:-1], 1), u), runs=100).mean(), u)
                  for u in np.linspace(-1, 1, 41))[1]  # fmt: skip
    lqr = clipped_lqr(SPRING)
    reference = returns(lqr)

    plans: dict[float, np.ndarray] = {}  # returns of the plain program, by spring

    def planned(k):
        """Returns of the plain program with a spring."""
        if k not in plans:
            began, plan = time.process_time(), Predictive(own, k)
            plans[k] = returns(plan, k, given.optimal_control)
            each = (time.process_time() - began) / given.optimal_control / STEPS
            note = f"k_s = {k:.0f}, {1e3 * each:.2f} ms a sample, {plan.failed} not solved"
            row(f"plain program, {len(plans[k])} runs", plans[k], note)
        return plans[k]

    def row(name, values, note="") -> None:
        paired = values - reference[: len(values)]
        part = 100 / abs(reference[: len(values)].mean())
        gain, width = part * paired.mean(), 1.96 * part * paired.std() / len(paired) ** 0.5
        print(f"{name:32s} {values.mean():9.2f}  {gain:+6.2f} ± {width:.2f} %  {note}", flush=True)

    row("best constant damper", returns(lambda x: np.full((*x.shape[:-1], 1), passive)))
    row("skyhook and groundhook, tuned", returns(skyhook(best.x)), f"{best.x[0]:.0f}, {best.x[1]:.0f} N·s/m")
    row("clipped LQR", reference)
    springs = given.springs if given.free else [SPRING]
    best_spring = springs[0]
    if given.optimal_control and len(springs) > 1:
        coarse = [returns(Predictive(own, k), k, runs=8).mean() for k in springs]
        print("plain program, 8 runs:", ", ".join(f"{v:.2f} at {k:.0f}" for k, v in zip(springs, coarse)), flush=True)
        best_spring = float(springs[np.argmax(coarse)])
    if given.optimal_control:
        planned(best_spring)
    laws = {"clipped LQR": lqr, "skyhook": skyhook(best.x), "nothing": None}
    for name in given.starts:
        for seed in range(given.seeds):
            began = time.process_time()
            agent = None if laws[name] is None else agent_of(own, laws[name], seed)
            config = CoDesignConfig() if given.free else CoDesignConfig(design_rate=0.0)
            found = codesign(own, agent=agent, method="pathwise", rng=np.random.default_rng(seed), config=config,
                             design=[SPRING])  # fmt: skip
            values = returns(LearnedPolicy(found.agent, found.design), found.design[0])
            note = (
                f"k_s = {found.design[0]:.0f}, {found.status.name}, {time.process_time() - began:.0f} s, "
                f"{1e6 * min(repeat(lambda c=found.controller: c(X / 20), number=100, repeat=20)) / 100:.0f} µs a call"
            )
            springs = {best_spring, round(float(found.design[0]), -1)} if given.free else {best_spring}
            for k in sorted(springs) if given.optimal_control else ():
                theirs = planned(k)
                beside = 100 * (values[: len(theirs)] - theirs) / abs(theirs.mean())
                error = 1.96 * beside.std() / len(beside) ** 0.5
                note += f", beside the plain program at {k:.0f} {beside.mean():+.2f} ± {error:.2f} %"
            row(f"learned from {name}, seed {seed}", values, note)


if __name__ == "__main__":
    main()
