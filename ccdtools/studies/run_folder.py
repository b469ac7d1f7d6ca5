"""A folder that holds one run: its configuration, the stages it has finished, and its results."""

from __future__ import annotations

import json
import math
import os
import shutil
import zipfile
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from ccdtools.arrays import Array
from ccdtools.exceptions import InputError
from learning import checkpoint
from learning.exceptions import CheckpointError

Network = Any


@dataclass(frozen=True, eq=False)
class Stage:
    """What one stage leaves behind: JSON values, arrays and networks by name."""

    values: dict[str, Any] = field(default_factory=dict)
    arrays: dict[str, Array] = field(default_factory=dict)
    networks: dict[str, Network] = field(default_factory=dict)


class RunFolder:
    """Stages are written whole or not at all, so that an interrupted run loses only the stage it was in.

    Parameters
    ----------
    path : str or Path
    """

    def __init__(self, path: str | Path) -> None:
        self.path = Path(path)

    @classmethod
    def create(cls, path: str | Path, *, overwrite: bool = False, argument: str = "--output") -> RunFolder:
        """A new folder.

        Raises
        ------
        InputError
            If the path exists and `overwrite` is false, is not a run's folder, or cannot be made.
        """
        folder = cls(path)
        try:
            exists = folder.path.exists()
        except OSError as error:
            raise InputError(f"{argument}: got {folder.path}, expected a usable path ({error.strerror}).") from None
        if exists:
            if not overwrite:
                raise InputError(
                    f"{argument}: got {folder.path}, which exists, expected a new folder; "
                    "choose another, continue it with `ccdtools resume`, or add --overwrite."
                )
            if folder.path.is_symlink() or not (folder.path / "run.json").is_file():
                raise InputError(
                    f"{argument}: got {folder.path}, which holds no run, expected a run's folder to overwrite."
                )
            shutil.rmtree(folder.path)
        try:
            folder.path.mkdir(parents=True)
        except OSError as error:
            raise InputError(
                f"{argument}: got {folder.path}, expected a folder that can be made ({error.strerror})."
            ) from None
        return folder

    def write_json(self, name: str, values: dict[str, Any]) -> None:
        """Write `values` to a JSON file; NaN and infinity become null."""
        text = json.dumps(jsonable(values), indent=2, ensure_ascii=False, allow_nan=False)
        partial = self.path / f"{name}.partial"
        partial.write_text(text + "\n", encoding="utf-8")
        os.replace(partial, self.path / name)

    def read_json(self, name: str) -> dict[str, Any]:
        """The values of a JSON file.

        Raises
        ------
        InputError
            If it is missing or no JSON.
        """
        try:
            return json.loads((self.path / name).read_text(encoding="utf-8"))
        except (OSError, ValueError):
            raise InputError(f"folder: got {self.path} without a readable {name}, expected a run's folder.") from None

    def stage(self, name: str, compute: Callable[[], Stage]) -> Stage:
        """The stage of that name: read if it was finished before, else computed and written."""
        if not self.has(name):
            self._write_stage(name, compute())
        return self.read_stage(name)

    def has(self, name: str) -> bool:
        """Whether a stage is finished."""
        return (self._stages / name).is_dir()

    def finished(self) -> list[str]:
        """Names of the finished stages, oldest first."""
        if not self._stages.is_dir():
            return []
        folders = [p for p in self._stages.iterdir() if p.is_dir() and not p.name.endswith(".partial")]
        return [p.name for p in sorted(folders, key=lambda p: (p / "values.json").stat().st_mtime_ns)]

    def read_stage(self, name: str) -> Stage:
        """A finished stage."""
        try:
            return self._read(name)
        except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile, CheckpointError) as error:
            raise InputError(
                f"folder: got a damaged stage {self._stages / name} ({error}), expected it as written; "
                "delete it, and the run computes it again."
            ) from None

    def _read(self, name: str) -> Stage:
        folder = self._stages / name
        values = json.loads((folder / "values.json").read_text(encoding="utf-8"))
        with np.load(folder / "arrays.npz", allow_pickle=False) as arrays:
            loaded = {key: arrays[key] for key in arrays.files}
        networks = {p.stem: checkpoint.load(p)[0] for p in sorted(folder.glob("*.safetensors"))}
        return Stage(values, loaded, networks)

    def _write_stage(self, name: str, stage: Stage) -> None:
        partial = self._stages / f"{name}.partial"
        shutil.rmtree(partial, ignore_errors=True)
        partial.mkdir(parents=True)
        text = json.dumps(jsonable(stage.values), indent=2, ensure_ascii=False, allow_nan=False)
        (partial / "values.json").write_text(text, encoding="utf-8")
        np.savez_compressed(partial / "arrays.npz", **stage.arrays)  # type: ignore[arg-type]
        for key, network in stage.networks.items():
            checkpoint.save(partial / f"{key}.safetensors", network)
        os.replace(partial, self._stages / name)

    @property
    def _stages(self) -> Path:
        return self.path / "stages"


def jsonable(value: Any) -> Any:
    """`value` with plain Python types only; what is not finite becomes None."""
    if isinstance(value, dict):
        return {str(key): jsonable(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [jsonable(item) for item in value]
    if isinstance(value, np.ndarray):
        return jsonable(value.tolist())
    if isinstance(value, bool | np.bool_):
        return bool(value)
    if isinstance(value, int | np.integer):
        return int(value)
    if isinstance(value, float | np.floating):
        return float(value) if math.isfinite(value) else None
    return value
