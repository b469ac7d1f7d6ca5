"""The picture of a comparison."""

from __future__ import annotations

from typing import Any

import numpy as np

from ccdtools.checks import has_method


def plot_scores(comparison: Any, ax: Any = None) -> Any:
    """Mean returns with their 95 % intervals, one row per controller; those that always diverged stay empty.

    Parameters
    ----------
    comparison : Comparison
        Or any collection of scores.
    ax : matplotlib axes, optional
        A new figure by default.

    Returns
    -------
    matplotlib axes

    Raises
    ------
    InputError
        If `ax` is given and is none.
    """
    if ax is None:
        from matplotlib.figure import Figure

        ax = Figure(figsize=(6.0, 0.6 + 0.4 * len(comparison)), layout="constrained").add_subplot()
    has_method("ax", ax, "errorbar", "matplotlib axes, or None for a new figure")
    means = np.array([score.summary.mean for score in comparison])
    ends = np.array([score.summary.ci95 for score in comparison])
    rows = np.arange(len(comparison))
    ax.errorbar(means, rows, xerr=np.abs(ends.T - means), fmt="o", capsize=3)
    ax.set_yticks(rows, [score.controller for score in comparison])
    ax.invert_yaxis()
    ax.set_xlabel("return (mean and 95 % interval)")
    return ax
