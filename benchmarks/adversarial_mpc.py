"""Online MPC under an adversary: random plants, unstable over long horizons, in any units; oracles beside it.

    python benchmarks/adversarial_mpc.py [plants] [crossed] [units] [outputs] [laws] [--count 400] [--seed 0]

Every plan is checked for what its fields promise (inputs in U and within the rate limit, states of the model,
violation and cost of the states returned), its status by a linear program in states and inputs (HiGHS), its optimality
by the same QP with the states kept (Clarabel), and where the plant runs away by the adjoint of the cost. `crossed` are
the plants with a cross weight. `outputs` weighs outputs y = Cx + Du with references, previews, blocks, rate limits and
soft limits, in random units, by all solvers, `laws` the explicit law; their oracle knows the outputs alone.
"""

from __future__ import annotations

import argparse
import os
import sys
import time
from collections import Counter
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")
sys.path[:0] = [str(Path(__file__).resolve().parents[1])]

import clarabel  # noqa: E402
import numpy as np  # noqa: E402
from scipy import sparse  # noqa: E402
from scipy.optimize import linprog  # noqa: E402

from mpc import InfeasibleError, InputError, LinearMPC, NotConvexError, NotStabilisableError, Status  # noqa: E402

FAR = 1e5  # states beyond this, relative to X and the start, are judged by the adjoint


class Box:
    """{|v| <= half}."""

    def __init__(self, half):
        half = np.asarray(half, dtype=float)
        self.A = np.vstack([np.eye(len(half)), -np.eye(len(half))])
        self.b = np.concatenate([half, half])


def random_case(rng):
    """(controller data, state, signals) of one random problem."""
    n, m = int(rng.integers(1, 7)), int(rng.integers(1, 4))
    N = int(rng.integers(5, 101))
    A = rng.normal(size=(n, n))
    if rng.random() < 0.3:
        A = np.triu(A)
    A *= rng.uniform(1.0, 1.5) / max(np.abs(np.linalg.eigvals(A)).max(), 1e-3)
    B = rng.normal(size=(n, m))
    if rng.random() < 0.2:
        B[rng.integers(n)] = 0.0
    data = {
        "A": A, "B": B, "Q": np.diag(10.0 ** rng.uniform(-2, 2, n)), "R": np.diag(10.0 ** rng.uniform(-2, 2, m)),
        "horizon": N, "U": Box(10.0 ** rng.uniform(-1, 1, m)),
    }  # fmt: skip
    if rng.random() < 0.6:
        data["X"] = Box(10.0 ** rng.uniform(0, 1.5, n))
    if rng.random() < 0.2:
        data["terminal_set"] = Box(10.0 ** rng.uniform(-1, 0.5, n))
    if rng.random() < 0.2:
        data["rate_limit"] = data["U"].b[:m] * rng.uniform(0.1, 1.5)
    if ("X" in data or "terminal_set" in data) and rng.random() < 0.25:
        data["soft"] = (float(rng.choice([0.0, 10.0, 1e4])), float(10.0 ** rng.uniform(0, 5)))
    x = rng.normal(size=n) * 10.0 ** rng.uniform(-3, 1.5)
    signals = {"u_prev": rng.uniform(-1, 1, m) * data["U"].b[:m]} if "rate_limit" in data else {}
    return data, x, signals


def crossed_case(rng):
    """The same with a cross weight: S = √Q Z √R with singular values of Z below one, a third of them at one."""
    data, x, signals = random_case(rng)
    Z = rng.normal(size=data["B"].shape)
    Z *= (1.0 if rng.random() < 0.3 else rng.uniform(0.0, 1.0)) / np.linalg.norm(Z, 2)
    data["S"] = np.sqrt(data["Q"]) @ Z @ np.sqrt(data["R"])
    return data, x, signals


def relative(problem, states):
    """Largest relative violation (N,) of each step."""
    units = problem.price_units
    H, h = problem.state_rows
    HT, hT = problem.terminal_rows
    along = np.max((states[1:] @ H.T - h) / units["state"], axis=1, initial=0.0)
    along[-1] = max(along[-1], np.max((HT @ states[-1] - hT) / units["terminal"], initial=0.0))
    return along


