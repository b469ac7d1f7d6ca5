"""Speed and accuracy of `mpc` beside its peers, in one run; peers that are not installed are named and left out.

    python benchmarks/bench_mpc.py [explicit first online states hard infeasible]

Peers: PPOPT (with cvxopt, for its LPs) for explicit laws; OSQP, Clarabel, CasADi and do-mpc online.
"""

from __future__ import annotations

import contextlib
import io
import os
import subprocess
import sys
import tempfile
import time
import warnings
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")
ROOT = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(ROOT), str(ROOT / "tests" / "cases")]

import numpy as np  # noqa: E402
from plants import box, double_integrator, suspension  # noqa: E402
from random_problems import feasible_state, hard_controller, random_plant  # noqa: E402

from mpc import LinearMPC, solve_mpqp  # noqa: E402
from mpc.dense_qp import DenseQP  # noqa: E402

MISSING: set[str] = set()


def peer(name):
    """Return the module, or None after noting that it is missing."""
    try:
        with contextlib.redirect_stdout(io.StringIO()), warnings.catch_warnings():
            warnings.simplefilter("ignore")
            return __import__(name, fromlist=["_"])
    except ImportError:
        MISSING.add(name.split(".")[0])
        return None


def best_time(function, budget=1.0, most=30):
    """Result and the least wall time [s] over repetitions within a budget; the least is what a busy machine spares."""
    best, start = np.inf, time.perf_counter()
    for _ in range(most):
        t = time.perf_counter()
        result = function()
        best = min(best, time.perf_counter() - t)
        if time.perf_counter() - start > budget:
            break
    return result, best


def integrator(N, R):
    A, B = double_integrator()
    return LinearMPC(A, B, Q=np.eye(2), R=[[R]], horizon=N, X=box([5, 5]), U=box([1]))


def illustrative(N):
    X = box([5, 2])
    X.b = np.array([5.0, 2.0, 10.0, 5.0])
    A, B = np.array([[0.8, 0.5], [0.5, 0.6]]), np.array([[0.5], [1.0]])
    return LinearMPC(A, B, Q=np.eye(2), R=[[0.1]], horizon=N, X=X, U=box([1]))


def scaled_suspension(N):
    A, B, _ = suspension()
    sx = np.array([0.25, 2.5, 0.5, 2.5])
    A, B = A * sx / sx[:, None], 1000 * B / sx[:, None]
    return LinearMPC(A, B, Q=np.eye(4), R=[[0.1]], horizon=N, X=box(np.ones(4)), U=box([1]))


# --- explicit laws ---------------------------------------------------------------------------------------------


def ppopt_runs(mpc):
    """(name, regions, seconds) of PPOPT's serial algorithms with the faster free solvers; set-up not counted."""
    if peer("ppopt") is None:
        return
    program = peer("ppopt.mpqp_program").MPQP_Program
    solver = peer("ppopt.solver").Solver
    solve = peer("ppopt.mp_solvers.solve_mpqp")
    lp = "glpk" if peer("cvxopt") else "gurobi"
    p = mpc.build()
    for algorithm in ("geometric", "graph", "combinatorial_graph"):  # geometric_parallel loses regions: not a peer
        options = {"lp": lp, "qp": "daqp", "milp": lp, "miqp": "daqp"}
        with contextlib.redirect_stdout(io.StringIO()), warnings.catch_warnings():
            warnings.simplefilter("ignore")
            task = program(p.G.copy(), p.w[:, None].copy(), p.f[:, None].copy(), p.F.copy(), p.H.copy(),
                           mpc.X.A.copy(), mpc.X.b[:, None].copy(), p.S.copy(), solver=solver(options))  # fmt: skip
            chosen = getattr(solve.mpqp_algorithm, algorithm)
            solution, seconds = best_time(lambda task=task, chosen=chosen: solve.solve_mpqp(task, chosen), 1.0, 5)
        yield algorithm, len(solution.critical_regions), seconds


