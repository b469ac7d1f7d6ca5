"""Draw the picture of how_to/simulators.md."""

import matplotlib.pyplot as plt
from _page import run, save

from ccdtools.figure_style import styled

page = run("how_to/simulators.md")
with styled():
    figure, ax = plt.subplots(figsize=(7, 2.8), layout="constrained")
    states = page["run"].states[0]
    ax.plot(0.1 * page["np"].arange(len(states)), states[:, 0])
    ax.set(xlabel="time [s]", ylabel="position")
    save(figure, __file__)