def cost_of(problem, inputs, states):
    """Cost, with the price of soft constraints."""
    cost = np.einsum("ki,ij,kj", states[:-1], problem.Q, states[:-1]) + np.einsum("ki,ij,kj", inputs, problem.R, inputs)
    cost += states[-1] @ problem.P @ states[-1]
    if problem.S is not None:
        cost += 2 * np.einsum("ki,ij,kj", states[:-1], problem.S, inputs)
    if problem.soft is not None:
        s = relative(problem, states)
        cost += problem.soft[0] * s.sum() + problem.soft[1] * s @ s
    return float(cost)


def promises(problem, plan, x, signals):
    """Names of the fields that do not say what the inputs and states do."""
    wrong = []
    H, h = problem.input_rows
    if not (np.isfinite(plan.inputs).all() and np.isfinite(plan.states).all()):
        return ["not finite"]
    if ((plan.inputs @ H.T - h) / h).max() > 1e-7:
        wrong.append("input outside U")
    if problem.rate_limit is not None:
        moves = np.diff(np.vstack([signals["u_prev"], plan.inputs]), axis=0)
        if (np.abs(moves) / problem.rate_limit).max() > 1 + 1e-6 and plan.status is not Status.INFEASIBLE:
            wrong.append("rate")
    terms = np.abs(plan.states[:-1]) @ np.abs(problem.A).T + np.abs(plan.inputs) @ np.abs(problem.B).T
    gap = np.abs(plan.states[1:] - plan.states[:-1] @ problem.A.T - plan.inputs @ problem.B.T)
    if (gap > 1e-8 * (terms.max(axis=1, keepdims=True) + np.abs(x).max())).any() or (plan.states[0] != x).any():
        wrong.append("states are not the model's")
    (HX, hX), (HT, hT) = problem.state_rows, problem.terminal_rows
    violation = max(np.max(plan.states[1:] @ HX.T - hX, initial=0.0), np.max(HT @ plan.states[-1] - hT, initial=0.0))
    if abs(plan.violation - violation) > 1e-9 * (1 + violation):
        wrong.append("violation")
    if (
        plan.status is not Status.INFEASIBLE
        and abs(plan.cost - cost_of(problem, plan.inputs, plan.states)) > 1e-6 * plan.cost + 1e-12 * x @ problem.Q @ x
    ):
        wrong.append("cost")
    if plan.status is Status.SOLVED and problem.soft is None and relative(problem, plan.states).max(initial=0.0) > 2e-6:
        wrong.append("solved outside X")
    if plan.status in (Status.SOLVED, Status.SOFTENED) and not plan.residuals.worst <= 1e-6:
        wrong.append("residuals")
    return wrong


def sparse_rows(problem, x, signals, N):
    """(Aeq, beq, G, g, step of each soft row or -1) of the first N steps in (x_1 … x_N, u_0 … u_{N-1})."""
    n, m = problem.nx, problem.nu
    eye = sparse.eye(N)
    Aeq = sparse.hstack(
        [sparse.kron(eye, np.eye(n)) - sparse.kron(sparse.eye(N, k=-1), problem.A), -sparse.kron(eye, problem.B)]
    )
    beq = np.concatenate([problem.A @ x, np.zeros((N - 1) * n)])
    units = problem.price_units
    (HU, hU), (HX, hX), (HT, hT) = problem.input_rows, problem.state_rows, problem.terminal_rows
    rows, right, soft = [], [], []

    def add(matrix, bounds, softness):
        rows.append(sparse.csr_matrix(matrix))
        right.append(bounds)
        soft.append(np.full(len(bounds), softness))

    scaled = HU / units["input"][:, None]
    add(
        sparse.hstack([sparse.csr_matrix((N * len(hU), N * n)), sparse.kron(eye, scaled)]),
        np.tile(hU / units["input"], N),
        -1,
    )
    if len(hX):
        scaled = HX / units["state"][:, None]
        add(
            sparse.hstack([sparse.kron(eye, scaled), sparse.csr_matrix((N * len(hX), N * m))]),
            np.tile(hX / units["state"], N),
            0,
        )
        soft[-1] = np.repeat(np.arange(N), len(hX))
    if len(hT) and problem.horizon == N:
        last = sparse.kron(sparse.eye(N).tocsr()[-1], HT / units["terminal"][:, None])
        add(sparse.hstack([last, sparse.csr_matrix((len(hT), N * m))]), hT / units["terminal"], N - 1)
    if problem.rate_limit is not None:
        D = sparse.kron(eye - sparse.eye(N, k=-1), np.diag(1 / problem.rate_limit))
        first = np.concatenate([signals["u_prev"] / problem.rate_limit, np.zeros((N - 1) * m)])
        for sign in (1, -1):
            add(sparse.hstack([sparse.csr_matrix((N * m, N * n)), sign * D]), 1 + sign * first, -1)
    return Aeq.tocsc(), beq, sparse.vstack(rows).tocsc(), np.concatenate(right), np.concatenate(soft)


