"""Nested LQR beside dynamic programming on plants that look at rest like another plant than where the loop goes.

``python benchmarks/secant_linearisation.py`` designs the mass of four plants of two states (dry friction, a dead zone,
an input that counts by its square, a spring that stiffens) by `Nested("lqr")`, with the tangent alone and with the
secant where it is better. The oracle is dynamic programming on a grid of states, inputs and designs; it shares no code
with the package, nor does the simulator that all of them are measured by. A row says how far each lies above the
oracle, which one was taken, and whether the notes name both.
"""

from __future__ import annotations

import argparse
import time

import casadi as ca
import numpy as np
from scipy.ndimage import map_coordinates

import ccdtools as cc
from ccdtools import CoDesignProblem, Nested, codesign
from invariant_sets import Polytope

DT, STEPS, NOISE = 0.05, 100, 0.3
Q, R, PRICE = (1.0, 0.1), 0.1, 2.0
REACH, INPUT = (2.0, 4.0), 3.0  # of the grid, and of u
START = (1.0, 0.0)
FORCES = {
    "friction": lambda q, v, u, m: u - 0.5 * m.tanh(v / 0.03),
    "dead zone": lambda q, v, u, m: m.fmax(u - 0.3, 0) + m.fmin(u + 0.3, 0) - 0.2 * v,
    "u·abs(u)": lambda q, v, u, m: u * m.fabs(u) - 0.1 * v,
    "hardening spring": lambda q, v, u, m: u - q - 4 * q**3 - 0.1 * v,
}


def problem(kind: str) -> CoDesignProblem:
    """The problem of a plant; a light mass is dear."""
    x, u, w, p = ca.SX.sym("x", 2), ca.SX.sym("u"), ca.SX.sym("w"), ca.SX.sym("p")
    force = FORCES[kind](x[0], x[1], u, ca)
    plant = cc.Plant(x, u, w, p, ca.vertcat(x[1], (force + w) / p), cc.DesignSpace(["m"], [0.5], [2.0]), dt=DT)
    return CoDesignProblem(
        cc.discretise(plant, sampling_guard="ignore"), X=Polytope.from_bounds([-3, -6], [3, 6]),
        U=Polytope.from_bounds([-INPUT], [INPUT]), scenarios=cc.FixedStart(START, cc.Gaussian([NOISE])), steps=STEPS,
        objective=cc.QuadraticObjective(np.diag(Q), [[R]], design_cost=lambda p: PRICE / p[0]), limit_tolerance="off",
    )  # fmt: skip


def step(kind: str, q: np.ndarray, v: np.ndarray, u: np.ndarray, w: np.ndarray, mass: float) -> tuple:
    """State after a sample, by four steps of Runge and Kutta."""
    h = DT / 4

    def rate(v_: np.ndarray, q_: np.ndarray) -> np.ndarray:
        return (FORCES[kind](q_, v_, u, np) + w) / mass

    for _ in range(4):
        k1, l1 = v, rate(v, q)
        k2, l2 = v + h / 2 * l1, rate(v + h / 2 * l1, q + h / 2 * k1)
        k3, l3 = v + h / 2 * l2, rate(v + h / 2 * l2, q + h / 2 * k2)
        k4, l4 = v + h * l3, rate(v + h * l3, q + h * k3)
        q, v = q + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4), v + h / 6 * (l1 + 2 * l2 + 2 * l3 + l4)
    return q, v


def cost(kind: str, mass: float, law, runs: int) -> float:
    """Mean cost of a law (time, q, v) → u from the start."""
    w = NOISE * np.random.default_rng(7).standard_normal((STEPS, runs))
    q, v = (np.full(runs, value) for value in START)
    total = np.full(runs, PRICE / mass)
    for k in range(STEPS):
        u = np.clip(law(k, q, v), -INPUT, INPUT)
        total += Q[0] * q**2 + Q[1] * v**2 + R * u**2
        q, v = step(kind, q, v, u, w[k], mass)
    return float(total.mean())


def programmed(kind: str, mass: float, points: int):
    """The law of dynamic programming: the best input of every sample, interpolated on the grid of states."""
    axes = [np.linspace(-reach, reach, points) for reach in REACH]
    inputs = np.linspace(-INPUT, INPUT, points // 2 * 2 + 1)
    q, v, u = np.meshgrid(*axes, inputs, indexing="ij")
    nodes, weights = np.polynomial.hermite_e.hermegauss(3)
    after = [step(kind, q, v, u, NOISE * node, mass) for node in nodes]
    places = [np.stack([(a / r + 1) * (points - 1) / 2 for a, r in zip(x, REACH)]) for x in after]
    stage = Q[0] * q**2 + Q[1] * v**2 + R * u**2
    value = np.zeros((points, points))
    laws = []
    for _ in range(STEPS):
        ahead = sum(
            weight * map_coordinates(value, place, order=1, mode="nearest") for weight, place in zip(weights, places)
        )
        of_input = stage + ahead / weights.sum()
        value = of_input.min(axis=2)
        laws.append(inputs[of_input.argmin(axis=2)])
    laws.reverse()

    def law(k: int, q: np.ndarray, v: np.ndarray) -> np.ndarray:
        place = np.stack([(a / r + 1) * (points - 1) / 2 for a, r in zip((q, v), REACH)])
        return map_coordinates(laws[k], place, order=1, mode="nearest")

    return law


def nested(kind: str, linearisation: str, runs: int) -> tuple[float, float, str]:
    """Cost by the simulator above, mass, and the note on linearisations, of a nested co-design."""
    method = Nested("lqr", runs=256, starts=1, linearisation=linearisation)
    found = codesign(problem(kind), method=method, rng=np.random.default_rng(0))
    K, (offset,) = found.controller.K[0], found.controller.offset
    mass = float(found.design[0])
    said = [note for note in found.notes if "secant" in note]
    return cost(kind, mass, lambda k, q, v: offset - K[0] * q - K[1] * v, runs), mass, "; ".join(said)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--points", type=int, default=61, help="of the grid, in each direction (61)")
    parser.add_argument("--masses", type=int, default=7, help="designs of the oracle (7)")
    parser.add_argument("--runs", type=int, default=2000, help="simulated (2000)")
    asked = parser.parse_args()
    print(f"{'':18}{'DP':>9}{'m':>6}{'tangent':>10}{'auto':>9}{'m':>6}{'seconds':>9}", flush=True)
    for kind in FORCES:
        oracle = min(
            (cost(kind, m, programmed(kind, m, asked.points), asked.runs), m)
            for m in np.geomspace(0.5, 2.0, asked.masses)
        )
        try:
            of_tangent = f"{nested(kind, 'tangent', asked.runs)[0] / oracle[0] - 1:>+10.1%}"
        except cc.InputError:
            of_tangent = f"{'none':>10}"
        began = time.perf_counter()
        own, mass, said = nested(kind, "auto", asked.runs)
        seconds = time.perf_counter() - began
        told = f"{oracle[0]:>9.3f}{oracle[1]:>6.2f}{of_tangent}{own / oracle[0] - 1:>+9.1%}{mass:>6.2f}{seconds:>9.1f}"
        print(f"{kind:18}{told}  {said}", flush=True)
