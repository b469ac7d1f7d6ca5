"""Picture of a simulation."""

from __future__ import annotations

from typing import Any

import numpy as np

from ccdtools_ground.door import has_method


def plot_trajectory(run: Any, figure: Any = None) -> Any:
    """Plot states and inputs over time, at most the first 50 runs.

    Parameters
    ----------
    run : Trajectory
    figure : matplotlib Figure, optional
        Where to draw; a new one by default.

    Returns
    -------
    matplotlib Figure

    Raises
    ------
    InputError
        If `figure` is given and is none.
    """
    nx, nu = run.states.shape[2], run.inputs.shape[2]
    names = run.names or [*(f"x{i + 1}" for i in range(nx)), *(f"u{i + 1}" for i in range(nu))]
    if figure is None:
        import matplotlib.pyplot as plt

        figure = plt.figure(figsize=(7.0, 1.0 + 1.3 * len(names)), layout="constrained")
    has_method("figure", figure, "subplots", "a matplotlib Figure, or None for a new one")
    axes = figure.subplots(len(names), 1, sharex=True, squeeze=False)[:, 0]
    held = np.concatenate([run.inputs, run.inputs[:, -1:]], axis=1)  # the last input ends with its sample
    signals = np.concatenate([run.states, held], axis=2)[:50]  # more runs are a blot
    for i, (ax, name) in enumerate(zip(axes, names)):
        style = "steps-post" if i >= nx else "default"
        ax.plot(run.time, signals[:, :, i].T, lw=0.8, alpha=1.0 if len(signals) == 1 else 0.5, drawstyle=style)
        ax.set_ylabel(name)
        ax.grid(alpha=0.3)
    axes[-1].set_xlabel("time [s]")
    return figure