def least_violation(problem, x, signals, N):
    """Least possible largest relative violation over the first N steps, by HiGHS; None where it failed."""
    Aeq, beq, G, g, soft = sparse_rows(problem, x, signals, N)
    column = -sparse.csc_matrix((soft >= 0).astype(float)[:, None])
    cost = np.zeros(Aeq.shape[1] + 1)
    cost[-1] = 1.0
    bounds = [(None, None)] * Aeq.shape[1] + [(0, None)]
    wide = sparse.hstack([Aeq, sparse.csc_matrix((len(beq), 1))])
    result = linprog(cost, A_ub=sparse.hstack([G, column]), b_ub=g, A_eq=wide, b_eq=beq,
                      bounds=bounds, options={"primal_feasibility_tolerance": 1e-9})  # fmt: skip
    return float(result.fun) if result.status == 0 else None


def reference(problem, x, signals):
    """(cost, inputs) of the QP with the states kept, by Clarabel on scaled variables; None where it did not solve."""
    N, n, m = problem.horizon, problem.nx, problem.nu
    Aeq, beq, G, g, soft = sparse_rows(problem, x, signals, N)
    weights = [problem.Q] * (N - 1) + [problem.P] + [problem.R] * N
    slack = N if problem.soft is not None else 0
    P = 2 * sparse.block_diag(weights + ([problem.soft[1] * np.eye(N)] if slack else [])).tocsc()
    q = np.concatenate([np.zeros(N * (n + m)), np.full(slack, problem.soft[0] if slack else 0.0)])
    if problem.S is not None:  # x_k stands at n (k - 1), so x_k with u_k one block above the diagonal
        S = sparse.kron(sparse.eye(N, k=1), 2 * problem.S)
        rest = sparse.csc_matrix((slack, slack))
        P = P + sparse.block_diag([sparse.bmat([[None, S], [S.T, None]]), rest]).tocsc()
        q[N * n : N * n + m] = 2 * problem.S.T @ x
    if slack:
        S = sparse.csc_matrix(
            (-np.ones((soft >= 0).sum()), (np.flatnonzero(soft >= 0), soft[soft >= 0])), shape=(len(g), N)
        )
        Aeq = sparse.hstack([Aeq, sparse.csc_matrix((len(beq), N))])
        G = sparse.vstack([sparse.hstack([G, S]), sparse.hstack([sparse.csc_matrix((N, N * (n + m))), -sparse.eye(N)])])
        g = np.concatenate([g, np.zeros(N)])
    size = np.concatenate([np.tile(problem.state_extent, N), np.tile(problem.input_extent, N), np.ones(slack)])
    D = sparse.diags(size)
    settings = clarabel.DefaultSettings()
    settings.verbose = False
    settings.tol_gap_abs = settings.tol_gap_rel = settings.tol_feas = 1e-10
    cones = [clarabel.ZeroConeT(len(beq)), clarabel.NonnegativeConeT(len(g))]
    unit = max(1.0, abs(x @ problem.P @ x))
    K = sparse.vstack([Aeq, G]).tocsc() @ D
    solver = clarabel.DefaultSolver(
        sparse.triu(D @ P @ D / unit).tocsc(), q * size / unit, K.tocsc(), np.concatenate([beq, g]), cones, settings
    )
    solution = solver.solve()
    if str(solution.status) != "Solved":
        return None
    v = np.array(solution.x) * size
    return float(solution.obj_val) * unit + float(x @ problem.Q @ x), v[N * n : N * (n + m)].reshape(N, m)


