"""Draw the picture of reference/models.md: the pole itself and its linearisation under one LQR."""

import matplotlib.pyplot as plt
import numpy as np
from _page import save

from ccdtools import discretise, equilibrium, linearise, simulate
from ccdtools.controllers.controllers import LinearFeedback
from ccdtools.figure_style import styled
from ccdtools.plants.library import pendulum_on_cart
from mpc import lqr

DESIGN = [0.6, 0.5]
plant = pendulum_on_cart()
tangent = discretise(linearise(plant, equilibrium(plant, DESIGN)))
A, B, _ = tangent.matrices(DESIGN)
gain, _ = lqr(A, B, Q=np.diag([1.0, 0.1, 10.0, 0.1]), R=[[0.1]])
starts = np.array([[0.0, 0.0, angle, 0.0] for angle in (0.2, 0.5, 0.8, 1.0)])
with styled():
    figure, ax = plt.subplots(figsize=(7, 3), layout="constrained")
    for model, style in ((discretise(plant), "-"), (tangent, "--")):
        run = simulate(model, LinearFeedback(gain), x0=starts, steps=100, design=DESIGN)
        for i, states in enumerate(run.states):
            ax.plot(run.time, states[:, 2], style, color=f"C{i}")
    ax.set(xlabel="time [s]", ylabel="angle of the pole [rad]")
    save(figure, __file__)
