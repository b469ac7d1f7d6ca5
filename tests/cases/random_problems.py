"""Random plants and QPs, seeded, shared by the tests and the benchmark."""

from __future__ import annotations

import numpy as np
from plants import box

from mpc import Constraint, LinearMPC, NotStabilisableError, ParametricQP


def problem_of(H, F, f, G, w, S):
    """A parametric QP whose variables are the inputs."""
    nz, nt = F.shape
    return ParametricQP(
        H=H, F=F, f=f, Y=np.zeros((nt, nt)), y=np.zeros(nt), c=0.0, G=G, w=w, S=S, Lz=np.eye(nz),
        Lt=np.zeros((nz, nt)), l=np.zeros(nz), Xz=np.zeros((nt, nz)), Xt=np.eye(nt), x=np.zeros(nt), nu=nz,
        parameters=(("x", nt),), labels=tuple(Constraint("input", 0, i) for i in range(len(w))),
    )  # fmt: skip


def nearly_parallel_rows(seed, *, opposite=False):
    """Rows of -1, 0 and 1, often dependent; one of them again, 1e-6 away, and the sum of two; some nearly opposite."""
    rng = np.random.default_rng(seed)
    nz, nt, m = int(rng.integers(1, 6)), int(rng.integers(1, 4)), int(rng.integers(2, 14))
    L = rng.normal(size=(nz, nz))
    rows = rng.integers(-1, 2, size=(m, nz + nt + 1)).astype(float)
    rows[:, -1] = rng.integers(0, 3, size=m)
    again = rows[rng.integers(m)].copy()
    again[:nz] += 1e-6 * rng.normal(size=nz)
    rows = np.vstack([rows, again, rows[0] + again])
    if opposite:  # a slab, 1e-7 to 1e-1 thick
        other = -rows[rng.integers(m)] + 1e-6 * rng.normal(size=rows.shape[1])
        other[-1] += 10.0 ** rng.uniform(-7, -1)
        rows = np.vstack([rows, other])
    rows = rows[np.linalg.norm(rows[:, :nz], axis=1) > 1e-3]
    H = L @ L.T + 10.0 ** rng.uniform(-6, 0) * np.eye(nz)
    F, f = rng.normal(size=(nz, nt)), rng.normal(size=nz)
    return problem_of(H, F, f, rows[:, :nz], rows[:, -1], rows[:, nz:-1])


def closing_slab(seed):
    """Two rows opposite but for 1e-8 to 3e-6: with the parameter they close, and open only far along the variables.

    Two to four variables, one to three parameters, a few more rows, and mostly a box of 10 to 2000 about the variables.
    """
    rng = np.random.default_rng([seed, 5])
    nz, nt, m = int(rng.integers(2, 5)), int(rng.integers(1, 4)), int(rng.integers(0, 4))
    L = rng.normal(size=(nz, nz)) * (rng.random() < 0.6)
    F, f = rng.normal(size=(nz, nt)) * rng.integers(2), rng.normal(size=nz) * rng.integers(2)
    G, w, S = rng.normal(size=(m, nz)), rng.uniform(0.5, 2.0, m), rng.normal(size=(m, nt))
    if rng.random() < 0.7:
        G, S = np.vstack([G, np.eye(nz), -np.eye(nz)]), np.vstack([S, np.zeros((2 * nz, nt))])
        w = np.append(w, np.full(2 * nz, 10.0 ** rng.uniform(1.0, 3.3)))
    along = np.linalg.qr(rng.normal(size=(nz, nz)))[0]
    gap = 10.0 ** rng.uniform(-8.0, -5.5)
    close = gap * 10.0 ** rng.uniform(-1.0, 2.5)  # of the slab, for a parameter of one
    tilt, towards = rng.normal(size=nt) * rng.integers(2), rng.normal(size=nt)
    towards *= close / np.linalg.norm(towards)
    G = np.vstack([G, along[0], -along[0] - gap * along[1]])
    w = np.append(w, [close * rng.uniform(-0.7, 0.7), 0.0])
    return problem_of(L @ L.T + 0.5 * np.eye(nz), F, f, G, w, np.vstack([S, tilt + towards, -tilt]))


def random_plant(seed):
    """1 or 2 inputs, 2 to 4 states, stable or unstable, N = 2 … 5."""
    rng = np.random.default_rng(seed)
    nx, nu, N = (int(rng.integers(low, high)) for low, high in ((2, 5), (1, 3), (2, 6)))
    A = rng.normal(size=(nx, nx))
    A *= rng.uniform(0.7, 1.15) / np.abs(np.linalg.eigvals(A)).max()
    B = rng.normal(size=(nx, nu))
    return LinearMPC(A, B, Q=np.eye(nx), R=0.1 * np.eye(nu), horizon=N, X=box(5 * np.ones(nx)), U=box(np.ones(nu)))


def hard_controller(rng, kind):
    """A random controller: "plain", "scaled" (units spread over 1e-6 … 1e6) or "degenerate" (nearly)."""
    while True:
        nx, nu, N = int(rng.integers(2, 7)), int(rng.integers(1, 4)), int(rng.integers(3, 21))
        A = rng.normal(size=(nx, nx))
        A *= rng.uniform(0.6, 1.3) / np.abs(np.linalg.eigvals(A)).max()
        B, Q, R = rng.normal(size=(nx, nu)), np.eye(nx), np.eye(nu) * 10.0 ** rng.uniform(-3, 1)
        sx, su, cost = np.ones(nx), np.ones(nu), 1.0
        X, U = box(5 * np.ones(nx)), box(np.ones(nu))
        if kind == "scaled":
            sx, su, cost = 10.0 ** rng.uniform(-6, 6, nx), 10.0 ** rng.uniform(-6, 6, nu), 10.0 ** rng.uniform(-6, 6)
        if kind == "degenerate":
            R = R * 1e-7  # nearly singular
            twin = X.A * (1 + 1e-9 * rng.normal(size=X.A.shape))  # every state row nearly twice
            X.A, X.b = np.vstack([X.A, twin]), np.tile(X.b, 2)
        X.A, U.A = X.A / sx, U.A / su
        data = dict(Q=cost * Q / np.outer(sx, sx), R=cost * R / np.outer(su, su), horizon=N, X=X, U=U)
        try:
            return LinearMPC(A * sx[:, None] / sx, B * sx[:, None] / su, **data), sx
        except NotStabilisableError:
            continue


def feasible_state(rng, controller, sx):
    """A state of a feasible problem: the largest of a shrinking sequence, so many lie near the border."""
    x = sx * rng.uniform(-5, 5, size=len(sx))
    while not (plan := controller.solve(x)).feasible:
        x = 0.7 * x
    return x, plan
