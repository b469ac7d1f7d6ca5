"""Draw the picture of how_to/preview.md: a step of the road's speed after one second."""

import matplotlib.pyplot as plt
import numpy as np
from _page import run, save

from ccdtools import simulate
from ccdtools.figure_style import styled

page = run("how_to/preview.md")
bump = np.zeros((1, 60, 1))
bump[0, 20:24] = 0.5
controllers = {"LQR": page["blind"], "LQR with preview": page["Previewing"](page["sees"], 10)}
with styled():
    figure, ax = plt.subplots(figsize=(7, 3), layout="constrained")
    for name, controller in controllers.items():
        loop = simulate(page["study"].plant, controller, x0=np.zeros(4), steps=60, disturbance=bump,
                        design=page["design"])  # fmt: skip
        ax.step(loop.time[:-1], loop.inputs[0, :, 0], where="post", label=name)
    ax.axvspan(loop.time[20], loop.time[24], color="#DDDDDD", label="bump")
    ax.set(xlabel="time [s]", ylabel="active force [N]")
    ax.legend()
    save(figure, __file__)
