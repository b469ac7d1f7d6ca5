"""Draw the picture of reference/conventions.md: the wheel after a bump, finely and at the paper's samples."""

from dataclasses import replace

import matplotlib.pyplot as plt
import numpy as np
from _page import save

from ccdtools import load_study, simulate
from ccdtools.controllers import Passive
from ccdtools.figure_style import styled

DESIGN = [40000.0, 500.0]
plant = load_study("suspension").plant
with styled():
    figure, ax = plt.subplots(figsize=(7, 3), layout="constrained")
    for dt, style, label in ((0.002, "-", "every 0.002 s"), (plant.dt, "o", "every 0.05 s, as in the paper")):
        run = simulate(replace(plant, dt=dt), Passive(1), x0=[0.05, 0, 0, 0], steps=round(1.0 / dt), design=DESIGN,
                       disturbance=np.zeros((round(1.0 / dt), 1)))  # fmt: skip
        ax.plot(run.time, run.states[0, :, 1], style, label=label)
    ax.set(xlabel="time [s]", ylabel="speed of the wheel [m/s]")
    ax.legend()
    save(figure, __file__)
