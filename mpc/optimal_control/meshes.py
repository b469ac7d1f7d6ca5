"""Meshes as stated, and refined."""

from __future__ import annotations

from typing import Any

import numpy as np

from ccdtools_ground.door import brief
from mpc.checks import Array, as_count, as_floats
from mpc.exceptions import InputError
from mpc.optimal_control.phase_solution import PhaseSolution
from mpc.optimal_control.problem import OptimalControlProblem
from mpc.optimal_control.schemes import Collocation
from mpc.tolerances import JUMP_PLACE, JUMP_SHARE, LEAST_INTERVAL, MESH_SAFETY, MOST_PARTS


def finer_mesh(phase: PhaseSolution, errors: Array, excess: Array, tolerance: float) -> Array:
    """Mesh cut where errors, violations or jumps ask for it.

    Of an excess (N,) that counts from 1 on; where an input jumps, too.
    """
    part = phase.part
    order = part.scheme.stages + 1 if isinstance(part.scheme, Collocation) else 5
    asked = np.clip((np.maximum(errors, tolerance) / (MESH_SAFETY * tolerance)) ** (1 / order), 2, MOST_PARTS)
    steps = np.diff(part.mesh)
    parts = np.where(errors > tolerance, np.ceil(asked).astype(int), 1)
    long = steps > JUMP_PLACE * np.sqrt(tolerance)
    parts = np.where(excess > 1, np.maximum(parts, np.clip(np.ceil(np.cbrt(excess)), 2, MOST_PARTS)), parts).astype(int)
    parts[_jumps(phase) & long] = MOST_PARTS
    parts[steps <= LEAST_INTERVAL] = 1
    if part.phase.discrete:
        return part.mesh
    inner = [left + step * np.arange(n) / n for left, step, n in zip(part.mesh[:-1], steps, parts)]
    return np.append(np.concatenate(inner), 1.0)


def _jumps(phase: PhaseSolution) -> Array:
    """Intervals (N,) within which an input jumps.

    Not where it crosses back and forth in neighbours, as inputs do along a singular arc: there is no jump to find.
    """
    inputs = phase.stages.inputs
    if not inputs.size:
        return np.zeros(len(inputs), dtype=bool)
    whole = np.ptp(inputs, axis=(0, 1))
    crossing = (np.ptp(inputs, axis=1) > JUMP_SHARE * np.where(whole > 0, whole, np.inf)).any(axis=1)
    beside = np.convolve(crossing, [1, 0, 1], mode="same") > 0
    return np.asarray(crossing & ~beside)


def as_meshes(problem: OptimalControlProblem, intervals: Any, meshes: Any) -> list[Array]:
    """Mesh fractions of every phase."""
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
