"""Picture of a comparison."""

from __future__ import annotations

from typing import Any

import numpy as np

from ccdtools.comparison.pid_tuning import REFERENCE
from ccdtools_ground.door import has_method


def plot_scores(comparison: Any, ax: Any = None) -> Any:
    """Plot the baseline's mean return, and the others beside it by paired differences with 95 % intervals.

    All meet the same runs, so that these decide, as they do in the table. One that always diverged is empty.

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
    from ccdtools.figure_style import Figure, label

    names = [label(score.controller) for score in comparison]
    if ax is None:
        height = 0.8 + sum(0.25 + 0.15 * (name.count("\n") + 1) for name in names)
        ax = Figure(figsize=(6.0, height), layout="constrained").add_subplot()
    has_method("ax", ax, "errorbar", "matplotlib axes, or None for a new figure")
    scores = list(comparison)
    baseline = getattr(comparison, "baseline", REFERENCE)
    level = next((score.summary.mean for score in scores if score.controller == baseline), np.nan)
    means = np.array([level + score.paired_to_lqr.mean for score in scores])
    ends = np.array([np.add(level, score.paired_to_lqr.ci95) for score in scores])
    ax.axvline(level, color="#444444", lw=0.9)
    rows = np.arange(len(scores))
    ax.errorbar(means, rows, xerr=np.abs(ends.T - means), fmt="o", capsize=3)
    ax.set_yticks(rows, names)
    ax.invert_yaxis()
    ax.set_xlabel(f"return: mean of {label(baseline)},\nand differences in pairs with 95 % intervals")
    return ax
