"""The first input of an MPC over the state and its cost over a mass, with the exact slopes at three points."""

from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from mpc import LinearMPC

A, B = np.array([[1.0, 0.1], [0.0, 0.95]]), np.array([[0.005], [0.1]])


def controller(p):
    return LinearMPC(A, B / p, Q=[1.0, 0.1], R=0.1, horizon=20, X=(-5, 5), U=(-1, 1))


figure = Figure(figsize=(8, 3), layout="constrained")
law, cost = figure.subplots(1, 2)
places, masses = np.linspace(-1.5, 1.5, 121), np.linspace(0.4, 2.0, 41)
law.plot(places, controller(1.0)(np.stack([places, 0 * places], axis=1))[:, 0])
cost.plot(masses, [controller(p).solve([1.0, 0.0]).cost for p in masses])
for x in (-0.3, 0.2, 1.0):
    found = controller(1.0).sensitivity([x, 0.0])
    near = np.array([-0.25, 0.25])
    law.plot(x + near, found.plan.inputs[0, 0] + found.input_by_state[0, 0] * near, "k--", lw=2)
for p in (0.6, 1.0, 1.6):
    found = controller(p).sensitivity([1.0, 0.0], dB=-B[:, :, None] / p**2)
    cost.plot(p + near, found.plan.cost + found.cost_by_parameters[0] * near, "k--", lw=2)
law.set(xlabel="position [m]", ylabel="first input [N]", title="input_by_state")
cost.set(xlabel="mass [kg]", ylabel="optimal cost", title="cost_by_parameters")
figure.savefig(Path(__file__).with_suffix(".png"), dpi=110)
