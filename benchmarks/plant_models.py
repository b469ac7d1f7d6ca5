"""Discrete models of every plant of the library against solvers that share no code with them.

    python benchmarks/plant_models.py [designs]

Linear plants: A, B and E against `scipy.linalg.expm` of one block matrix, their derivatives against `expm_frechet`.
Others, nominal and real: the stated error of a sample against CVODES at 1e-12, at points that were not looked at.
"""

from __future__ import annotations

import os
import sys
import time
from itertools import pairwise
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")
sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import casadi as ca
import numpy as np
from scipy.linalg import expm, expm_frechet, matrix_balance

from ccdtools import InputError, discretise
from ccdtools.plants import library
from ccdtools.plants.linear_model import derivative

LINEAR = {
    "quarter car": library.quarter_car,
    "quarter car, lag": lambda: library.quarter_car(actuator_lag=True),
    "half car": library.half_car,
    "full car, speeds": library.full_car,
    "full car, heights": lambda: library.full_car(road="height"),
    "pendulum, linear": lambda: library.pendulum_on_cart(linear=True),
    "servo": library.dc_servo,
    "chain of 3": lambda: library.mass_chain(3),
    "chain of 10": library.mass_chain,
    "wind turbine": library.wind_turbine,
    "tanks, linear": lambda: library.two_tanks(linear=True),
}
OTHERS = {  # plant, half-widths of x, of u and of w
    "quarter car, nonlinear": (lambda: library.quarter_car(nonlinear=True), [0.05, 1.5, 0.1, 1.0], [1000.0], [1.0]),
    "quarter car, real": (lambda: library.quarter_car(real=True), [0.05, 1.5, 0.1, 1.0], [1000.0], [1.0]),
    "pendulum": (library.pendulum_on_cart, [2.0, 4.0, 1.2, 6.0], [10.0], [0.6]),
    "pendulum, real": (lambda: library.pendulum_on_cart(real=True), [2.0, 4.0, 1.2, 6.0], [10.0], [0.6]),
    "servo, real": (lambda: library.dc_servo(real=True), [1.0, 5.0], [10.0], [0.1]),
    "chain of 3, real": (lambda: library.mass_chain(3, real=True), [0.2] * 3 + [0.5] * 3, [1.0], [0.5]),
    "tanks": (library.two_tanks, [8.0, 8.0], [1.0], [1.0, 1.0]),
}  # fmt: skip


def continuous(plant):
    """p → [A B E] of a linear plant, and its derivatives by p."""
    z = ca.vertcat(plant.x, plant.u, plant.w)
    J = ca.densify(ca.jacobian(plant.dynamics, z))
    slopes = [ca.densify(ca.jacobian(ca.vec(J), plant.p[k])) for k in range(plant.p.numel())]
    return ca.Function("J", [plant.p], [J, *slopes])


def against_expm(plant, designs):
    """Largest errors of [A B E] and of its first derivatives, each relative to the largest entry of its block."""
    model, rates = discretise(plant), continuous(plant)
    nx = plant.nx
    width = nx + plant.nu + plant.nw
    blocks = np.cumsum([0, nx, plant.nu, plant.nw])
    worst, slope = 0.0, 0.0
    for k, p in enumerate(plant.design.latin_hypercube(designs, np.random.default_rng(1))):
        J, *slopes = (np.asarray(M, dtype=float) for M in rates(p))
        M = np.zeros((width, width))
        M[:nx] = J * plant.dt
        balance = matrix_balance(np.abs(M) + 1e-12 * np.abs(M).max(), permute=False, separate=True)[1][0]
        back = balance[:, None] / balance
        worst = max(worst, error(np.hstack(model.matrices(p)), (expm(M / back) * back)[:nx], back[:nx], blocks))
        if k >= designs // 10:  # derivatives take longer
            continue
        own = model.derivatives(p)
        for i, S in enumerate(slopes):
            E = np.zeros((width, width))
            E[:nx] = S.reshape(width, nx).T * plant.dt
            exact = expm_frechet(M / back, E / back, compute_expm=False) * back
            mine = np.hstack([D[:, :, i] for D in own])
            slope = max(slope, error(mine, exact[:nx], back[:nx], blocks))
    return worst, slope