def bench_explicit():
    solve_mpqp(integrator(2, 0.1).build(), box([5, 5]))  # compiles
    problems = [(f"double integrator R={R} N={N}", integrator(N, R)) for R in (0.1, 1.0) for N in (2, 3, 5, 10, 15, 20)]
    problems += [(f"illustrative N={N}", illustrative(N)) for N in (5, 10)]
    problems += [(f"suspension N={N}", scaled_suspension(N)) for N in (3, 5, 8)]
    print("| solve_mpqp | regions | ms | PPOPT's best, correct serial | ms | ratio |\n|---|---|---|---|---|---|")
    ratios = []
    for name, mpc in problems:
        qp = mpc.build()
        partition, ours = best_time(lambda qp=qp, mpc=mpc: solve_mpqp(qp, mpc.X))
        runs = list(ppopt_runs(mpc))
        correct = [run for run in runs if run[1] == len(partition)]
        wrong = ", ".join(f"{a} {n} regions" for a, n, _ in runs if n != len(partition))
        if correct:
            algorithm, _, theirs = min(correct, key=lambda run: run[2])
            ratios.append(theirs / ours)
            beside = f"{algorithm} | {1e3 * theirs:.1f} | {theirs / ours:.0f}"
        else:
            beside = "none | | "
        note = f" (not counted: {wrong})" if wrong else ""
        print(f"| {name} | {len(partition)} | {1e3 * ours:.2f} | {beside} |{note}", flush=True)
    if ratios:
        print(f"\nratio: median {np.median(ratios):.0f} (required >= 15), least {min(ratios):.0f} (required >= 6)")


def bench_first():
    """First call in a fresh process, without and with numba's cache on disk."""
    code = (
        "import sys, time; t = time.perf_counter(); sys.path[:0] = {paths!r}\n"
        "from bench_mpc import integrator\nfrom mpc import solve_mpqp\n"
        "m = integrator(5, 0.1); qp = m.build(); t0 = time.perf_counter(); solve_mpqp(qp, m.X)\n"
        "t1 = time.perf_counter(); m.explicit()(m.X.b[:2]); print(t1 - t0, time.perf_counter() - t1)"
    ).format(paths=[str(ROOT), str(ROOT / "benchmarks")])
    print("| first call | solve_mpqp, s | then explicit() and one evaluation, s |\n|---|---|---|")
    with tempfile.TemporaryDirectory() as cache:
        for label in ("no cache on disk", "cache on disk (required < 1 s)"):
            shown = subprocess.run([sys.executable, "-c", code], env=os.environ | {"NUMBA_CACHE_DIR": cache},
                                   check=True, capture_output=True, text=True).stdout.split()  # fmt: skip
            print(f"| {label} | {float(shown[-2]):.2f} | {float(shown[-1]):.2f} |")


# --- online ----------------------------------------------------------------------------------------------------


def scaled_step(mpc, E):
    """Suspension MPC in scaled units, sparse form: P, A, bounds as a function of x, and the scaling."""
    from scipy import sparse

    N, nx, nu = mpc.horizon, mpc.nx, mpc.nu
    sx, su = mpc.X.b[:nx], mpc.U.b[:nu]
    A, B = mpc.A * sx / sx[:, None], mpc.B * su / sx[:, None]
    Q, R, P = mpc.Q * np.outer(sx, sx), mpc.R * np.outer(su, su), mpc.P * np.outer(sx, sx)
    size = np.trace(Q)
    H = sparse.block_diag([sparse.kron(sparse.eye(N), Q), P, sparse.kron(sparse.eye(N), R)]) * (2 / size)
    shift = sparse.kron(sparse.eye(N + 1, k=-1), A)
    dynamics = sparse.hstack([sparse.eye((N + 1) * nx) - shift,
                              -sparse.kron(sparse.vstack([sparse.csc_matrix((1, N)), sparse.eye(N)]), B)])  # fmt: skip
    C = sparse.vstack([dynamics, sparse.eye((N + 1) * nx + N * nu)]).tocsc()
    free = np.full(nx, np.inf)
    upper = np.concatenate([np.zeros((N + 1) * nx), free, np.ones(N * nx + N * nu)])
    lower = np.concatenate([np.zeros((N + 1) * nx), -free, -np.ones(N * nx + N * nu)])

    def bounds(x):
        lower[:nx] = upper[:nx] = x / sx
        return lower, upper

    return sparse.triu(H).tocsc(), C, bounds, su