def adjoint_gap(problem, plan):
    """Largest step that an input would still take by its own gradient, in units of its limits; box U, no rate limit."""
    N = problem.horizon
    Q, R, P = (np.asarray(w, dtype=np.longdouble) for w in (problem.Q, problem.R, problem.P))
    A, B = np.asarray(problem.A, dtype=np.longdouble), np.asarray(problem.B, dtype=np.longdouble)
    S = np.zeros_like(B) if problem.S is None else np.asarray(problem.S, dtype=np.longdouble)
    e = problem.input_extent
    costate, worst = 2 * P @ plan.states[N], 0.0
    for k in reversed(range(N)):
        gradient = 2 * R @ plan.inputs[k] + 2 * S.T @ plan.states[k] + B.T @ costate
        rounding = 1e-10 * (np.abs(B).T @ np.abs(costate))
        gradient = np.sign(gradient) * np.maximum(np.abs(gradient) - rounding, 0.0)
        curvature = 2 * np.diag(R) + 2 * np.diag(B.T @ P @ B)
        wanted = np.clip(plan.inputs[k] - gradient / curvature, -e, e)
        worst = max(worst, float(np.abs((wanted - plan.inputs[k]) / e).max()))
        costate = 2 * Q @ plan.states[k] + 2 * S @ plan.inputs[k] + A.T @ costate
    return worst


def verdict(problem, plan, x, signals):
    """What is wrong with status and optimality; an empty list where nothing is, or where no oracle could tell."""
    hard = problem.soft is None and (len(problem.state_rows[1]) or len(problem.terminal_rows[1]))
    away = np.abs(plan.states / problem.state_extent).max() > FAR * max(1.0, np.abs(x / problem.state_extent).max())
    wrong = []
    if plan.status is Status.INACCURATE:
        wrong.append("INACCURATE, runs away" if away else "INACCURATE")
    if plan.status is Status.INFEASIBLE:
        wrong.append("INFEASIBLE")
    if plan.status is Status.SOFTENED:
        if not hard:
            wrong.append("SOFTENED without hard rows")
        else:
            whole = least_violation(problem, x, signals, problem.horizon)
            part = least_violation(problem, x, signals, min(10, problem.horizon))
            least = [t for t in (whole, part) if t is not None]
            if whole is not None and max(least) < 1e-8:
                wrong.append("SOFTENED though feasible")
            if (
                not away
                and least
                and relative(problem, plan.states).max() > 1.5 * max(least) * np.sqrt(problem.horizon) + 1e-4
            ):
                wrong.append("relaxed too much")
    if plan.status is Status.SOLVED:
        if away and not hard and problem.soft is None and problem.rate_limit is None:
            if adjoint_gap(problem, plan) > 1e-5:
                wrong.append("not optimal (adjoint)")
        elif not away:
            best = reference(problem, x, signals)
            if best is not None:
                zero = 1e-9 * x @ (problem.P + problem.Q) @ x  # with a cross weight P may be zero where Q is not
                if plan.cost > best[0] * (1 + 1e-5) + zero:
                    wrong.append("cost above the reference")
                if plan.cost < best[0] * (1 - 1e-5) - zero:
                    wrong.append("cost below the reference")
                if np.abs((plan.inputs[0] - best[1][0]) / problem.input_extent).max() > 1e-3:
                    wrong.append("first input")
    return wrong


def bench_crossed(count, seed):
    """Random unstable plants over long horizons, with a cross weight."""
    bench_plants(count, seed, crossed_case)


