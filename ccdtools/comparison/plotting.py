"""Picture of a comparison."""

from __future__ import annotations

from typing import Any

import numpy as np

from ccdtools.comparison.pid_tuning import REFERENCE
from ccdtools_ground.door import has_method


def plot_scores(comparison: Any, ax: Any = None) -> Any:
    """Plot the mean returns with 95 % intervals, one row per controller.

    One of fewer runs stands at LQR's mean on all runs plus its paired difference; one that always diverged is empty.

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
    scores = list(comparison)
    level = next((score.summary.mean for score in scores if score.controller == REFERENCE), np.nan)
    most = max(score.runs for score in scores)
    shown = [(0.0, one.summary) if one.runs == most else (level, one.paired_to_lqr) for one in scores]
    means = np.array([base + found.mean for base, found in shown])
    ends = np.array([base + np.array(found.ci95) for base, found in shown])
    rows = np.arange(len(scores))
    ax.errorbar(means, rows, xerr=np.abs(ends.T - means), fmt="o", capsize=3)
    ax.set_yticks(rows, [score.controller for score in scores])
    ax.invert_yaxis()
    ax.set_xlabel("return (mean and 95 % interval)")
    return ax
