"""Random statements of nonlinear MPC by a `Phase`, six plants in random units."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import casadi as ca
import numpy as np

from mpc.optimal_control import NonlinearMPC, Phase


def rk4(rate: Any, x: Any, h: float, parts: int = 2) -> Any:
    """State after h."""
    h = h / parts
    for _ in range(parts):
        k1 = rate(x)
        k2 = rate(x + h / 2 * k1)
        k3 = rate(x + h / 2 * k2)
        x = x + h / 6 * (k1 + 2 * k2 + 2 * k3 + rate(x + h * k3))
    return x


def unicycle(x: Any, u: Any, w: Any) -> Any:
    """Position, heading; speed, turn; a current by w."""
    return rk4(lambda z: ca.vertcat(u[0] * ca.cos(z[2]) + 0.2 * w, u[0] * ca.sin(z[2]), u[1]), x, 0.2)


def point(x: Any, u: Any, w: Any) -> Any:
    """Position and speed in the plane with air resistance; w is a wind."""
    return rk4(lambda z: ca.vertcat(z[2], z[3], u[0] - 0.3 * z[2] * ca.sqrt(0.01 + z[2] ** 2) + 0.3 * w, u[1]), x, 0.2)


def tank(x: Any, u: Any, w: Any) -> Any:
    """Reactor of second order about a working point: concentration and temperature; w is a heat load."""

    def rate(z: Any) -> Any:
        burnt = 0.6 * (1 + 0.5 * z[0]) ** 2 * ca.exp(0.8 * z[1])
        return ca.vertcat(0.6 - burnt - 0.5 * z[0], burnt - 0.6 - z[1] + 0.8 * u[0] + 0.2 * w)

    return rk4(rate, x, 0.3)


def pendulum(x: Any, u: Any, w: Any) -> Any:
    """Angle from hanging and its rate; torque; w is a push."""
    return rk4(lambda z: ca.vertcat(z[1], -2 * ca.sin(z[0]) - 0.1 * z[1] + u[0] + 0.2 * w), x, 0.15)


def oscillator(x: Any, u: Any, w: Any) -> Any:
    """Van der Pol."""
    return rk4(lambda z: ca.vertcat(z[1], (1 - z[0] ** 2) * z[1] - z[0] + u[0] + 0.2 * w), x, 0.15)


def fish(x: Any, u: Any, w: Any) -> Any:
    """Predator and prey about their balance in logarithms; harvest of each; w is food."""
    return rk4(lambda z: ca.vertcat(1 - ca.exp(z[1]) + 0.3 * w - 0.5 * u[0], ca.exp(z[0]) - 1 - 0.5 * u[1]), x, 0.2)


PLANTS = {  # states that a start has, inputs, whether the first two states are a place
    unicycle: ([2.5, 2, 1.5], [1, 1.5], True), point: ([2.5, 2.5, 0.5, 0.5], [1.2, 1.2], True),
    tank: ([0.5, 0.5], [1.5], False), pendulum: ([2.0, 1.0], [1.5], False), oscillator: ([1.5, 1.5], [1.5], False),
    fish: ([0.6, 0.6], [0.8, 0.8], False),
}  # fmt: skip


@dataclass
class Statement:
    """Functions of x, u, w, p, t, u_prev in plain units, and the units that they are stated in."""

    plant: Any
    N: int
    x: np.ndarray
    size_x: np.ndarray
    size_u: np.ndarray
    unit: float  # of the cost
    w: np.ndarray  # (N + 1, 2): disturbance or parameter, and reference
    p: float
    kind: list[str] = field(default_factory=list)
    Q: Any = None
    R: Any = None
    economic: Any = None
    ball: float = 0.0
    end: Any = None
    terminal: float = 5.0
    obstacles: Any = ()
    soft: Any = None
    bound: Any = None
    moves: float = 0.0
    rate: Any = None
    power: float = 0.0

    def stage(self, x: Any, u: Any, w: Any, p: Any, last: Any) -> Any:
        """Cost of a stage."""
        target = ca.vertcat(w[1], ca.DM.zeros(x.numel() - 1))
        cost = ca.bilin(ca.DM(self.R), u) + self.moves * ca.sumsqr(u - last)
        if self.economic is not None:
            return cost + p * ca.dot(ca.DM(self.economic), x) + 0.3 * ca.sumsqr(x)
        return cost + p * ca.bilin(ca.DM(self.Q), x - target)

    def last(self, x: Any, w: Any, p: Any) -> Any:
        """Cost of the end."""
        return 0 if self.economic is not None else self.terminal * p * ca.bilin(ca.DM(self.Q), x) + 0 * w[0]

    def limits(self, x: Any, u: Any, t: Any) -> list[Any]:
        """Hard limits ≤ 0 besides bounds: discs that move, and a limit of x and u together."""
        found = [r**2 - (x[0] - cx - v * t) ** 2 - (x[1] - cy) ** 2 for cx, cy, r, v in self.obstacles]
        return [*found, *([u[0] * x[1] - self.power] if self.power else [])]

    def soft_value(self, x: Any) -> Any:
        """Soft limit ≤ 0."""
        return x[1] - self.soft[0]


def random_statement(seed: int, decades: int = 3) -> Statement:
    """Statement of a seed."""
    rng = np.random.default_rng(seed)
    plant = list(PLANTS)[seed % len(PLANTS)]
    about, limit, place = PLANTS[plant]
    nx, nu, N = len(about), len(limit), int(rng.integers(8, 31))
    x = rng.uniform(-1, 1, nx) * about
    w = np.zeros((N + 1, 2))
    size_x, size_u, unit = (10.0 ** rng.integers(-decades, decades + 1, count) for count in (nx, nu, 1))
    one = Statement(plant, N, x, size_x, size_u, float(unit[0]), w, float(rng.uniform(0.5, 2)))
    one.Q, one.R = np.diag(rng.uniform(0.2, 2, nx)), np.diag(rng.uniform(0.05, 0.5, nu))

    def some(name: str, chance: float) -> bool:
        if rng.random() < chance:
            one.kind.append(name)
            return True
        return False

    if some("p over horizon", 0.5):
        w[:, 0] = np.sin(np.arange(N + 1) * rng.uniform(0.2, 1) + rng.uniform(0, 6))
    if some("economic", 0.3):
        one.economic = rng.normal(size=nx)
    elif some("reference", 0.4):
        w[:, 1] = 0.5 * np.cos(np.arange(N + 1) * rng.uniform(0.1, 0.5))
    if place and some("obstacle", 0.7):
        discs = []
        for _ in range(rng.integers(1, 3)):
            radius, along = rng.uniform(0.2, 0.6), rng.uniform(0.3, 0.7)
            centre = along * x[:2] + rng.normal(size=2) * 0.2
            radius = min(radius, 0.7 * np.linalg.norm(centre - x[:2]))
            discs.append((*centre, radius, rng.choice([0.0, 0.02])))
        one.obstacles = discs
    if some("power", 0.2):
        one.power = float(max(rng.uniform(0.2, 1), 1e-3))
    if some("state bounds", 0.4):
        one.bound = np.maximum(np.abs(x), 0.3 * np.asarray(about)) * rng.uniform(1.02, 1.5)
    if some("soft", 0.4):
        one.soft = (float(rng.uniform(-0.3, 0.5)), float(rng.uniform(0, 5)), float(rng.uniform(0.1, 5)))
    if some("ball at end", 0.25):
        one.ball = float(rng.uniform(0.3, 1.0) * np.linalg.norm(about))
    elif some("end condition", 0.15):
        one.end = float(rng.uniform(-0.3, 0.3))
    if some("rate limit", 0.4):
        one.rate = rng.uniform(0.2, 0.8, nu) * limit
    if some("price of moves", 0.3):
        one.moves = float(rng.uniform(0.1, 2))
    return one


def law_of(one: Statement, starts: int) -> tuple[NonlinearMPC, dict[str, Any]]:
    """Controller of a statement in its units, and the signals of a sample."""
    sx, su, nx = ca.DM(one.size_x), ca.DM(one.size_u), len(one.x)
    limit = np.asarray(PLANTS[one.plant][1])
    carried = one.rate is not None or one.moves > 0

    def path(x: Any, u: Any, t: Any) -> Any:
        x, u = x / sx, u / su
        return ca.vertcat(*one.limits(x, u, t), *([] if one.soft is None else [one.soft_value(x)]))

    def cost(x: Any, u: Any, w: Any, p: Any) -> Any:
        return one.unit * one.stage(x / sx, u / su, w, p, 0)

    def cost_with_moves(x: Any, u: Any, w: Any, p: Any, u_prev: Any) -> Any:
        return one.unit * one.stage(x / sx, u / su, w, p, u_prev / su)

    hard = len(one.obstacles) + bool(one.power)
    prices = None
    if one.soft is not None:
        prices = tuple([*[None] * hard, one.unit * price] for price in one.soft[1:])
    stated: dict[str, Any] = {}
    if hard or one.soft is not None:
        stated |= {"path": path, "path_prices": prices}
    if one.ball:
        stated |= {"boundary": lambda x: ca.sumsqr(x / sx) - one.ball**2, "boundary_bounds": (-np.inf, 0)}
    if one.end is not None:
        stated |= {"boundary": lambda x: x[0] / sx[0] - one.end}
    if one.bound is not None:
        stated |= {"x_bounds": (-one.bound * one.size_x, one.bound * one.size_x)}
    phase = Phase(
        lambda x, u, w: sx * one.plant(x / sx, u / su, w[0]), nx, len(limit), discrete=True, duration=one.N,
        stage_cost=cost_with_moves if one.moves else cost,
        terminal_cost=lambda x, w, p: one.unit * one.last(x / sx, w, p),
        u_bounds=(-limit * one.size_u, limit * one.size_u), signal=one.w, **stated,
    )  # fmt: skip
    rate = None if one.rate is None else one.rate * one.size_u
    signals: dict[str, Any] = {"u_prev": np.zeros(len(limit))} if carried else {}
    if hard or one.soft is not None:
        signals["t"] = 0.0
    return NonlinearMPC(phase, p=[one.p], rate_limit=rate, starts=starts), signals
