"""Random problems of linear MPC, and the same problems in other units."""

import numpy as np

from mpc import InputError, NotConvexError, NotStabilisableError

REFUSED = (NotStabilisableError, NotConvexError, InputError)


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
