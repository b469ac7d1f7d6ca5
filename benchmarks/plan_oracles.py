"""What is wrong with a plan of linear MPC: its fields, its status, its optimality.

The oracles are a linear program in states and inputs (HiGHS), the QP with the states kept (Clarabel), and the adjoint
of the cost.
"""

import clarabel
import numpy as np
from scipy import sparse
from scipy.optimize import linprog

from mpc import Status

FAR = 1e5  # states beyond this, relative to X and the start, are judged by the adjoint


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


def clarabel_solution(P, q, K, right, equations):
    """Clarabel's optimum of ½ z'Pz + q'z, of Kz <= right with equations first; None where it did not solve."""
    settings = clarabel.DefaultSettings()
    settings.verbose = False
    settings.tol_gap_abs = settings.tol_gap_rel = settings.tol_feas = 1e-10
    cones = [clarabel.ZeroConeT(equations), clarabel.NonnegativeConeT(len(right) - equations)]
    solution = clarabel.DefaultSolver(sparse.triu(P).tocsc(), q, K, right, cones, settings).solve()
    return solution if str(solution.status) == "Solved" else None


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
    unit = max(1.0, abs(x @ problem.P @ x))
    K = sparse.vstack([Aeq, G]).tocsc() @ D
    solution = clarabel_solution(D @ P @ D / unit, q * size / unit, K.tocsc(), np.concatenate([beq, g]), len(beq))
    if solution is None:
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
