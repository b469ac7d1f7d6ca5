"""Finished stage on disk: JSON values, arrays, networks and hashes."""

from __future__ import annotations

import functools
import hashlib
import json
import os
import shutil
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ccdtools.arrays import Array, jsonable as jsonable

if TYPE_CHECKING:
    from ccdtools.trajectory import Trajectory

Network = Any
MANIFEST = "manifest.json"
LOGGED = ("states", "inputs", "disturbances", "diverged_at", "design", "outputs")  # of a log; outputs of sensors alone


@dataclass(frozen=True, eq=False)
class Stage:
    """Results of one stage: JSON values, arrays and networks by name."""

    values: dict[str, Any] = field(default_factory=dict)
    arrays: dict[str, Array] = field(default_factory=dict)
    networks: dict[str, Network] = field(default_factory=dict)


def kept_log(log: Trajectory) -> dict[str, Array]:
    """Arrays of a log, for a stage."""
    return {name: getattr(log, name) for name in LOGGED if getattr(log, name) is not None}


def log_of(stage: Stage, dt: float) -> Trajectory:
    """Log of a stage."""
    from ccdtools.trajectory import Trajectory  # loads casadi, which a wrong option need not wait for

    kept: dict[str, Any] = {name: stage.arrays[name] for name in LOGGED if name in stage.arrays}
    return Trajectory(**kept, dt=dt)


def write_stage(folder: Path, stage: Stage, run: str) -> None:
    """Write a stage with the identity `run`, moved into place when whole."""
    from learning import checkpoint  # loads torch, which a wrong option need not wait for

    partial = folder.with_name(f"{folder.name}.partial")
    shutil.rmtree(partial, ignore_errors=True)
    partial.mkdir(parents=True)
    (partial / "values.json").write_text(json_text(stage.values), encoding="utf-8")
    np.savez_compressed(partial / "arrays.npz", **stage.arrays)  # type: ignore[arg-type]
    for key, network in stage.networks.items():
        saved(partial / f"{key}.safetensors", functools.partial(checkpoint.save, network=network))
    manifest = {"stage": folder.name, "run": run, "files": _hashes(partial)}
    (partial / MANIFEST).write_text(json_text(manifest), encoding="utf-8")
    os.replace(partial, folder)


def read_stage(folder: Path, run: str) -> Stage:
    """Finished stage with the identity `run`.

    Raises
    ------
    ValueError, OSError, KeyError, EOFError, zipfile.BadZipFile
        If a file is missing or changed, or belongs to another run.
    """
    from ccdtools.design_limits import DesignLimits
    from learning import checkpoint

    _check_manifest(folder, run)
    values = json.loads((folder / "values.json").read_text(encoding="utf-8"))
    with np.load(folder / "arrays.npz", allow_pickle=False) as arrays:
        loaded = {key: arrays[key] for key in arrays.files}
    read = functools.partial(checkpoint.load, action_limits=DesignLimits.from_dict)
    networks = {p.stem: read(p)[0] for p in sorted(folder.glob("*.safetensors"))}
    return Stage(values, loaded, networks)


def _check_manifest(folder: Path, run: str) -> None:
    """Raise a `ValueError` that names the first file not as written."""
    if not (folder / MANIFEST).is_file():
        raise ValueError(f"{MANIFEST} is missing")
    try:
        kept = json.loads((folder / MANIFEST).read_text(encoding="utf-8"))
    except ValueError:
        raise ValueError(f"{MANIFEST} is not as it was written") from None
    present = _hashes(folder)
    if not isinstance(kept, dict) or kept.get("stage") != folder.name or not isinstance(kept.get("files"), dict):
        raise ValueError(f"{MANIFEST} is not of this stage")
    for file in sorted({*kept["files"], *present}):
        if file not in present:
            raise ValueError(f"{file} is missing")
        if present[file] != kept["files"].get(file):
            raise ValueError(f"{file} is not as it was written")
    if kept.get("run") != run:
        raise ValueError("it belongs to another run, or run.json was changed since")


def saved(path: Path, write: Callable[[Path], None]) -> None:
    """Write a network to a path; a failure is an `OSError`."""
    from learning.exceptions import CheckpointError

    try:
        write(path)
    except CheckpointError as error:
        raise OSError(str(error.got)) from None


def json_text(values: dict[str, Any]) -> str:
    """Indented JSON."""
    return json.dumps(jsonable(values), indent=2, ensure_ascii=False, allow_nan=False)


def _hashes(folder: Path) -> dict[str, str]:
    """SHA-256 of every file of a stage but its manifest, by name."""
    files = sorted(p for p in folder.iterdir() if p.name != MANIFEST)
    return {p.name: hashlib.sha256(p.read_bytes()).hexdigest() for p in files}