def closed_loop(step, mpc, E, steps=1000):
    """Times [s] and inputs along one noisy closed loop driven by our controller's inputs."""
    rng, x, times, inputs, states = np.random.default_rng(0), np.array([-0.1, -1.0, -0.1, -0.5]), [], [], []
    for _ in range(steps):
        start = time.perf_counter()
        u = step(x)
        times.append(time.perf_counter() - start)
        inputs.append(u)
        states.append(x)
        x = mpc.A @ x + mpc.B @ mpc(x) + E[:, 0] * 0.3 * rng.normal()
    return np.array(times), np.array(inputs).reshape(steps), np.array(states)


def osqp_step(mpc, E, eps):
    osqp = peer("osqp")
    if osqp is None:
        return None
    P, C, bounds, su = scaled_step(mpc, E)
    solver = osqp.OSQP()
    lower, upper = bounds(np.zeros(4))
    solver.setup(P, np.zeros(P.shape[0]), C, lower, upper, verbose=False, eps_abs=eps, eps_rel=eps, max_iter=20_000)
    first = (mpc.horizon + 1) * mpc.nx

    def step(x):
        lower, upper = bounds(x)
        solver.update(l=lower, u=upper)
        return solver.solve(raise_error=False).x[first] * su[0]

    return step


def casadi_step(mpc):
    casadi = peer("casadi")
    if casadi is None:
        return None
    qp = mpc.build()
    scale = 1 / np.sqrt(np.diag(qp.H))
    H, G = casadi.DM(qp.H * np.outer(scale, scale)), casadi.DM(qp.G * scale)
    solver = casadi.conic("step", "qpoases", {"h": H.sparsity(), "a": G.sparsity()}, {"printLevel": "none"})

    def step(x):
        q, b = qp.at(x)
        result = solver(h=H, g=q * scale, a=G, lba=-np.inf, uba=b)
        return float(result["x"][0]) * scale[0]

    return step


def do_mpc_step(mpc):
    module = peer("do_mpc")
    if module is None:
        return None
    model = module.model.LinearModel("discrete")
    model.set_variable("_x", "x", (4, 1))
    model.set_variable("_u", "u")
    model.setup(mpc.A, mpc.B)
    controller = module.controller.MPC(model)
    controller.set_param(n_horizon=mpc.horizon, t_step=0.05, store_full_solution=False)
    controller.settings.supress_ipopt_output()
    x = model.x["x"]
    controller.set_objective(mterm=x.T @ mpc.P @ x, lterm=x.T @ mpc.Q @ x)
    controller.set_rterm(u=0.0)
    controller.bounds["lower", "_u", "u"], controller.bounds["upper", "_u", "u"] = -1000.0, 1000.0
    controller.bounds["lower", "_x", "x"], controller.bounds["upper", "_x", "x"] = -mpc.X.b[:4], mpc.X.b[:4]
    controller.setup()
    controller.x0 = np.zeros(4)
    controller.set_initial_guess()
    return lambda x: controller.make_step(x.reshape(-1, 1)).item()


