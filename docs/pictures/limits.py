"""Draw the picture of how_to/limits.md."""

import matplotlib.pyplot as plt
from _page import run, save

from ccdtools import simulate
from ccdtools.figure_style import BOUND, COLOURS, styled

page = run("how_to/limits.md")
with styled():
    figure, ax = plt.subplots(figsize=(7, 3), layout="constrained")
    for name, controller in page["controllers"].items():
        loop = simulate(page["plant"], controller, x0=[1.5, 0.0], steps=100, design=page["design"])
        ax.plot(loop.time, loop.states[0, :, 1], color=COLOURS[name], label=name)
    ax.axhline(-3.0, **BOUND, label="limit")
    ax.set(xlabel="time [s]", ylabel="speed of the load [rad/s]")
    ax.legend()
    save(figure, __file__)
