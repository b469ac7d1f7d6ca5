"""How time grows with states, intervals and scenarios: a chain of masses brought to rest by a force at its end.

`build` is that of the program, `derivatives` what the first solve makes, `iteration` the time of one iteration of a
second solve. The exponent is the slope of log(time) by log(size) over the larger half of the sizes.

    python benchmarks/growth_optimal_control.py --loops [NAME …]

Samples of nonlinear MPC by the horizon, processor time: construction, first sample, medians of twelve others, each the
least of three. Required: at most 15 times as long at N = 300 as at N = 20.
"""

from __future__ import annotations

import os
import statistics
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import replace

import casadi as ca
import numpy as np

from mpc.optimal_control import OptimalControlProblem, Phase, Radau, build, solve

REPEATS = 3
STATES = (2, 4, 8, 12, 20, 28, 40)
LOOPS = (20, 50, 100, 300)
INTERVALS = (10, 30, 100, 300, 1000)
SCENARIOS = (1, 3, 10, 30, 100, 200)


def chain(masses: int, push: float = 1.0) -> Phase:
    """Masses joined by springs that harden, the first to a wall, the last pushed."""

    def rates(x: ca.SX, u: ca.SX, p: ca.SX) -> ca.SX:
        place, speed = x[:masses], x[masses:]
        stretch = place - ca.vertcat(0, *(place[i] for i in range(masses - 1)))
        force = p[0] * stretch + stretch**3
        pull = ca.vertcat(*(force[i] for i in range(1, masses)), push * u) - force
        return ca.vertcat(speed, pull - 0.1 * speed)

    return Phase(
        dynamics=rates,
        states=2 * masses,
        inputs=1,
        stage_cost=lambda x, u: ca.sumsqr(x) + 0.1 * u**2,
        start=[0.1] * masses + [0.0] * masses,
        duration=5.0,
        u_bounds=(-1, 1),
    )


def problem_of(states: int = 4, scenarios: int = 1) -> OptimalControlProblem:
    """Scenarios that differ by the strength of the push and share the stiffness."""
    phases = [chain(states // 2, push) for push in np.linspace(0.8, 1.2, scenarios)]
    return OptimalControlProblem(phases, p_bounds=(0.5, 2.0), linked=False, p_cost=lambda p: (p[0] - 1) ** 2)


def times_of(problem: OptimalControlProblem, intervals: int) -> tuple[float, float, float, int]:
    """Seconds to build, to make derivatives, and an iteration; and iterations."""
    rows = []
    for _ in range(REPEATS):
        began = time.perf_counter()
        program = build(problem, Radau(3), intervals)
        built = time.perf_counter()
        first = solve(program)
        between = time.perf_counter()
        again = solve(program)
        end = time.perf_counter()
        assert first.solved_on_mesh
        rows.append((built - began, max(between - built - (end - between), 0.0), (end - between) / again.iterations))
    return (*(statistics.median(row[i] for row in rows) for i in range(3)), again.iterations)  # type: ignore[return-value]


def table(what: str, sizes: Sequence[int], run: Callable[[int], tuple[float, float, float, int]]) -> None:
    """Print the times of all sizes and their exponents."""
    print(f"| {what} | build [ms] | derivatives [ms] | an iteration [ms] | iterations |\n|---|---|---|---|---|")
    rows = []
    for size in sizes:
        rows.append(run(size))
        print("| " + " | ".join([str(size), *(f"{1e3 * t:.2f}" for t in rows[-1][:3]), str(rows[-1][3])]) + " |")
        sys.stdout.flush()
    upper = slice(len(sizes) // 2, None)
    at = np.log(np.asarray(sizes[upper], dtype=float))
    slopes = [np.polyfit(at, np.log(np.maximum([row[i] for row in rows[upper]], 1e-6)), 1)[0] for i in range(3)]
    print("| exponent | " + " | ".join(f"{slope:.2f}" for slope in slopes) + " | |\n")


def loops(names: Sequence[str]) -> None:
    """Print the table of nonlinear MPC."""
    from far_from_rest import FREE, case, cases, ours

    x, u = ca.SX.sym("x", 40), ca.SX.sym("u")
    of_masses = ca.Function("rates", [x, u], [chain(20).dynamics(x, u, ca.SX(1))])  # type: ignore[operator]
    masses = case("chain of 40 states", of_masses, 0.1, 1, [1.0] * 40, [0.1], [1], [FREE] * 40, 20, 30,
                  [[0.1] * 20 + [0.0] * 20])  # fmt: skip
    print("| plant | N | build | first | real-time iteration | to the optimum |\n|---|---|---|---|---|---|")
    for one in [*cases(), masses]:
        for horizon in LOOPS if not names or any(name in one.name for name in names) else ():
            row = []
            for iterations in (1, None):
                began = time.process_time()
                law = ours(replace(one, horizon=horizon), iterations)
                row += [time.process_time() - began]
                state, times = 0.3 * one.starts[0], []
                for k in range(13):
                    before, least = list(law._last), []
                    for _ in range(3 if k else 1):
                        law._last[:] = before
                        began = time.process_time()
                        moved = law(state)
                        least.append(time.process_time() - began)
                    times.append(min(least))
                    state = np.asarray(one.step(state, moved)).ravel()
                row += [times[0], statistics.median(times[1:])]
            told = " | ".join(f"{1e3 * row[i]:.4g}" for i in (0, 1, 2, 5))
            print(f"| {one.name} | {horizon} | {told} |", flush=True)


def main() -> None:
    """Print the tables."""
    if sys.argv[1:2] == ["--loops"]:
        return loops(sys.argv[2:])
    print(f"Radau of degree 3; medians of {REPEATS}; OMP_NUM_THREADS={os.environ.get('OMP_NUM_THREADS', 'not set')}\n")
    table("states, 50 intervals", STATES, lambda n: times_of(problem_of(states=n), 50))
    table("intervals, 4 states", INTERVALS, lambda n: times_of(problem_of(), n))
    table("scenarios, 4 states, 20 intervals", SCENARIOS, lambda n: times_of(problem_of(scenarios=n), 20))


if __name__ == "__main__":
    main()
