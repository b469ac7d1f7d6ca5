"""Draw the picture of how_to/disturbances.md."""

import matplotlib.pyplot as plt
from _page import run, save

from ccdtools.figure_style import styled

draws = run("how_to/disturbances.md")["draws"]
with styled():
    figure, axes = plt.subplots(1, 4, figsize=(10, 2.4), layout="constrained")
    for ax, (name, w) in zip(axes, draws.items()):
        ax.plot(w[:, :60].reshape(len(w), -1, w.shape[2])[..., 0].T, lw=0.8)
        if w.shape[2] > 1:
            ax.plot(w[:, :60, 1].T, "--")
        ax.set(title=name, xlabel="sample")
    save(figure, __file__)
