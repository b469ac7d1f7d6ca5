"""Draw the picture of how_to/deploy_and_update.md."""

import matplotlib.pyplot as plt
import numpy as np
from _page import run, save

from ccdtools.figure_style import styled

bands = run("how_to/deploy_and_update.md")["bands"]
order = np.argsort(bands.actual[0, :, 0])
with styled():
    figure, ax = plt.subplots(figsize=(7, 3), layout="constrained")
    ax.fill_between(
        np.arange(len(order)), bands.lower[0, order, 0], bands.upper[0, order, 0], alpha=0.4, label="80 % band"
    )
    ax.plot(bands.actual[0, order, 0], ".", label="log")
    ax.set(xlabel="window, sorted by what the log did", ylabel="first state, ten steps ahead")
    ax.legend()
    save(figure, __file__)
