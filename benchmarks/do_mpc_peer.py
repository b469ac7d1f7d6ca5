"""do-mpc in the closed loops of `bench_nonlinear_mpc.py`, in its own environment: ``python do_mpc_peer.py FOLDER``."""

import json
import sys
import time
from pathlib import Path

import casadi as ca
import do_mpc
import numpy as np

folder = Path(sys.argv[1])
case = json.loads((folder / "case.json").read_text())
step = ca.Function.load(str(folder / "step.casadi"))
Q, R, P = (np.array(case[name]) for name in "QRP")

model = do_mpc.model.Model("discrete", "SX")
x = model.set_variable("_x", "x", (len(Q), 1))
u = model.set_variable("_u", "u", (len(R), 1))
model.set_rhs("x", step(x, u))
model.setup()

controller = do_mpc.controller.MPC(model)
controller.settings.n_horizon = case["horizon"]
controller.settings.n_robust = 0
controller.settings.t_step = 1.0
controller.settings.state_discretization = "discrete"
controller.settings.store_full_solution = False
controller.settings.nlpsol_opts = {
    "ipopt.print_level": 0, "ipopt.sb": "yes", "print_time": False, "ipopt.tol": 1e-8,
}  # fmt: skip
controller.set_objective(lterm=x.T @ Q @ x + u.T @ R @ u, mterm=x.T @ P @ x)
controller.set_rterm(u=np.zeros((len(R), 1)))
controller.bounds["lower", "_u", "u"], controller.bounds["upper", "_u", "u"] = (np.array(b) for b in case["U"])
controller.bounds["lower", "_x", "x"], controller.bounds["upper", "_x", "x"] = (np.array(b) for b in case["X"])
controller.setup()

cost, times = 0.0, []
for _ in range(case["repeats"]):
    cost = 0.0
    for start in case["starts"]:
        controller.reset_history()
        state = np.array(start)
        controller.x0 = state
        controller.set_initial_guess()
        for _ in range(case["samples"]):
            began = time.perf_counter(), time.process_time()
            action = controller.make_step(state.reshape(-1, 1)).ravel()
            times.append([time.perf_counter() - began[0], time.process_time() - began[1]])
            cost += state @ Q @ state + action @ R @ action
            state = np.asarray(step(state, action)).ravel()
(folder / "found.json").write_text(json.dumps({"cost": float(cost), "times": times}))
