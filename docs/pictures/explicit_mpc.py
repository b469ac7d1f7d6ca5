"""Regions, law and optimal cost of an explicit MPC of the double integrator."""

from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from mpc import LinearMPC

A, B = np.array([[1.0, 1.0], [0.0, 1.0]]), np.array([[0.5], [1.0]])
law = LinearMPC(A, B, Q=np.eye(2), R=0.1, horizon=10, X=(-5, 5), U=(-1, 1)).explicit()

figure = Figure(figsize=(9, 2.8), layout="constrained")
for ax, what in zip(figure.subplots(1, 3), ("regions", "law", "value")):
    law.plot(what, ax=ax)
figure.savefig(Path(__file__).with_suffix(".png"), dpi=110)
