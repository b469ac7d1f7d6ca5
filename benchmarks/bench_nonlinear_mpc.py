"""Nonlinear MPC: one real-time iteration, and to the optimum, beside Ipopt and do-mpc, in the same closed loops.

    python benchmarks/bench_nonlinear_mpc.py [--repeats N] [--peer-python PATH]

The cart-pole (N = 30) and the nonlinear quarter car (N = 20) of the library, each from several starts, undisturbed, on
the sampled model itself: Runge–Kutta steps of 10 ms and 2.5 ms. Ipopt is multiple shooting in plain CasADi, expanded to
scalars, each solve begun at the shifted plan; do-mpc states the same discrete model and runs in its own environment,
whose Python is PATH.
The ratio is that of processor times, which other work on the machine changes less.
Required: a real-time iteration <= 1 ms with a cost within 1 % of the optimum's; to the optimum <= 1/3 of do-mpc's time.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

THREADS = {name: os.environ.setdefault(name, "1") for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS")}
ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

import casadi as ca  # noqa: E402
import numpy as np  # noqa: E402


@dataclass(frozen=True)
class Case:
    """A model at its design, weights, limits of inputs and states (infinite where there is none), and starts."""

    name: str
    step: Any
    Q: np.ndarray
    R: np.ndarray
    P: np.ndarray
    U: tuple[np.ndarray, np.ndarray]
    X: tuple[np.ndarray, np.ndarray]
    horizon: int
    samples: int
    starts: np.ndarray


def cases() -> list[Case]:
    """The two of the table."""
    from ccdtools import load_study

    cart = load_study("pendulum_on_cart")
    angles = [[0, 0, 0.5, 0], [0, 0, -0.3, 0], [1.0, 0, 0.2, 0], [0, 1, 0.4, -1]]
    car = load_study("quarter_car_nonlinear")
    bumps = [[0.02, 0, -0.03, 0], [0, 0.5, 0.05, 0.2], [-0.01, -0.5, 0, 0.5], [0.03, 0, 0, 0]]
    return [
        _case("cart-pole", cart, 2, 30, 100, np.array(angles, dtype=float)),
        _case("quarter car", car, 4, 20, 60, np.array(bumps, dtype=float)),
    ]


def _case(name: str, study: Any, substeps: int, horizon: int, samples: int, starts: np.ndarray) -> Case:
    from ccdtools import discretise
    from ccdtools.co_design.design_controllers import nonlinear_mpc

    law = nonlinear_mpc(study.problem(), study.p0, horizon=horizon)
    model = discretise(replace(study.plant, substeps=substeps))
    x, u = ca.SX.sym("x", model.nx), ca.SX.sym("u", model.nu)
    step = ca.Function("step", [x, u], [model.step(x, u, 0, study.p0)], ["x", "u"], ["value"])
    low, high = law.linear.input_rows[1][law.inputs :] * -1, law.linear.input_rows[1][: law.inputs]
    bound = np.full((2, law.states), np.inf) * [[-1], [1]]
    for row, right in zip(*law.linear.state_rows):
        i = int(np.flatnonzero(row)[0])
        bound[int(row[i] > 0), i] = right / row[i]
    return Case(
        name, step, law.linear.Q, law.linear.R, law.linear.P, (low, high), (bound[0], bound[1]), horizon, samples,
        starts,
    )  # fmt: skip


def closed_loops(case: Case, controller: Any) -> tuple[float, list[list[float]]]:
    """Sum of the costs of all starts, and wall time and processor time of every sample [s]."""
    cost, times = 0.0, []
    for start in case.starts:
        controller.reset()
        x = start
        for _ in range(case.samples):
            began = time.perf_counter(), time.process_time()
            u = controller(x)
            times.append([time.perf_counter() - began[0], time.process_time() - began[1]])
            cost += x @ case.Q @ x + u @ case.R @ u
            x = np.asarray(case.step(x, u)).ravel()
    return cost, times


class Shooting:
    """Ipopt on multiple shooting, begun at the shifted plan."""

    def __init__(self, case: Case, solver: str = "ipopt") -> None:
        nx, nu, N = len(case.Q), len(case.R), case.horizon
        x, u, start = ca.MX.sym("x", nx, N + 1), ca.MX.sym("u", nu, N), ca.MX.sym("start", nx)
        cost = ca.bilin(case.P, x[:, -1], x[:, -1])
        for k in range(N):
            cost += ca.bilin(case.Q, x[:, k], x[:, k]) + ca.bilin(case.R, u[:, k], u[:, k])
        gaps = ca.vertcat(x[:, 0] - start, ca.vec(x[:, 1:] - case.step.map(N)(x[:, :-1], u)))
        options = {"ipopt.print_level": 0, "print_time": False, "ipopt.sb": "yes", "ipopt.tol": 1e-8, "expand": True}
        nlp = {"x": ca.vertcat(ca.vec(x), ca.vec(u)), "p": start, "f": cost, "g": gaps}
        self._solver = ca.nlpsol("shooting", solver, nlp, options)
        free = np.full(nx, np.inf)
        self._low = np.r_[-free, np.tile(case.X[0], N), np.tile(case.U[0], N)]
        self._high = np.r_[free, np.tile(case.X[1], N), np.tile(case.U[1], N)]
        self._shape = nx, nu, N
        self.failed = 0
        self.reset()

    def reset(self) -> None:
        self._plan = np.zeros(len(self._low))
        self._first = True

    def plan(self, x: np.ndarray) -> float:
        """Cost of the plan from here, which becomes the plan to follow."""
        nx, _, N = self._shape
        if self._first:
            self._plan[: nx * (N + 1)] = np.tile(x, N + 1)
            self._first = False
        found = self._solver(x0=self._plan, p=x, lbx=self._low, ubx=self._high, lbg=0, ubg=0)
        self.failed += not self._solver.stats()["success"]
        self._plan = np.asarray(found["x"]).ravel()
        return float(found["f"])

    def __call__(self, x: np.ndarray) -> np.ndarray:
        nx, nu, N = self._shape
        self.plan(x)
        z = self._plan
        states, inputs = z[: nx * (N + 1)].reshape(-1, nx), z[nx * (N + 1) :].reshape(-1, nu)
        self._plan = np.r_[states[1:].ravel(), states[-1], inputs[1:].ravel(), inputs[-1]]
        return inputs[0]


def ours(case: Case, iterations: int | None) -> Any:
    """Our controller."""
    from mpc.optimal_control import NonlinearMPC

    limited = np.isfinite(np.vstack(case.X)).any()
    return NonlinearMPC(
        case.step, len(case.Q), len(case.R), Q=case.Q, R=case.R, P=case.P, horizon=case.horizon, U=case.U,
        X=case.X if limited else None, iterations=iterations,
    )  # fmt: skip


def peer_times(case: Case, python: str, repeats: int) -> tuple[float, list[list[float]]]:
    """Cost and times of do-mpc, in its own environment."""
    with tempfile.TemporaryDirectory() as folder:
        case.step.save(str(Path(folder) / "step.casadi"))
        statement = {
            name: np.asarray(getattr(case, name)).tolist() for name in ("Q", "R", "P", "U", "X", "starts")
        } | {"horizon": case.horizon, "samples": case.samples, "repeats": repeats}  # fmt: skip
        (Path(folder) / "case.json").write_text(json.dumps(statement))
        script = Path(__file__).with_name("do_mpc_peer.py")
        subprocess.run([python, str(script), folder], check=True, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        found = json.loads((Path(folder) / "found.json").read_text())
    return found["cost"], found["times"]


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--repeats", type=int, default=3, help="runs of every closed loop")
    parser.add_argument("--peer-python", help="Python of an environment with do-mpc")
    options = parser.parse_args()
    print(f"threads: {THREADS}, {os.cpu_count()} processors; CasADi {ca.__version__}; medians over all samples")
    head = f"{'median':>10s}{'99 %':>10s}{'processor':>12s}{'ratio':>8s}{'cost':>12s}{'above the optimum':>20s}"
    print(f"{'':40s}{head}")
    for case in cases():
        controllers = {
            "real-time iteration": ours(case, 1), "to the optimum": ours(case, None), "Ipopt": Shooting(case),
        }  # fmt: skip
        found = {name: ([], []) for name in controllers}
        for _ in range(options.repeats):
            for name, controller in controllers.items():
                cost, times = closed_loops(case, controller)
                found[name][0].append(cost)
                found[name][1].extend(times)
        rows = {name: (costs[-1], times) for name, (costs, times) in found.items()}
        if options.peer_python:
            rows["do-mpc"] = peer_times(case, options.peer_python, options.repeats)
        optimum, unit = rows["Ipopt"][0], np.median(rows["to the optimum"][1], axis=0)[1]
        for name, (cost, times) in rows.items():
            wall, processor = 1e3 * np.array(times).T
            title = f"{case.name}, N = {case.horizon}, {name}"
            print(
                f"{title:40s}{np.median(wall):7.2f} ms{np.quantile(wall, 0.99):7.2f} ms{np.median(processor):9.2f} ms"
                f"{np.median(processor) / (1e3 * unit):8.2f}{cost:12.6g}{100 * (cost / optimum - 1):18.4f} %"
            )
        if controllers["Ipopt"].failed:
            print(f"  Ipopt failed {controllers['Ipopt'].failed} times")


if __name__ == "__main__":
    main()