def bench_online():
    A, B, E = suspension()
    data = dict(Q=np.diag([10.0, 1.0, 50.0, 5.0]), R=[[1e-6]], X=box([0.25, 2.5, 0.5, 2.5]), U=box([1000.0]))
    mpc = LinearMPC(A, B, horizon=20, **data)
    _, _, states = closed_loop(mpc, mpc, E)
    clarabel = DenseQP(mpc.build().H, mpc.build().G)
    tight = np.array([clarabel_input(mpc, clarabel, x) for x in states])
    contenders = {
        "LinearMPC, u = controller(x)": (LinearMPC(A, B, horizon=20, **data), 2000),
        "raw OSQP, sparse, scaled, warm, eps 1e-5": (osqp_step(mpc, E, 1e-5), 1000),
        "raw OSQP, sparse, scaled, warm, eps 1e-3 (its default)": (osqp_step(mpc, E, 1e-3), 1000),
        "CasADi conic (qpOASES), condensed, scaled": (casadi_step(mpc), 200),
        "do-mpc (its input cost is on increments: time only)": (quietly(lambda: do_mpc_step(mpc)), 50),
    }
    print("| online step, suspension, N = 20 | median ms | 99 % ms | largest error of the first input / u_max |")
    print("|---|---|---|---|")
    medians = {}
    for name, (step, steps) in contenders.items():
        if step is None:
            continue
        times, inputs, _ = quietly(lambda step=step, steps=steps: closed_loop(step, mpc, E, min(steps, 1000)))
        error = np.abs(inputs - tight[: len(inputs)]).max() / 1000 if "do-mpc" not in name else np.nan
        medians[name] = np.median(times)
        shown = f"{error:.1e}" if np.isfinite(error) else "not comparable"
        print(f"| {name} | {1e3 * np.median(times):.3f} | {1e3 * np.percentile(times, 99):.3f} | {shown} |", flush=True)
    raw = [t for name, t in medians.items() if "OSQP" in name]
    if raw:
        print(f"\nours / fastest raw OSQP: {next(iter(medians.values())) / min(raw):.2f} (required <= 2)")


def clarabel_input(mpc, solver, x):
    """First input by an interior-point method to 1e-11: the tight solve that the errors refer to."""
    qp = mpc.build() if not hasattr(solver, "qp") else solver.qp
    solver.qp = qp
    q, b = qp.at(x)
    z, _, _ = solver._clarabel(q * solver._d, b[solver._rows] * solver._r)
    return float(qp.inputs(z * solver._d, x)[0, 0])


def quietly(function):
    with contextlib.redirect_stdout(io.StringIO()), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return function()


# --- many states -----------------------------------------------------------------------------------------------

LOOP = """
#include <stdio.h>
#include <time.h>
#include "mpc.h"
static mpc_real theta[1000000][MPC_NT];
int main(void)
{
    mpc_real u[MPC_NU], sum = 0;
    FILE *in = fopen("in.bin", "rb");
    size_t n = fread(theta, sizeof theta[0], 1000000, in), i;
    double best = 1e9;
    for (int k = 0; k < 5; k++) {
        clock_t start = clock();
        for (i = 0; i < n; i++) { mpc_law(theta[i], u); sum += u[0]; }
        double ns = 1e9 * (double)(clock() - start) / CLOCKS_PER_SEC / (double)n;
        if (ns < best) best = ns;
    }
    printf("%.1f %g", best, (double)sum);
    return fclose(in);
}
"""


def bench_states():
    print("| 1e6 states | regions | Python, s (required < 1) | C tree, ns a state (required < 200) | C, written |")
    print("|---|---|---|---|---|")
    cases = (("double integrator N=20", integrator(20, 0.1)), ("suspension N=8", scaled_suspension(8)),
             ("random plant, 4 states, 2 inputs, N=4", random_plant(4)))  # fmt: skip
    for name, mpc in cases:
        law = mpc.explicit()
        X = law.partition.centre + law.partition.half * np.random.default_rng(0).uniform(-1, 1, (1_000_000, law.nt))
        law(X[:10])
        _, seconds = best_time(lambda law=law, X=X: law(X), 3.0, 5)
        with tempfile.TemporaryDirectory() as folder:
            report, nanoseconds = law.to_c(folder), "no compiler"
            X.tofile(Path(folder) / "in.bin")
            (Path(folder) / "loop.c").write_text(LOOP)
            with contextlib.suppress(FileNotFoundError):
                subprocess.run(["cc", "-std=c99", "-O2", "mpc.c", "loop.c", "-o", "loop"], cwd=folder, check=True)
                nanoseconds = subprocess.run(["./loop"], cwd=folder, check=True, capture_output=True, text=True).stdout
        print(f"| {name} | {len(law)} | {seconds:.2f} | {nanoseconds.split()[0]} | {report} |", flush=True)


# --- robustness ------------------------------------------------------------------------------------------------