def bench_plants(count, seed, case=random_case):
    """Random unstable plants over long horizons."""
    statuses, faults, solvers, times = Counter(), Counter(), Counter(), []
    cases = 0
    for i in range(count):
        rng = np.random.default_rng([seed, i])
        data, x, signals = case(rng)
        try:
            controller = LinearMPC(**data)
        except (NotStabilisableError, NotConvexError, InputError) as error:
            faults[f"refused: {type(error).__name__}"] += 1
            continue
        cases += 1
        start = time.perf_counter()
        plan = controller.solve(x, **signals)
        times.append(time.perf_counter() - start)
        statuses[plan.status.name] += 1
        solvers[plan.solver] += 1
        for fault in promises(controller, plan, x, signals) + verdict(controller, plan, x, signals):
            faults[fault] += 1
            print(f"  case {i}: {fault}; {plan!r}; n={controller.nx} m={controller.nu} soft={controller.soft} "
                  f"rate={controller.rate_limit is not None} X={controller.X is not None} "
                  f"T={controller.terminal_set is not None} "
                  f"radius={np.abs(np.linalg.eigvals(controller.A)).max():.2f}", flush=True)  # fmt: skip
    print(f"\n| {cases} random plants, spectral radius 1.0 to 1.5, N = 5 to 100 | count |\n|---|---|")
    for name, number in [*statuses.items(), *((f"by {s}", c) for s, c in solvers.items()), *faults.items()]:
        print(f"| {name} | {number} |")
    print(f"| median, largest time of a first solve [ms] | {1e3 * np.median(times):.1f}, {1e3 * max(times):.0f} |")


class Scaled:
    """The same set in other units: v = units * v'."""

    def __init__(self, given, units):
        self.A = given.A * units
        self.b = given.b


def in_other_units(data, x, signals, units):
    """The same problem with states in sx, inputs in su and cost in c: (data, state, signals)."""
    sx, su, c = units  # x = sx * x', u = su * u', cost = c * cost'
    other = dict(data)
    other["A"] = data["A"] / sx[:, None] * sx
    other["B"] = data["B"] / sx[:, None] * su
    other["Q"] = data["Q"] * np.outer(sx, sx) / c
    other["R"] = data["R"] * np.outer(su, su) / c
    if "S" in data:
        other["S"] = data["S"] * np.outer(sx, su) / c
    for name, size in (("X", sx), ("terminal_set", sx), ("U", su)):
        if name in data:
            other[name] = Scaled(data[name], size)
    if "rate_limit" in data:
        other["rate_limit"] = data["rate_limit"] / su
    if "soft" in data:
        other["soft"] = tuple(np.array(data["soft"]) / c)
    return other, x / sx, {name: value / su for name, value in signals.items()}


def bench_units(count, seed):
    """The same problems in units 1e-8 … 1e8 of states and inputs and 1e-12 … 1e12 of the cost."""
    faults, compared = Counter(), 0
    for i in range(count):
        rng = np.random.default_rng([seed, 1, i])
        data, x, signals = random_case(rng)
        if rng.random() < 0.7:
            data["horizon"] = int(rng.integers(3, 16))
        x = x * 10.0 ** rng.uniform(0, 1)
        units = (
            10.0 ** rng.uniform(-8, 8, len(x)),
            10.0 ** rng.uniform(-8, 8, data["B"].shape[1]),
            10.0 ** rng.uniform(-12, 12),
        )
        try:
            base = LinearMPC(**data)
        except (NotStabilisableError, NotConvexError, InputError):
            continue
        plan = base.solve(x, **signals)
        other_data, other_x, other_signals = in_other_units(data, x, signals, units)
        compared += 1
        try:
            other = LinearMPC(**other_data).solve(other_x, **other_signals)
        except (NotStabilisableError, NotConvexError, InputError) as error:
            faults[f"refused in other units: {error}"] += 1
            continue
        gap = np.abs(other.inputs[0] * units[1] - plan.inputs[0]) / base.input_extent
        for fault, found in (("status", other.status is not plan.status), ("first input", gap.max() > 1e-4)):
            if found:
                faults[fault] += 1
                print(f"  case {i}: {fault}; {plan!r} and {other!r}; gap {gap.max():.1e} soft={base.soft}", flush=True)
    print(f"\n| {compared} random problems in other units | count |\n|---|---|")
    for name, number in faults.items():
        print(f"| {name} | {number} |")


