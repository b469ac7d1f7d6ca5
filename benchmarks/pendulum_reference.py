"""The pendulum on a cart, caught from 0.5 rad: the co-design on the nonlinear model against LQR and nonlinear MPC.

The reference is MPC of the nonlinear model, solved to convergence by Ipopt at every sample over 60 samples with the
cost of LQR at their end; it shares the model's equations alone with what is measured.

``python benchmarks/pendulum_reference.py [SEED ...]``: the learned policy minus saturated LQR of the linearisation at
the same design, paired on 2000 fresh runs (required: the interval excludes 0), and beside the reference on 20 of them
(required: within 3 %).
"""

from __future__ import annotations

import sys

import casadi as ca
import numpy as np
import torch

from ccdtools import CoDesignProblem, codesign, load_study, saturated_lqr, simulate
from ccdtools.co_design import expert_dataset
from ccdtools.statistics import paired_difference
from learning import fit_actor_critic
from mpc import lqr

HORIZON = 60
RUNS, FEW = 2000, 20


class NonlinearMPC:
    """u = controller(x) by multiple shooting of the model at one design; each solve starts from the last plan."""

    def __init__(self, problem: CoDesignProblem, design) -> None:
        model = problem.model
        weights = problem.weights(design)
        A, B, _ = model.matrices(design)
        _, P = lqr(A, B, **weights.keywords())
        nx, nu = model.nx, model.nu
        x = ca.MX.sym("x", nx, HORIZON + 1)
        u = ca.MX.sym("u", nu, HORIZON)
        start = ca.MX.sym("start", nx)
        step = model.step.map(HORIZON)
        after = step(x[:, :-1], u, ca.DM.zeros(model.nw, HORIZON), ca.repmat(ca.DM(np.asarray(design)), 1, HORIZON))
        cost = ca.bilin(P, x[:, -1], x[:, -1])
        for k in range(HORIZON):
            cost += ca.bilin(weights.R, u[:, k], u[:, k])
            if k > 0:
                cost += ca.bilin(weights.Q, x[:, k], x[:, k])
        gaps = ca.vertcat(x[:, 0] - start, ca.vec(x[:, 1:] - after))
        options = {"ipopt.print_level": 0, "print_time": False, "ipopt.tol": 1e-8, "ipopt.sb": "yes"}
        variables = ca.vertcat(ca.vec(x), ca.vec(u))
        self._solver = ca.nlpsol("mpc", "ipopt", {"x": variables, "p": start, "f": cost, "g": gaps}, options)
        self._split = nx * (HORIZON + 1)
        low, high = (np.tile(bound, HORIZON) for bound in problem.input_bounds)
        self._lower = np.r_[np.full(self._split, -np.inf), low]
        self._upper = np.r_[np.full(self._split, np.inf), high]
        self._nx, self._nu = nx, nu
        self._plan = np.zeros(len(self._lower))
        self.failed = 0

    def reset(self) -> None:
        """Forget the last plan."""
        self._plan = np.zeros(len(self._lower))

    def __call__(self, x: np.ndarray) -> np.ndarray:
        """The first input of the plan from a state (nx,)."""
        x = np.asarray(x).reshape(self._nx)
        found = self._solver(x0=self._plan, p=x, lbx=self._lower, ubx=self._upper, lbg=0, ubg=0)
        if not self._solver.stats()["success"]:
            raise RuntimeError(f"Ipopt: {self._solver.stats()['return_status']}")
        z = np.asarray(found["x"]).ravel()
        states = z[: self._split].reshape(-1, self._nx)
        inputs = z[self._split :].reshape(-1, self._nu)
        self._plan = np.r_[np.vstack([states[1:], states[-1:]]).ravel(), np.vstack([inputs[1:], inputs[-1:]]).ravel()]
        return inputs[0]


def referenced(problem: CoDesignProblem, design, x0: np.ndarray, w: np.ndarray) -> np.ndarray:
    """Returns of the reference, run by run."""
    law = NonlinearMPC(problem, design)
    step = problem.model.stepper(design, batch=1)
    returns = []
    for begin, disturbance in zip(x0, w):
        law.reset()
        x = begin[None]
        total = 0.0
        for k in range(len(disturbance)):
            u = law(x[0])[None]
            after = step(x, u, disturbance[None, k])
            total += float(problem.objective.rewards(after, u, x, np.asarray(design))[0])
            x = after
        returns.append(total)
    return np.array(returns)


def main(seeds: list[int]) -> None:
    """Print the table."""
    torch.set_num_threads(1)
    study = load_study("pendulum_on_cart")
    problem = study.problem()
    x0, w = problem.scenarios.sample(RUNS, problem.steps, np.random.default_rng(777))
    print("| seed | design | status | learned | LQR | difference, 95 % | 20 runs | nonlinear MPC | off |")
    print("|---|---|---|---|---|---|---|---|---|")
    for seed in seeds:
        rng = np.random.default_rng(seed)
        data = expert_dataset(problem, samples=study.samples, rng=rng)
        agent = fit_actor_critic(
            data.inputs, data.actions, data.values, action_bounds=problem.input_bounds,
            input_bounds=problem.observation_bounds, rng=rng,
        )  # fmt: skip
        found = codesign(problem, agent=agent, design=study.p0, rng=rng)
        design = found.design
        own, other = (
            simulate(problem.model, law, x0=x0, steps=problem.steps, disturbance=w, design=design, limit=problem.limit)
            .returns(problem.objective) for law in (found.policy, saturated_lqr(problem, design))
        )  # fmt: skip
        gain = paired_difference(own, other)
        best = referenced(problem, design, x0[:FEW], w[:FEW])
        off = (own[:FEW].mean() - best.mean()) / abs(best.mean())
        interval = f"{gain.mean:+.3f} [{gain.ci95[0]:+.3f}, {gain.ci95[1]:+.3f}]"
        print(f"| {seed} | {problem.design.describe(design)} | {found.status.name} | {own.mean():.3f} | "
              f"{other.mean():.3f} | {interval} | {own[:FEW].mean():.3f} | {best.mean():.3f} | {off:+.2%} |",
              flush=True)  # fmt: skip


if __name__ == "__main__":
    main([int(s) for s in sys.argv[1:]] or [0, 1, 2])
