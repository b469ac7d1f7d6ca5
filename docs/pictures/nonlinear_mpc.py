"""A pole on a cart let go at 0.4 rad, on a track that ends 0.6 m to each side: nonlinear MPC and saturated LQR."""

from pathlib import Path

import casadi as ca
import numpy as np
from matplotlib.figure import Figure

from mpc import lqr
from mpc.optimal_control import NonlinearMPC, sampled


def cart_pole(x, u, p):
    sine, cosine = ca.sin(x[2]), ca.cos(x[2])
    push = u[0] + 0.2 * p[0] * x[3] ** 2 * sine
    acceleration = (push - 0.2 * 9.81 * sine * cosine) / (1.0 + 0.2 * sine**2)
    return ca.vertcat(x[1], acceleration, x[3], (9.81 * sine - acceleration * cosine) / p[0])


step = sampled(cart_pole, 0.04)
weights = {"Q": [4.0, 0.25, 25.0, 0.25], "R": 0.01}
limits = np.array([0.6, 9, 9, 99])
law = NonlinearMPC(step, 4, 1, **weights, horizon=30, X=(-limits, limits), U=(-10, 10), p=[0.5])
K, _ = lqr(law.linear.A, law.linear.B, **weights)
laws = {"LQR, saturated": lambda x: np.clip(-K @ x, -10, 10), "nonlinear MPC": law}

figure = Figure(figsize=(8, 2.8), layout="constrained")
axes = figure.subplots(1, 3)
for name, controller in laws.items():
    x, rows = np.array([0, 0, 0.4, 0]), []
    for _ in range(75):
        u = controller(x)
        rows.append([x[0], x[2], u[0]])
        x = np.asarray(step(x, u, [0.5]))[:, 0]
    for ax, values in zip(axes, np.transpose(rows)):
        ax.plot(0.04 * np.arange(75), values, label=name)
for ax, title in zip(axes, ("position [m]", "angle [rad]", "force [N]")):
    ax.set(xlabel="time [s]", title=title)
axes[0].axhline(0.6, color="k", lw=0.8, ls="--")
axes[1].legend()
figure.savefig(Path(__file__).with_suffix(".png"), dpi=110)
