"""A double integrator with a limit of its speed, brought to rest by MPC and by LQR with its input saturated."""

from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from mpc import LinearMPC, lqr

A, B = np.array([[1.0, 0.1], [0.0, 1.0]]), np.array([[0.005], [0.1]])
weights = {"Q": [1.0, 0.1], "R": 0.1}
K, _ = lqr(A, B, **weights)
laws = {
    "LQR, saturated": lambda x: np.clip(-K @ x, -1, 1),
    "MPC": LinearMPC(A, B, **weights, horizon=20, X=([-5, -0.8], [5, 0.8]), U=(-1, 1)),
}

figure = Figure(figsize=(8, 2.8), layout="constrained")
axes = figure.subplots(1, 3)
for name, law in laws.items():
    x, states, inputs = np.array([3.0, 0.0]), [], []
    for _ in range(80):
        states.append(x)
        inputs.append(law(x)[0])
        x = A @ x + B @ law(x)
    for ax, values in zip(axes, (*np.transpose(states), inputs)):
        ax.plot(0.1 * np.arange(80), values, label=name)
for ax, title in zip(axes, ("position [m]", "speed [m/s]", "input [m/s²]")):
    ax.set(xlabel="time [s]", title=title)
axes[1].axhline(-0.8, color="k", lw=0.8, ls="--")
axes[0].legend()
figure.savefig(Path(__file__).with_suffix(".png"), dpi=110)