def output_case(rng):
    """(controller data, outputs, state, signals): the cost is |C(x - x_ref) + D(u - u_ref)|² and |√ρ(u - u_ref)|²."""
    n, m, N = int(rng.integers(1, 6)), int(rng.integers(1, 4)), int(rng.integers(1, 31))
    A = rng.normal(size=(n, n))
    A *= rng.uniform(0.6, 1.4) / max(np.abs(np.linalg.eigvals(A)).max(), 1e-3)
    B = rng.normal(size=(n, m))
    ny = int(rng.integers(1, n + m + 1))
    weight = 10.0 ** rng.uniform(-1, 1, (ny, 1))
    C, D = weight * rng.normal(size=(ny, n)), weight * rng.normal(size=(ny, m))
    if rng.random() < 0.2:
        D[:, 0] = 0.0
    rho = 10.0 ** rng.uniform(-4, 0)
    C, D = np.vstack([C, np.zeros((m, n))]), np.vstack([D, np.sqrt(rho) * np.eye(m)])
    U = 10.0 ** rng.uniform(-1, 1, m)
    data = {"A": A, "B": B, "Q": C.T @ C, "R": D.T @ D, "S": C.T @ D, "horizon": N, "U": Box(U)}
    if rng.random() < 0.6:
        data["X"] = Box(10.0 ** rng.uniform(0.3, 1.5, n))
        if rng.random() < 0.4:
            data["soft"] = (float(rng.choice([0.0, 1.0, 100.0])), float(10.0 ** rng.uniform(0, 3)))
    signals = {}
    if rng.random() < 0.3:
        data["rate_limit"] = U * rng.uniform(0.2, 1.5)
        signals["u_prev"] = rng.uniform(-1, 1, m) * U
    if rng.random() < 0.3:
        data["blocks"] = tuple(np.diff([0, *np.flatnonzero(rng.random(N - 1) < 0.5) + 1, N]).tolist())
    if rng.random() < 0.4:
        data["E"] = rng.normal(size=(n, 2))
        signals["w"] = 0.1 * rng.normal(size=(N, 2))
    if rng.random() < 0.5:
        signals["x_ref"], signals["u_ref"] = rng.normal(size=(N + 1, n)), 0.5 * rng.normal(size=(N, m)) * U
    return data, (C, D), rng.normal(size=n) * 10.0 ** rng.uniform(-2, 0.5), signals


def output_cost(data, outputs, P, inputs, states, signals):
    """Cost of a plan, from its outputs."""
    C, D = outputs
    error, effort = states - signals.get("x_ref", 0.0), inputs - signals.get("u_ref", 0.0)
    cost = float(np.sum((error[:-1] @ C.T + effort @ D.T) ** 2) + error[-1] @ P @ error[-1])
    if "soft" in data:
        s = np.maximum((states[1:] @ data["X"].A.T / data["X"].b - 1).max(axis=1), 0.0)
        cost += data["soft"][0] * s.sum() + data["soft"][1] * s @ s
    return cost


