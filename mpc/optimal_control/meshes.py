"""Meshes as a user states them: fractions of every phase."""

from __future__ import annotations

from typing import Any

import numpy as np

from mpc.checks import Array, as_count, as_floats
from mpc.exceptions import InputError
from mpc.optimal_control.functions import brief
from mpc.optimal_control.problem import OptimalControlProblem


def as_meshes(problem: OptimalControlProblem, intervals: Any, meshes: Any) -> list[Array]:
    """Fractions of every phase."""
    count = len(problem.phases)
    if meshes is None:
        each = [intervals] * count if np.ndim(intervals) == 0 else list(intervals)
        if len(each) != count:
            raise InputError("intervals", f"{len(each)} numbers", f"{count}, one a phase")
        meshes = [np.linspace(0, 1, as_count("intervals", n) + 1) for n in each]
    if not isinstance(meshes, list | tuple | np.ndarray):
        raise InputError("meshes", brief(repr(meshes)), "a list of meshes, one a phase")
    if len(meshes) != count:
        raise InputError("meshes", f"{len(meshes)} of them", f"{count}, one a phase")
    checked = []
    for phase, given in zip(problem.phases, meshes):
        if phase.discrete:
            given = np.linspace(0, 1, int(phase.duration[0]) + 1)
        mesh = as_floats("meshes", given)
        if mesh.ndim != 1 or len(mesh) < 2 or mesh[0] != 0 or mesh[-1] != 1 or not (np.diff(mesh) > 0).all():
            raise InputError("meshes", mesh, "fractions of the phase that rise from 0 to 1")
        checked.append(mesh)
    return checked
