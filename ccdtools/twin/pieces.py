"""Pieces of a deployment, joined to one log."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from ccdtools.trajectory import Trajectory


def joined(pieces: Sequence[Trajectory], runs: int) -> Trajectory:
    """One log of all parts."""
    if len(pieces) == 1:
        return pieces[0]
    first = pieces[0]
    if runs > 1:
        names = ("states", "inputs", "disturbances", "diverged_at")
        whole: dict[str, Any] = {name: np.concatenate([getattr(p, name) for p in pieces]) for name in names}
        return replace(first, **whole)
    states = np.concatenate([first.states, *(p.states[:, 1:] for p in pieces[1:])], axis=1)
    inputs = np.concatenate([p.inputs for p in pieces], axis=1)
    disturbances = np.concatenate([p.disturbances for p in pieces], axis=1)
    starts = np.cumsum([0, *(p.inputs.shape[1] for p in pieces)])
    lost = [start + int(p.diverged_at[0]) for start, p in zip(starts, pieces) if p.diverged_at[0] >= 0]
    if lost:  # a stretch after the loss started afresh from where the run was stopped
        states[:, lost[0] + 1 :] = states[:, lost[0] + 1, None]
        inputs[:, lost[0] + 1 :] = 0.0
    return Trajectory(states, inputs, disturbances, np.array([lost[0] if lost else -1]), first.design, first.dt)
