"""Draw the picture of how_to/export_a_policy.md."""

import matplotlib.pyplot as plt
from _page import run, save

from ccdtools.figure_style import styled

page = run("how_to/export_a_policy.md")
with styled():
    figure, ax = plt.subplots(figsize=(7, 2.8), layout="constrained")
    ax.plot(page["x"], page["u"])
    ax.set(xlabel="first state, the second at 0", ylabel="input")
    save(figure, __file__)
