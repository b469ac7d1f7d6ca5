"""do-mpc in whole loops of `far_from_rest.py`, in turns with ours: ``python do_mpc_far_from_rest.py FOLDER [NAME …]``.

FOLDER holds do-mpc (`pip install --target FOLDER --no-deps do-mpc`), which then shares this CasADi. It gets the same
sampled model, horizon, cost and limits, Ipopt to 1e-8, and begins at the state held, then at its plan of the sample
before, as it does by itself. Processor times in ms, those of first samples apart; every loop is run twice, in turns.
"""

from __future__ import annotations

import sys
import warnings
from dataclasses import replace
from typing import Any

import casadi as ca
import numpy as np
from bench_nonlinear_mpc import Case, closed_loops, ours
from far_from_rest import cases

TURNS = 2


class DoMPC:
    """Controller of do-mpc for a case."""

    def __init__(self, case: Case) -> None:
        import do_mpc

        model = do_mpc.model.Model("discrete", "SX")
        x, u = model.set_variable("_x", "x", (len(case.Q), 1)), model.set_variable("_u", "u", (len(case.R), 1))
        model.set_rhs("x", case.step(x, u))
        model.setup()
        self._mpc = mpc = do_mpc.controller.MPC(model)
        mpc.settings.n_horizon, mpc.settings.n_robust, mpc.settings.t_step = case.horizon, 0, 1.0
        mpc.settings.state_discretization, mpc.settings.store_full_solution = "discrete", False
        mpc.settings.nlpsol_opts = {
            "ipopt.print_level": 0, "ipopt.sb": "yes", "print_time": False, "ipopt.tol": 1e-8
        }  # fmt: skip
        mpc.set_objective(lterm=x.T @ case.Q @ x + u.T @ case.R @ u, mterm=x.T @ case.P @ x)
        mpc.set_rterm(u=np.zeros((len(case.R), 1)))
        mpc.bounds["lower", "_u", "u"], mpc.bounds["upper", "_u", "u"] = case.U
        mpc.bounds["lower", "_x", "x"], mpc.bounds["upper", "_x", "x"] = case.X
        mpc.setup()
        self.failed = 0

    def reset(self) -> None:
        """Forget the plan."""
        self._mpc.reset_history()
        self._first = True

    def __call__(self, x: np.ndarray) -> Any:
        """First input of a plan."""
        if self._first:
            self._mpc.x0 = x
            self._mpc.set_initial_guess()
            self._first = False
        u = self._mpc.make_step(x.reshape(-1, 1)).ravel()
        self.failed += not self._mpc.solver_stats["success"]
        return u


def main(folder: str, names: list[str]) -> None:
    """Print costs and times."""
    sys.path.append(folder)
    warnings.simplefilter("ignore")
    import do_mpc

    print(f"do-mpc {do_mpc.__version__}, CasADi {ca.__version__}")
    for one in cases():
        if names and not any(name in one.name for name in names):
            continue
        controllers = {"do-mpc": DoMPC(one), "ours": ours(one, None)}
        costs, first, rest = ({name: [] for name in controllers} for _ in range(3))
        for _ in range(TURNS):
            for start in one.starts:
                for name, controller in controllers.items():
                    cost, times = closed_loops(replace(one, starts=start[None]), controller)
                    processor = 1e3 * np.array(times)[:, 1]
                    costs[name].append(cost)
                    first[name].append(processor[0])
                    rest[name].extend(processor[1:])
        for name in controllers:
            print(
                f"{one.name + ', ' + name:32s}cost {sum(costs[name]) / TURNS:12.6g}, "
                f"of do-mpc's {sum(costs[name]) / sum(costs['do-mpc']):.5f}; first {max(first[name]):.0f}, "
                f"median {np.median(rest[name]):.2f}, 99 % {np.quantile(rest[name], 0.99):.2f} ms",
                flush=True,
            )
        print(f"  do-mpc's solver failed {controllers['do-mpc'].failed} times", flush=True)


if __name__ == "__main__":
    main(sys.argv[1], sys.argv[2:])
