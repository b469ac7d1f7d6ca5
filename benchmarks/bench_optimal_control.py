"""Time to state, build and solve classical problems on fixed meshes: here, by a plain CasADi script, and by packages.

The plain script is hand-written direct collocation as an experienced user writes it: a loop over the intervals, scalar
symbols, one call of Ipopt; the same scheme (Radau, degree 3), mesh, guess and Ipopt options. `--peer-python PATH` runs
rockit and dymos in an environment of their own; without it they are left out.

    python benchmarks/bench_optimal_control.py --table FOLDER [--row "far from rest"]  # every row asked of optimal
                                                                  # control and nonlinear MPC, by its script; --list
"""

from __future__ import annotations

import argparse
import ast
import inspect
import json
import os
import statistics
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests" / "cases"))

import casadi as ca
import numpy as np
from asked import Row, printed
from classical_problems import CLASSICAL

from mpc.optimal_control import Phase, Radau, build, solve
from mpc.optimal_control.interval import first_duration, first_guess

INTERVALS = 50
REPEATS = 5
DEGREE = 3
TOLERANCE = 1e-8
ROWS = (
    Row("statements", "200 random ones: plain Ipopt's optimum to 1e-6, from the same start and ten others; never "
        "SOLVED where infeasible", tuple(f"nmpc_statements.py --first 1000 --starts {starts}" for starts in (3, 6))),
    Row("far from rest", "loops: cost at most 1.005 of the better, median and 99 % no slower, 5 and 20 iterations",
        ("far_from_rest.py", "far_from_rest.py --first", "far_from_rest.py --limit 0.03",
         "nmpc_statements.py --loops", "nmpc_statements.py --kicks --first 94000 --count 36")),
    Row("real time", "pole on a cart, N = 30: 0.64 ms", ("bench_nonlinear_mpc.py",)),
    Row("starts", "five starts within 0.1 % of the best of 50, in 95 of 100 random problems", ("plan_starts.py",)),
    Row("discs", "no SOLVED that crosses by 1e-3 of a radius, 18 of 20 within 1 %", ("trajectory_verdicts.py 40 100",)),
    Row("estimation", "Kalman filter to 1e-8; published digits; intervals cover 95 ± 3 %",
        ("estimation_statements.py",)),
    Row("algebraic", "Betts' reactor, pendulum, column: 1e-6; whole-number inputs: their bound kept and stated",
        ("dae.py", "dae.py --optimum")),
    Row("published", "bioreactors and Zermelo 1e-4, the robot 1e-6, within 30 s each", ("classical_control.py",)),
    Row("growth", "linear in N and scenarios; a sample at N = 300 at most 15 times one at 20",
        ("growth_optimal_control.py", "growth_optimal_control.py --loops")),
    Row("plain script", "no row of the page worse beyond noise", ("bench_optimal_control.py",)),
)  # fmt: skip


def plain(phase: Phase, intervals: int) -> tuple[float, float, float, int]:
    """Seconds to build and to solve, cost and iterations of the plain script."""
    began = time.perf_counter()
    tau = [0.0, *ca.collocation_points(DEGREE, "radau")]
    C, _, B = ca.collocation_coeff(tau[1:])
    nx = phase.states
    first, free = first_guess(phase), phase.free_duration
    w: list[Any] = []
    w0: list[float] = []
    lbw: list[float] = []
    ubw: list[float] = []
    g: list[Any] = []
    lbg: list[float] = []
    ubg: list[float] = []

    def unknown(name: str, low: Any, high: Any, guess: Any) -> Any:
        symbol = ca.SX.sym(name, len(low))
        w.append(symbol)
        lbw.extend(low)
        ubw.extend(high)
        w0.extend(np.clip(guess, low, high))
        return symbol

    def called(function: Any, **given: Any) -> Any:
        names = inspect.signature(function).parameters
        return function(**{name: value for name, value in given.items() if name in names})

    T = unknown("T", phase.duration[:1], phase.duration[1:], [first_duration(phase)]) if free else phase.duration[0]
    h = T / intervals
    x0 = unknown("x", *phase.start, first(np.zeros(1))[0][0])
    x, J, t = x0, 0, 0
    for k in range(intervals):
        points, inputs = [], []
        for i in range(1, DEGREE + 1):
            at = (k + tau[i]) / intervals
            guess = first(np.array([at]))
            last = k == intervals - 1 and i == DEGREE
            points.append(unknown("x", *(phase.end if last else phase.x_bounds), guess[0][0]))
            inputs.append(unknown("u", *phase.u_bounds, guess[1][0]))
        slopes = ca.horzcat(x, *points) @ ca.DM(C)
        for i in range(DEGREE):
            given = {"x": points[i], "u": inputs[i], "t": t + h * tau[i + 1]}
            g.append(h * called(phase.dynamics, **given) - slopes[:, i])
            lbg.extend([0.0] * nx)
            ubg.extend([0.0] * nx)
            if phase.stage_cost is not None:
                J = J + h * float(ca.DM(B)[i]) * called(phase.stage_cost, **given)
            if phase.path is not None:
                value = called(phase.path, **given)
                g.append(value)
                lbg.extend([-np.inf] * value.numel())
                ubg.extend([0.0] * value.numel())
        x, t = points[-1], t + h
    if phase.terminal_cost is not None:
        J = J + called(phase.terminal_cost, x=x, t=T)
    if phase.boundary is not None:
        value = called(phase.boundary, x0=x0, x=x)
        g.append(value)
        lbg.extend([0.0] * value.numel())
        ubg.extend([0.0] * value.numel())
    options = {"ipopt": {"tol": TOLERANCE, "print_level": 0, "sb": "yes"}, "print_time": False}
    solver = ca.nlpsol("solver", "ipopt", {"x": ca.vertcat(*w), "f": J, "g": ca.vertcat(*g)}, options)
    built = time.perf_counter()
    result = solver(x0=w0, lbx=lbw, ubx=ubw, lbg=lbg, ubg=ubg)
    solved = time.perf_counter()
    return built - began, solved - built, float(result["f"]), int(solver.stats()["iter_count"])


