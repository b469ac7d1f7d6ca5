"""Differential-algebraic plants beside IDAS at 1e-12, and whole-number inputs beside their relaxation.

    python benchmarks/dae.py             # simulations and whole-number inputs
    python benchmarks/dae.py --optimum   # the batch reactor's best temperature (Betts 2010, problem lwbr01)

A batch reactor of Caracotsios and Stewart (Computers & Chemical Engineering 9, 1985; four concentrations are algebraic,
rates from 1e-3 to 1e9), a pendulum in Cartesian coordinates whose rod force is algebraic, a distillation column of 20
trays whose temperatures are implicit. Each is simulated as a `Plant` and as a `Phase` of given inputs; the pendulum is
also swung up, in these coordinates and by its angle. What is stated is the largest difference of a state at the end of
a sample, relative to the largest value of that state.
"""

from __future__ import annotations

import sys
import time
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np

from ccdtools import DesignSpace, Plant, discretise
from mpc.optimal_control import OptimalControlProblem, Phase, Radau, build, refine, round_inputs, solve

TRAYS = 20


@dataclass(frozen=True)
class Case:
    """x' = f(x, z, u), 0 = g(x, z, u) with its start, guess of z, held inputs and times."""

    name: str
    f: Callable[..., Any]
    g: Callable[..., Any]
    x0: np.ndarray
    z0: Any
    inputs: np.ndarray
    dt: float
    intervals: int = 60

    def symbols(self) -> tuple[ca.SX, ca.SX, ca.SX]:
        """x, z and u."""
        nz = np.size(ca.DM(self.guess(self.x0)))
        return ca.SX.sym("x", len(self.x0)), ca.SX.sym("z", nz), ca.SX.sym("u", self.inputs.shape[1])

    def by_idas(self) -> np.ndarray:
        """States (N + 1, nx) by IDAS."""
        x, z, u = self.symbols()
        dae = {"x": x, "z": z, "p": u, "ode": ca.vertcat(*ca.vertsplit(self.f(x, z, u))), "alg": self.g(x, z, u)}
        options = {"abstol": 1e-14, "reltol": 1e-12, "max_num_steps": 10**6}
        step = ca.integrator("step", "idas", dae, 0.0, self.dt, options)
        states, guess = [self.x0], np.array(ca.DM(self.guess(self.x0))).ravel()
        for one in self.inputs:
            end = step(x0=states[-1], z0=guess, p=one)
            states.append(np.array(end["xf"]).ravel())
            guess = np.array(end["zf"]).ravel()
        return np.array(states)

    def guess(self, x: Any) -> Any:
        """Guess of z at a state."""
        return self.z0(x) if callable(self.z0) else self.z0

    def by_plant(self) -> np.ndarray:
        """States of the discretised plant."""
        x, z, u = self.symbols()
        plant = Plant(
            x, u, ca.SX(0, 1), ca.SX.sym("p"), self.f(x, z, u), DesignSpace(["p"], [0.0], [1.0]), dt=self.dt,
            z=z, algebraic=self.g(x, z, u), z_guess=self.guess(x),
        )  # fmt: skip
        model = discretise(plant, method="collocation", sampling_guard="ignore")
        states = [self.x0]
        for one in self.inputs:
            states.append(np.asarray(model.step(states[-1], one, [], [0.5])).ravel())
        return np.array(states)

    def by_phase(self, known: np.ndarray) -> tuple[np.ndarray, str]:
        """States of a phase a sample, from known ones (N + 1, nx) as guesses, and the statuses."""
        x, z, u = self.symbols()
        states, words = [self.x0], set()
        for one, first, last in zip(self.inputs, known, known[1:]):
            given, rates, balance = {"x": x, "z": z}, self.f(x, z, u), self.g(x, z, u)
            held = np.array(ca.DM(self.guess(last))).ravel()
            phase = Phase(
                ca.Function("f", list(given.values()), [ca.substitute(rates, u, ca.DM(one))], list(given), ["f"]),
                len(self.x0), 0, start=states[-1], duration=self.dt, algebraics=z.numel(), z_guess=held,
                algebraic=ca.Function("g", [x, z], [ca.substitute(balance, u, ca.DM(one))], ["x", "z"], ["g"]),
                guess=([0, 1], [first, last], np.zeros((2, 0))),
            )  # fmt: skip
            found = solve(build(phase, Radau(5), self.intervals // len(self.inputs)), tolerance=1e-11)
            states.append(found.x(self.dt))
            words.add(found.status.name)
        return np.array(states), ", ".join(sorted(words))


def reactor(unit: float = 1.0) -> Case:
    """Batch reactor; concentrations in `unit` of kg-mol/m³."""
    k1, k1r, k2, k3, k3r = 21.893, 2.14e9, 32.318, 21.893, 1.07e9
    K1, K2, K3 = 7.65e-18, 4.03e-11, 5.32e-18

    def acids(z: Any) -> Any:
        """Concentrations of H⁺, by its logarithm, and of three ions, of which two are in parts of 1e-12."""
        return ca.vertcat(ca.exp(z[0]), z[1], 1e-12 * z[2], 1e-12 * z[3])

    def rates(x: Any, z: Any, u: Any) -> Any:
        y, c = x / unit, acids(z)
        first = k1 * y[1] * y[5] - k1r * c[3]
        second, third = k2 * y[1] * c[1], k3 * y[3] * y[5] - k3r * c[2]
        return unit * ca.vertcat(-second, -first - second, second + third, -third, first, -first - third)

    def balance(x: Any, z: Any, u: Any) -> Any:
        y, c = x / unit, acids(z)
        return ca.vertcat(
            -0.0131 + y[5] + c[1] + c[2] + c[3] - c[0], c[1] - K2 * y[0] / (K2 + c[0]),
            1e12 * (c[2] - K3 * y[2] / (K3 + c[0])), 1e12 * (c[3] - K1 * y[4] / (K1 + c[0])),
        )  # fmt: skip

    def guess(x: Any) -> Any:
        """Positive root of H⁺ where two acids are left out: of the two roots the one that is a concentration."""
        y = x / unit
        half = (y[5] - 0.0131 - K2) / 2
        part = K2 * (y[0] + y[5] - 0.0131)
        root = ca.if_else(half < 0, part / (ca.sqrt(half**2 + part) - half), half + ca.sqrt(half**2 + part))
        ions = (K2 * y[0] / (K2 + root), 1e12 * K3 * y[2] / (K3 + root), 1e12 * K1 * y[4] / (K1 + root))
        return ca.vertcat(ca.log(root), *ions)

    start = unit * np.array([1.5776, 8.32, 0.0, 0.0, 0.0, 0.0131])
    return Case("batch reactor", rates, balance, start, guess, np.zeros((10, 0)), 0.1, 100)


def pendulum(length: float = 1.0, second: float = 1.0) -> Case:
    """Pendulum of a metre in `length` a metre and `second` a second; λ is the force of the rod."""
    g, rod = 9.81 * length / second**2, 1.0 * length

    def rates(x: Any, z: Any, u: Any) -> Any:
        push = u[0] * length / second**2
        return ca.vertcat(x[2], x[3], -z[0] * x[0] - push * x[1] / rod, -z[0] * x[1] + push * x[0] / rod - g)

    def rod_kept(x: Any, z: Any, u: Any) -> Any:
        return x[2] ** 2 + x[3] ** 2 - z[0] * rod**2 - g * x[1]

    start = np.array([np.sin(1.0), -np.cos(1.0), 0.0, 0.0]) * length
    inputs = np.sin(np.arange(20.0))[:, None]
    return Case("pendulum", rates, rod_kept, start, 1.0 / second**2, inputs, 0.1 * second, 100)


def column(unit: float = 1.0) -> Case:
    """Column of 20 trays, a reboiler and a condenser; temperatures in `unit` of K."""
    feed = 10

    def pressure(a: float, b: float, c: float, T: Any) -> Any:
        return ca.exp(a - b / (T / unit + c))  # Antoine's equation, in bar

    def light(T: Any) -> Any:
        return pressure(9.2806, 2788.51, -52.36, T)  # benzene

    def heavy(T: Any) -> Any:
        return pressure(9.3935, 3096.52, -53.67, T)  # toluene

    def rates(x: Any, z: Any, u: Any) -> Any:
        y = light(z) / 1.01325 * x
        reflux, boil = 1.5 + 0.2 * u[0], 2.0
        liquid = [reflux + (k >= feed) for k in range(TRAYS)]
        change = []
        for k in range(TRAYS):
            above = x[k - 1] if k else y[0]
            below = y[k + 1] if k < TRAYS - 1 else y[k]
            entering = liquid[k - 1] if k else reflux
            fed = 0.5 * (k == feed)
            flow = entering * above + boil * below - liquid[k] * x[k] - boil * y[k]
            change.append((flow + fed) / 0.5)
        return ca.vertcat(*change)

    def boils(x: Any, z: Any, u: Any) -> Any:
        return x * light(z) + (1 - x) * heavy(z) - 1.01325

    start = np.linspace(0.9, 0.1, TRAYS)
    inputs = np.sign(np.sin(np.arange(10.0)))[:, None]
    return Case("column", rates, boils, start, np.full(TRAYS, 365.0 * unit), inputs, 0.5, 100)


def difference(states: np.ndarray, reference: np.ndarray) -> float:
    """Largest difference of a state, relative to its largest value."""
    return float(np.max(np.abs(states - reference) / np.abs(reference).max(axis=0)))


def swung() -> tuple[float, float, str]:
    """Cost of a swing-up in Cartesian coordinates and by the angle, and the statuses."""
    case = pendulum()
    flat = Phase(
        lambda x, u, z: case.f(x, z, u), 4, 1, stage_cost=lambda u: u[0] ** 2, start=[0.0, -1.0, 0.0, 0.0],
        end=([0, 0.5, 0, -np.inf], [0, 1.5, 0, np.inf]), duration=2.0, u_bounds=(-9, 9),
        algebraic=lambda x, z: case.g(x, z, None), algebraics=1, z_guess=[9.81],
        guess=([0, 0.5, 1], [[0, -1, 0, 0], [1, 0, 0, 3], [0, 1, 0, 0]], [[1], [1], [1]]),
    )  # fmt: skip
    angle = Phase(
        lambda x, u: ca.vertcat(x[1], u[0] - 9.81 * ca.sin(x[0])), 2, 1, stage_cost=lambda u: u[0] ** 2,
        start=[0.0, 0.0], end=[np.pi, 0.0], duration=2.0, u_bounds=(-9, 9),
        guess=([0, 0.5, 1], [[0, 0], [-1, 0], [np.pi, 0]], [[0], [0], [0]]),
    )  # fmt: skip
    first, second = (refine(phase, Radau(5), intervals=40) for phase in (flat, angle))
    return first.cost, second.cost, f"{first.status.name}, {second.status.name}"


def relaxed() -> dict[str, tuple[Phase, bool]]:
    """Problems with whole-number inputs, and whether one of them is on at a time."""

    def fish(x: Any, u: Any) -> Any:
        return ca.vertcat(x[0] - x[0] * x[1] - 0.4 * x[0] * u, -x[1] + x[0] * x[1] - 0.2 * x[1] * u)

    def tanks(x: Any, u: Any) -> Any:
        return ca.vertcat(u[0] + 2 * u[1] - ca.sqrt(x[0]), ca.sqrt(x[0]) - ca.sqrt(x[1]))

    fishing = Phase(fish, 2, 1, stage_cost=lambda x: ca.sumsqr(x - 1), start=[0.5, 0.7], duration=12.0, u_bounds=(0, 1))
    pumped = Phase(
        tanks, 2, 2, stage_cost=lambda x: 2 * (x[1] - 3) ** 2, start=[2.0, 2.0], duration=10.0, u_bounds=(0, 1),
        path=lambda u: u[0] + u[1], path_bounds=(1.0, 1.0),
    )  # fmt: skip
    return {"Lotka–Volterra fishing": (fishing, False), "double tank": (pumped, True)}


def whole() -> None:
    """Print the table of whole-number inputs."""
    print("\n| problem | intervals | relaxed | whole | gap of an integral | its bound | status |")
    print("|---|---|---|---|---|---|---|")
    for name, (phase, one_of) in relaxed().items():
        best = refine(phase, Radau(3), intervals=40)
        for intervals in (50, 200, 800, 3200):
            rounded, held = round_inputs(solve(build(phase, Radau(3), intervals), start=best), one_of=one_of)
            costs = f"{best.cost:.6f} | {held.cost:.6f}"
            told = f"{rounded.gap:.2g} | {rounded.bound:.2g} | {held.status.name}"
            print(f"| {name} | {intervals} | {costs} | {told} |", flush=True)


ACID = 2.575e-16, 4.876e-14, 1.7884e-16  # constants of the three acids


def warm_rates(x: Any, T: Any, z: Any) -> Any:
    """Rates [1/h] of the batch reactor at a temperature [100 K]; z are ln H⁺ and ions in 1e-2, 1e-5, 1e-5."""
    k1, k2 = 1.3708e12 * ca.exp(-92.984 / T), 5.2282e12 * ca.exp(-95.999 / T)
    back = 1.6215e20 * ca.exp(-131.08 / T)
    first, second = k1 * x[1] * x[5] - back * 1e-5 * z[3], k2 * x[1] * 1e-2 * z[1]
    third = k1 * x[3] * x[5] - back / 2 * 1e-5 * z[2]
    return ca.vertcat(-second, -first - second, second + third, -third, first, -first - third)


def ions(x: Any, z: Any, catalyst: Any) -> Any:
    """Balance of charges, and three acids in equilibrium."""
    acid, (a, b, c) = ca.exp(z[0]), ACID
    charge = 1e2 * (catalyst - x[5] + acid - 1e-2 * z[1] - 1e-5 * (z[2] + z[3]))
    return ca.vertcat(charge, z[1] - 1e2 * b * x[0] / (b + acid), z[2] - 1e5 * c * x[2] / (c + acid),
                      z[3] - 1e5 * a * x[4] / (a + acid))  # fmt: skip


def optimum() -> None:
    """Print the least of batch time [h] and 100 · catalyst, beside the published one.

    The first quarter keeps y4 ≤ 2 t²; its first 36 s are a phase of their own. The guess is IDAS's trajectory at steady
    temperatures.
    """
    x, z, T, p = ca.SX.sym("x", 6), ca.SX.sym("z", 4), ca.SX.sym("T"), np.array([0.0142, 1.75])
    dae = {"x": x, "z": z, "p": T, "ode": warm_rates(x, T, z), "alg": ions(x, z, p[0])}
    options = {"abstol": 1e-10, "reltol": 1e-8, "calc_ic": False}
    state, acid = np.array([1.5776, 8.32, 0, 0, 0, p[0]]), np.sqrt(1.5776 * ACID[1])
    held = np.array([np.log(acid), 1e2 * acid, 0, 0])
    phases, way = [], np.linspace(0, 1, 41)
    done = np.where(np.arange(6) == 3, 1.0, -np.inf), np.full(6, np.inf)
    low, high = [0, 5, 0, 0, 0, 0], [2, 10, 2, 2, 2, 0.1]
    parts = [(0.01, 3.5, True), (p[1] / 4 - 0.01, 3.7, True), (3 * p[1] / 4, 3.93, False)]
    for i, (hours, warm, early) in enumerate(parts):

        def length(p: Any, i: int = i) -> Any:
            return (0.01, p[1] / 4 - 0.01, 3 * p[1] / 4)[i]

        def path(x: Any, u: Any, t: Any, p: Any, i: int = i, length: Any = length, early: bool = early) -> Any:
            clock = t * length(p) if i == 0 else 0.01 + (t - 1) * length(p)
            return ca.vertcat(*[x[3] - 2 * clock**2] * early, ions(x, u[1:], p[0]))

        states, known = [state], [held]
        for a, b in zip(way**2, way[1:] ** 2):
            step = ca.integrator("step", "idas", dae, 0.0, float((b - a) * hours), options)
            end = step(x0=state, z0=held, p=warm)
            state, held = (np.array(end[name]).ravel() for name in ("xf", "zf"))
            states.append(state)
            known.append(held)
        phases.append(Phase(
            lambda x, u, p, length=length: length(p) * warm_rates(x, u[0], u[1:]), 6, 5, algebraics=4, path=path,
            path_bounds=([-np.inf] * early + [0] * 4, [0] * (4 + early)), duration=1.0,
            u_bounds=([2.9315, -60, 0, 0, 0], [3.9315, 0, 2, 5, 5]), x_bounds=(low, high),
            guess=(way**2, states, np.column_stack([np.full(41, warm), known])),
            start=None if i else [1.5776, 8.32, 0, 0, 0, None], boundary=None if i else lambda x0, p: x0[5] - p[0],
            end=done if i == 2 else None,
        ))  # fmt: skip
    problem = OptimalControlProblem(phases, p_bounds=([0, 1], [0.0262, 10]), p_guess=p,
                                    p_cost=lambda p: p[1] + 100 * p[0])  # fmt: skip
    first = solve(build(problem, Radau(3), 10))
    print("| mesh | cost, of the published 3.16466910 | hours, of 1.7468208 | status | s |\n|---|---|---|---|---|")
    for name, run in {
        "refine, of the cost to 1e-6": lambda: refine(problem, Radau(5), tolerance=1e-6, of="cost", intervals=20),
        "Radau(5), 150 intervals a phase": lambda: solve(build(problem, Radau(5), 150), start=first),
        "refine, 150 s": lambda: refine(problem, Radau(3), intervals=20, start=first, time_limit=150),
    }.items():
        began = time.perf_counter()
        found = run()
        took = f"{time.perf_counter() - began:.0f}"
        cost, hours = found.cost / 3.16466910 - 1, found.p[1] / 1.7468208 - 1
        print(f"| {name} | {found.cost:.7f}, {cost:.1e} | {hours:.1e} | {found.status.name} | {took} |", flush=True)


def main() -> None:
    """Print the tables."""
    if sys.argv[1:] == ["--optimum"]:
        return optimum()
    warnings.simplefilter("ignore")
    print("| plant | as a Plant, from IDAS | as a Phase | status | s |")
    print("|---|---|---|---|---|")
    cases = [reactor(), pendulum(), column(), reactor(1e3), pendulum(1e3, 1e3), column(1e-2)]
    for case, units in zip(cases, ("", "", "", ", mol", ", mm and ms", ", hundreds of K")):
        began = time.perf_counter()
        reference = case.by_idas()
        by_plant = case.by_plant()
        plant = difference(by_plant, reference)
        states, status = case.by_phase(by_plant)
        took = time.perf_counter() - began
        print(
            f"| {case.name}{units} | {plant:.1e} | {difference(states, reference):.1e} | {status} | {took:.1f} |",
            flush=True,
        )
    flat, angle, status = swung()
    whole()
    print(f"\nswing-up: {flat:.8f} with the force of the rod, {angle:.8f} by the angle, {status}")


if __name__ == "__main__":
    main()