def output_plan(data, outputs, P, x, signals):
    """Inputs and states of least cost, by Clarabel in outputs, states, inputs and slacks; None where it fails."""
    (C, D), A, B, N = outputs, data["A"], data["B"], data["horizon"]
    n, m, ny = len(A), B.shape[1], len(C)
    eye = sparse.eye(N)
    sizes = {"y": N * ny, "x": (N + 1) * n, "u": N * m, "s": N if "soft" in data else 0}
    ends = np.cumsum([0, *sizes.values()])
    at = {name: slice(a, b) for name, a, b in zip(sizes, ends[:-1], ends[1:])}

    def rows(**parts):
        height = next(iter(parts.values())).shape[0]
        return sparse.hstack([parts.get(name, sparse.csc_matrix((height, k))) for name, k in sizes.items()])

    first = sparse.eye(N, N + 1)
    x_ref, u_ref = signals.get("x_ref", np.zeros((N + 1, n))), signals.get("u_ref", np.zeros((N, m)))
    push = (signals["w"] @ data["E"].T).ravel() if "w" in signals else np.zeros(N * n)
    equal = [
        (rows(y=sparse.eye(N * ny), x=-sparse.kron(first, C), u=-sparse.kron(eye, D)),
         -(x_ref[:-1] @ C.T + u_ref @ D.T).ravel()),
        (rows(x=sparse.eye(n, (N + 1) * n)), x),
        (rows(x=sparse.kron(sparse.eye(N, N + 1, k=1), np.eye(n)) - sparse.kron(first, A), u=-sparse.kron(eye, B)),
         push),
    ]  # fmt: skip
    if "blocks" in data:
        starts = np.cumsum([0, *data["blocks"]])[:-1]
        held = np.setdiff1d(np.arange(N), starts)
        moves = sparse.kron((eye - sparse.eye(N, k=-1)).tocsr()[held], np.eye(m))
        equal.append((rows(u=moves), np.zeros(len(held) * m)))
    upper = [(rows(u=sparse.kron(eye, data["U"].A)), np.tile(data["U"].b, N))]
    if "rate_limit" in data:
        moves = rows(u=sparse.kron(eye - sparse.eye(N, k=-1), np.eye(m)))
        last = np.concatenate([signals["u_prev"], np.zeros((N - 1) * m)])
        upper += [(sign * moves, np.tile(data["rate_limit"], N) + sign * last) for sign in (1, -1)]
    if "X" in data:
        H, h = data["X"].A / data["X"].b[:, None], np.ones(2 * n)
        slack = {"s": -sparse.kron(eye, np.ones((2 * n, 1)))} if "soft" in data else {}
        upper.append((rows(x=sparse.kron(sparse.eye(N, N + 1, k=1), H), **slack), np.tile(h, N)))
    if "soft" in data:
        upper.append((rows(s=-eye), np.zeros(N)))
    weights = np.zeros(ends[-1])
    weights[at["y"]] = 2.0
    q = np.zeros(ends[-1])
    H = sparse.lil_matrix(sparse.diags(weights))
    end = slice(at["x"].stop - n, at["x"].stop)
    H[end, end] = 2 * P
    q[end] = -2 * P @ x_ref[-1]
    if "soft" in data:
        q[at["s"]] = data["soft"][0]
        H[at["s"], at["s"]] = 2 * data["soft"][1] * np.eye(N)
    K = sparse.vstack([part for part, _ in equal + upper]).tocsc()
    right = np.concatenate([b for _, b in equal + upper])
    count = sum(len(b) for _, b in equal)
    settings = clarabel.DefaultSettings()
    settings.verbose = False
    settings.tol_gap_abs = settings.tol_gap_rel = settings.tol_feas = 1e-10
    cones = [clarabel.ZeroConeT(count), clarabel.NonnegativeConeT(len(right) - count)]
    solution = clarabel.DefaultSolver(sparse.triu(H).tocsc(), q, K, right, cones, settings).solve()
    if str(solution.status) != "Solved":
        return None
    v = np.array(solution.x)
    return v[at["u"]].reshape(N, m), v[at["x"]].reshape(N + 1, n)


def signals_in_other_units(signals, sx, su):
    """The signals of `output_case` with x = sx * x' and u = su * u'."""
    size = {"u_prev": su, "x_ref": sx, "u_ref": su, "w": 1.0}
    return {name: value / size[name] for name, value in signals.items()}


def output_faults(data, outputs, x, signals, units, solver):
    """(status, names of what is wrong) of one problem of weighted outputs, stated in other units."""
    sx, su, c = units
    stated, x_stated, _ = in_other_units(data, x, {}, units)
    if "E" in data:
        stated["E"] = data["E"] / sx[:, None]
    controller = LinearMPC(**stated, solver=solver)
    plan = controller.solve(x_stated, **signals_in_other_units(signals, sx, su))
    P = controller.P * c / np.outer(sx, sx)
    inputs, states = plan.inputs * su, plan.states * sx
    found = output_cost(data, outputs, P, inputs, states, signals)
    best = output_plan(data, outputs, P, x, signals)
    wrong = []
    if abs(plan.cost * c - found) > 1e-7 * abs(found) + 1e-12:
        wrong.append("cost is not that of the outputs")
    if plan.status is Status.SOLVED and best is not None:
        least = output_cost(data, outputs, P, *best, signals)
        zero = 1e-8 * (1 + output_cost(data, outputs, P, 0 * inputs, 0 * states, signals) + x @ data["Q"] @ x)
        if abs(found - least) > 1e-5 * least + zero:
            wrong.append(f"cost {'above' if found > least else 'below'} the reference")
        if np.abs((inputs[0] - best[0][0]) / data["U"].b[: len(su)]).max() > 1e-3:
            wrong.append("first input")
    if plan.status is not Status.SOLVED and best is not None:
        wrong.append(f"{plan.status.name} though feasible")
    return plan.status, wrong