def bench_hard():
    """500 random QPs, 50 badly scaled and 50 nearly degenerate; the peers get the same condensed QP at defaults."""
    counts = {"LinearMPC": 0, "OSQP": 0, "Clarabel": 0}
    worst, by_fallback = 0.0, 0
    kinds = ["plain"] * 400 + ["scaled"] * 50 + ["degenerate"] * 50
    for i, kind in enumerate(kinds):
        rng = np.random.default_rng([9, i])
        controller, sx = hard_controller(rng, kind)
        x, plan = feasible_state(rng, controller, sx)
        worst, by_fallback = max(worst, plan.residuals.worst), by_fallback + (plan.solver != "DAQP")
        counts["LinearMPC"] += plan.residuals.worst > 1e-6
        judge = DenseQP(controller.build().H, controller.build().G)
        for name, solve in (("OSQP", raw_osqp), ("Clarabel", raw_clarabel)):
            z, y = quietly(lambda solve=solve, c=controller, x=x: solve(c.build(), x))
            if z is None:
                counts.pop(name, None)
                continue
            q, b = controller.build().at(x)
            scaled = judge._residuals(z / judge._d, (y / judge._r)[judge._rows] if len(judge._rows) == len(y) else y,
                                      q * judge._d, b[judge._rows] * judge._r)  # fmt: skip
            counts[name] += not scaled.worst <= 1e-6
    print("| 500 random MPC QPs, a fifth badly scaled or nearly degenerate | relative KKT > 1e-6 |\n|---|---|")
    for name, count in counts.items():
        print(f"| {name}{' at default settings' if name != 'LinearMPC' else ''} | {count} |")
    print(
        f"\nlargest relative KKT residual of LinearMPC {worst:.1e} (required <= 1e-6), "
        f"{by_fallback} by the second solver"
    )


def raw_osqp(qp, x):
    osqp = peer("osqp")
    if osqp is None:
        return None, None
    from scipy import sparse

    q, b = qp.at(x)
    solver = osqp.OSQP()
    P, G = sparse.csc_matrix(np.triu(qp.H)), sparse.csc_matrix(qp.G)
    solver.setup(P, q, G, np.full(len(b), -np.inf), b, verbose=False)
    result = solver.solve(raise_error=False)
    return np.asarray(result.x), np.asarray(result.y)


def raw_clarabel(qp, x):
    clarabel = peer("clarabel")
    if clarabel is None:
        return None, None
    from scipy import sparse

    q, b = qp.at(x)
    settings = clarabel.DefaultSettings()
    settings.verbose = False
    cones = [clarabel.NonnegativeConeT(len(b))]
    P, G = sparse.csc_matrix(np.triu(qp.H)), sparse.csc_matrix(qp.G)
    result = clarabel.DefaultSolver(P, q, G, b, cones, settings).solve()
    return np.array(result.x), np.array(result.z)


def bench_infeasible():
    explained = cured = seed = 0
    times = []
    while explained < 200:
        controller, rng = random_plant(seed), np.random.default_rng(7000 + seed)
        seed += 1
        bad = [x for x in rng.uniform(-8, 8, size=(30, controller.nx)) if not controller.solve(x).feasible]
        for x in bad[: min(2, 200 - explained)]:
            start = time.perf_counter()
            why = controller.explain(x)
            times.append(time.perf_counter() - start)
            problem = controller.build().without(v.row for v in why.violations)
            cured += not DenseQP(problem.H, problem.G).solve(*problem.at(x)).infeasible
            explained += 1
    print("| infeasible problems | explained | feasible without the named constraints | median ms |\n|---|---|---|---|")
    print(f"| {explained} | {explained} | {cured} | {1e3 * np.median(times):.1f} |\n\nfor instance: {why}")


SECTIONS = {"explicit": bench_explicit, "first": bench_first, "online": bench_online, "states": bench_states,
            "hard": bench_hard, "infeasible": bench_infeasible}  # fmt: skip


def main():
    """Run the sections named on the command line, or all."""
    for name in sys.argv[1:] or SECTIONS:
        SECTIONS[name]()
        print(flush=True)
    print(f"peers not installed: {', '.join(sorted(MISSING)) or 'none'}")


if __name__ == "__main__":
    main()
