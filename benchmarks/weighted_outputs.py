"""Random MPC with weighted outputs y = Cx + Du, and an oracle that knows the outputs alone."""

import numpy as np
from mpc_problems import REFUSED, Box, in_other_units
from plan_oracles import clarabel_solution
from scipy import sparse

from mpc import InfeasibleError, LinearMPC, Status


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
    solution = clarabel_solution(H, q, K, right, sum(len(b) for _, b in equal))
    if solution is None:
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
    except (*REFUSED, InfeasibleError):
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