def ours(phase: Phase, intervals: int) -> tuple[float, float, float, int]:
    """The same here: the solver and all derivatives are made within the first solve, and counted there."""
    began = time.perf_counter()
    program = build(phase, Radau(DEGREE), intervals)
    built = time.perf_counter()
    found = solve(program, tolerance=TOLERANCE)
    solved = time.perf_counter()
    return built - began, solved - built, found.cost, found.iterations


def median_of(run: Callable[[], tuple[float, float, float, int]]) -> tuple[float, float, float, int]:
    """Medians of the times, after one call that is not counted."""
    run()
    every = [run() for _ in range(REPEATS)]
    build_time, solve_time = (statistics.median(one[i] for one in every) for i in range(2))
    return build_time, solve_time, every[0][2], every[0][3]


def peers(python: str) -> dict[str, dict[str, Any]]:
    """What the packages take, in an environment of their own."""
    environment = os.environ | {"OMP_NUM_THREADS": "1", "OPENMDAO_REPORTS": "0"}
    script = Path(__file__).resolve().with_name("optimal_control_peers.py")
    ran = subprocess.run(
        [python, str(script), str(INTERVALS), str(REPEATS)], capture_output=True, text=True, env=environment,
        check=False,
    )  # fmt: skip
    if ran.returncode:
        raise SystemExit(f"the packages' script failed:\n{ran.stderr[-2000:]}")
    found: dict[str, dict[str, Any]] = json.loads(ran.stdout.strip().splitlines()[-1])
    return found


def lines_of_statements() -> dict[str, int]:
    """Lines of each `Phase(…)` in the tests' list of problems."""
    text = Path(inspect.getsourcefile(sys.modules["classical_problems"]) or "").read_text(encoding="utf-8")
    found = {}
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.Dict):
            for key, value in zip(node.keys, node.values):
                if isinstance(key, ast.Constant) and isinstance(value, ast.Call) and value.args:
                    phase = value.args[0]
                    found[str(key.value)] = (phase.end_lineno or 0) - phase.lineno + 1
    return found


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--peer-python", help="an interpreter with rockit-meco and dymos")
    parser.add_argument("--table", type=Path, help="every row that is asked, kept in this folder")
    parser.add_argument("--row", nargs="+", choices=[row.name for row in ROWS], default=[])
    parser.add_argument("--list", action="store_true", help="rows and their commands")
    arguments = parser.parse_args()
    if arguments.table or arguments.list:
        return printed(ROWS, arguments.table, arguments.row)
    print(f"{INTERVALS} intervals of Radau, degree {DEGREE}; medians of {REPEATS}; "
          f"OMP_NUM_THREADS={os.environ.get('OMP_NUM_THREADS', 'not set')}\n")  # fmt: skip
    print("| problem | build [ms] | solve | iterations | plain: build | solve | iterations | ratio of totals | apart |")
    print("|---|---|---|---|---|---|---|---|---|")
    totals, ratios = {}, []
    for name, case in CLASSICAL.items():
        phase = case.phase
        here = median_of(lambda phase=phase: ours(phase, INTERVALS))
        there = median_of(lambda phase=phase: plain(phase, INTERVALS))
        totals[name] = here[0] + here[1]
        ratios.append(totals[name] / (there[0] + there[1]))
        apart = abs(here[2] - there[2]) / abs(there[2])
        print(
            f"| {name} | {1e3 * here[0]:.0f} | {1e3 * here[1]:.0f} | {here[3]} | {1e3 * there[0]:.0f} "
            f"| {1e3 * there[1]:.0f} | {there[3]} | {ratios[-1]:.2f} | {apart:.0e} |",
            flush=True,
        )
    print(f"\nmedian ratio {statistics.median(ratios):.2f}, largest {max(ratios):.2f}\n")
    if arguments.peer_python:
        lines = lines_of_statements()
        print("| problem | package | total [ms] | of ours | cost | published | lines | ours |")
        print("|---|---|---|---|---|---|---|---|")
        for package, rows in peers(arguments.peer_python).items():
            for name, row in rows.items():
                took = "failed | | " if row["seconds"] is None else (
                    f"{1e3 * row['seconds']:.0f} | {row['seconds'] / totals[name]:.1f} | {row['cost']:.7g}"
                )  # fmt: skip
                print(f"| {name} | {package} | {took} | {CLASSICAL[name].cost:.7g} | {row['lines']} | {lines[name]} |")


if __name__ == "__main__":
    main()