def against_differences(plant, designs=20, step=1e-4):
    """Largest error of the second derivatives of [A B E] against differences of the first, relative as above."""
    model = discretise(plant)
    second = derivative(model.jacobian)
    nx, count = plant.nx, plant.p.numel()
    width = nx + plant.nu + plant.nw
    blocks = np.cumsum([0, nx, plant.nu, plant.nw])
    worst = 0.0
    inner = plant.design.latin_hypercube(designs, np.random.default_rng(2))
    middle = (np.array(plant.design.lower) + np.array(plant.design.upper)) / 2
    for p in middle + 0.9 * (inner - middle):
        M = np.zeros((width, width))
        M[:nx] = np.hstack(model.matrices(p))
        balance = matrix_balance(np.abs(M) + 1e-12 * np.abs(M).max(), permute=False, separate=True)[1][0]
        back = (balance[:, None] / balance)[:nx]
        own = np.asarray(second(p), dtype=float).reshape(count, width, nx, count)
        for j in range(count):
            h = np.zeros(count)
            h[j] = step * (plant.design.upper[j] - plant.design.lower[j])
            slope = (np.asarray(model.jacobian(p + h)) - np.asarray(model.jacobian(p - h))) / (2 * h[j])
            for i in range(count):
                near = slope[:, i].reshape(width, nx).T
                worst = max(worst, error(own[i, :, :, j].T, near, back, blocks) if np.abs(near).max() > 1e-9 else 0.0)
    return worst


def error(own, exact, back, blocks):
    """Largest difference of a block, in balanced coordinates, relative to the largest entry of the block there."""
    own = own / back
    exact = exact / back
    parts = [(own[:, a:b], exact[:, a:b]) for a, b in pairwise(blocks) if b > a]
    return max(float(np.abs(M - N).max() / max(np.abs(N).max(), 1e-300)) for M, N in parts)


def cvodes(plant):
    """(x, u, w, p) → x⁺ at tolerances near rounding."""
    held = ca.vertcat(plant.u, plant.w, plant.p)
    problem = {"x": plant.x, "p": held, "ode": plant.dynamics}
    options = {"reltol": 1e-12, "abstol": 1e-14, "max_num_steps": 10**6}
    return ca.integrator("exact", "cvodes", problem, 0.0, plant.dt, options)


def kept(plant, x, u, w, accuracy, points=200):
    """Method, parts, stated and largest met error in half-widths of x, and how many points exceed it."""
    centre = np.zeros(plant.nx)
    limits = {"X": (centre - x, centre + x), "U": (-np.array(u), np.array(u)), "W": (-np.array(w), np.array(w))}
    model = discretise(plant, accuracy=accuracy, sampling_guard="ignore", **limits)
    rng = np.random.default_rng(11)
    exact = cvodes(plant)
    met, broken = 0.0, 0
    for _ in range(points):
        at = [rng.uniform(-1, 1, len(half)) * half for half in (x, u, w)]
        p = plant.design.latin_hypercube(1, rng)[0]
        reached = model.advance(*(part[None] for part in at), p)[0]
        truth = np.asarray(exact(x0=at[0], p=np.concatenate([*at[1:], p]))["xf"]).ravel()
        off = np.abs(reached - truth)
        met = max(met, float((off / x).max()))
        broken += bool((off > model.error.bound + 1e-11 * np.array(x)).any())
    return model, met, broken


def main(designs=1000):
    """Print both tables."""
    print("| linear plant | A, B, E against expm | first derivatives | second derivatives | s |\n|---|---|---|---|---|")
    for name, made in LINEAR.items():
        begun = time.perf_counter()
        plant = made()
        worst, slope = against_expm(plant, designs)
        second = against_differences(plant)
        taken = time.perf_counter() - begun
        print(f"| {name} | {worst:.1e} | {slope:.1e} | {second:.1e} | {taken:.0f} |", flush=True)
    head = "| plant | method, parts | stated | met | of 200 points beyond it | s |"
    print(f"\n{head}\n|---|---|---|---|---|---|")
    for name, (made, x, u, w) in OTHERS.items():
        begun = time.perf_counter()
        plant = made()
        try:
            accuracy = 1e-4 if "real" in name else 1e-6  # friction and stops are steep
            half = (np.array(x), np.full(plant.nu, u[0]), np.full(plant.nw, w[0]))
            model, met, broken = kept(plant, *half, accuracy)
        except InputError as refused:
            print(f"| {name} | {refused} | | | | {time.perf_counter() - begun:.0f} |", flush=True)
            continue
        taken = time.perf_counter() - begun
        what = f"{model.method}, {model.substeps}"
        print(f"| {name} | {what} | {model.error.relative:.1e} | {met:.1e} | {broken} | {taken:.0f} |", flush=True)


if __name__ == "__main__":
    main(*(int(argument) for argument in sys.argv[1:]))