def bench_outputs(count, seed):
    """Weighted outputs with feedthrough, in units of 1e-4 … 1e4, by every solver."""
    faults, statuses = Counter(), Counter()
    for i in range(count):
        rng = np.random.default_rng([seed, 2, i])
        data, outputs, x, signals = output_case(rng)
        units = (10.0 ** rng.uniform(-4, 4, len(x)), 10.0 ** rng.uniform(-4, 4, data["B"].shape[1]),
                 10.0 ** rng.uniform(-4, 4))  # fmt: skip
        for solver in ("daqp", "osqp", "clarabel"):
            try:
                status, wrong = output_faults(data, outputs, x, signals, units, solver)
            except (NotStabilisableError, NotConvexError, InputError) as error:
                faults[f"refused: {str(error)[:90]}"] += 1
                continue
            statuses[f"{solver} {status.name}"] += 1
            for fault in wrong:
                faults[f"{solver}: {fault}"] += 1
                print(f"  case {i}: {solver}: {fault}; n={len(x)} m={len(units[1])} N={data['horizon']} "
                      f"{sorted(data.keys() - {'A', 'B', 'Q', 'R', 'S', 'U', 'horizon'})} {sorted(signals)}",
                      flush=True)  # fmt: skip
    print(f"\n| {count} random problems with weighted outputs | count |\n|---|---|")
    for name, number in [*statuses.items(), *faults.items()]:
        print(f"| {name} | {number} |")


def law_faults(rng):
    """(states compared, names of what is wrong) of one explicit law of weighted outputs; None where it is refused."""
    data, outputs, _, _ = output_case(rng)
    for name in ("E", "blocks", "rate_limit", "soft"):
        data.pop(name, None)
    n, m = data["B"].shape
    data["horizon"] = min(data["horizon"], 4)
    data.setdefault("X", Box(10.0 ** rng.uniform(0.3, 1.0, n)))
    sx, su = 10.0 ** rng.uniform(-4, 4, n), 10.0 ** rng.uniform(-4, 4, m)
    stated, _, _ = in_other_units(data, np.zeros(n), {}, (sx, su, 10.0 ** rng.uniform(-4, 4)))
    try:
        controller = LinearMPC(**stated)
        law = controller.explicit(time_limit=5.0)
    except (NotStabilisableError, NotConvexError, InputError, InfeasibleError):
        return None
    if law.status.name != "COMPLETE":
        return 0, [law.status.name]
    P = LinearMPC(**data).P
    compared, wrong = 0, []
    for x in rng.uniform(-1, 1, (10, n)) * data["X"].b[:n]:
        best = output_plan(data, outputs, P, x, {})
        u, outside = law.evaluate((x / sx)[None])
        if best is None or outside[0]:
            wrong += ["outside though feasible"] * (best is not None)
            continue
        compared += 1
        if np.abs((u[0] * su - best[0][0]) / data["U"].b[:m]).max() > 1e-4:
            wrong.append("law is not the plan")
    return compared, wrong


def bench_laws(count, seed):
    """Explicit laws of weighted outputs, in units of 1e-4 … 1e4, against the plan of the oracle."""
    faults, compared = Counter(), 0
    for i in range(count):
        found = law_faults(np.random.default_rng([seed, 3, i]))
        if found is None:
            faults["refused"] += 1
            continue
        compared += found[0]
        for fault in found[1]:
            faults[fault] += 1
            print(f"  case {i}: {fault}", flush=True)
    print(f"\n| {count} explicit laws of weighted outputs, {compared} states | count |\n|---|---|")
    for name, number in faults.items():
        print(f"| {name} | {number} |")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("parts", nargs="*", default=["plants"])
    parser.add_argument("--count", type=int, default=400)
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    for part in options.parts:
        globals()[f"bench_{part}"](options.count, options.seed)
