"""Folder of one run: options, finished stages and results."""

from __future__ import annotations

import hashlib
import json
import os
import shutil
import zipfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO, Any

from ccdtools.exceptions import InputError
from ccdtools.studies.stage_storage import Stage, json_text, read_stage, saved, write_stage

LOCK = "run.lock"
FOLDERS = ("stages", "figures")
DISTURBANCE = "disturbance.npy"
FILES = ("run.json", "results.json", "report.html", "policy.safetensors", DISTURBANCE, LOCK)

WRITABLE = "a folder that can be written and has room"
MEND = "What was finished is kept; mend this and continue with `ccdtools resume`."


class RunFolder:
    """Folder of a run, with stages written whole or not at all.

    A finished stage carries the hashes of its files and of ``run.json``: one that was damaged, edited or taken from
    another run is refused, and never read as if it were this run's.

    Parameters
    ----------
    path : str or Path
    """

    def __init__(self, path: str | Path) -> None:
        self.path = Path(path)

    def __repr__(self) -> str:
        return f"RunFolder({str(self.path)!r})"

    @classmethod
    def create(cls, path: str | Path, *, overwrite: bool = False, argument: str = "path") -> RunFolder:
        """New folder of a run.

        Raises
        ------
        InputError
            If the path exists and `overwrite` is false, is not a run's folder, is in use, or cannot be made.
        """
        folder = cls(path)
        folder.check_new(overwrite=overwrite, argument=argument)
        if os.path.lexists(folder.path):
            with folder.locked(argument), folder.writing(argument):
                shutil.rmtree(folder.path)
        try:
            folder.path.mkdir(parents=True)
        except (OSError, ValueError) as error:
            reason = getattr(error, "strerror", None) or str(error)
            raise InputError(argument, str(path)[:80], f"a folder that can be made ({reason})") from None
        return folder

    def check_new(self, *, overwrite: bool = False, argument: str = "path", mark: str = "run.json") -> None:
        """Raise unless the path is free or may be overwritten."""
        if not os.path.lexists(self.path) or self._was_never_begun():
            return
        if not overwrite:
            resumed = "continue it with `ccdtools resume`, " if (self.path / "run.json").is_file() else ""
            cure = f"Choose another, {resumed}or add --overwrite."
            raise InputError(argument, f"{self.path}, which exists", "a new folder", cure)
        if self.path.is_symlink() or not (self.path / mark).is_file():
            what = "run" if mark == "run.json" else mark
            raise InputError(argument, f"{self.path}, which holds no {what}", f"a {what}'s folder to overwrite")

    def _was_never_begun(self) -> bool:
        """Whether a run was killed before it wrote run.json."""
        try:
            names = {name.removesuffix(".partial") for name in os.listdir(self.path)}
        except OSError:
            return False
        return LOCK in names and names <= {LOCK, DISTURBANCE, "run.json"} and not (self.path / "run.json").exists()

    @contextmanager
    def locked(self, argument: str = "folder") -> Iterator[None]:
        """Keep other processes out until this one ends or lets go.

        Raises
        ------
        InputError
            If another process works in the folder, or nothing can be written there.
        """
        with self.writing(argument):
            file = (self.path / LOCK).open("a")
        with file:
            if not _locks(file):
                got = f"{self.path}, in which another process is running"
                raise InputError(argument, got, "a folder that nobody else works in", "Wait until that run has ended.")
            yield

    @contextmanager
    def writing(self, argument: str = "folder") -> Iterator[None]:
        """Turn a failure to write into an `InputError`."""
        try:
            yield
        except BrokenPipeError:
            raise
        except (FileExistsError, NotADirectoryError, IsADirectoryError) as error:
            got = f"{self.path}, where {error.filename} is in the way"
            raise InputError(argument, got, "a run's folder") from None
        except OSError as error:
            got = f"{self.path} ({error.strerror or error})"
            raise InputError(argument, got, WRITABLE, MEND) from None

    def check_layout(self) -> None:
        """Raise unless the path holds a run's files and folders.

        Raises
        ------
        InputError
            If it does not; the message names what is in the way.
        """
        if not self.path.is_dir():
            raise InputError("folder", f"{self.path}, which is no folder", "the folder of a run")
        for name in FOLDERS:
            if os.path.lexists(self.path / name) and not (self.path / name).is_dir():
                raise InputError("folder", f"{self.path} with a file {name}", f"a folder {name}, or none")
        for name in FILES:
            if (self.path / name).is_dir():
                raise InputError("folder", f"{self.path} with a folder {name}", f"a file {name}, or none")
        self.read_json("run.json")

    def check_stages(self) -> None:
        """Read every finished stage, to report damage early."""
        for name in self.finished():
            self.read_stage(name)

    def write_json(self, name: str, values: dict[str, Any]) -> None:
        """Write `values` to a JSON file; NaN and infinity become null."""
        self.write_text(name, json_text(values) + "\n")

    def write_text(self, name: str, text: str) -> Path:
        """Write a file whole or not at all, and return its path."""
        self.write_bytes(name, text.encode("utf-8", errors="surrogateescape"))
        return self.path / name

    def write_bytes(self, name: str, content: bytes) -> None:
        """Write a file whole or not at all."""
        partial = self.path / f"{name}.partial"
        with self.writing():
            partial.parent.mkdir(exist_ok=True)
            partial.write_bytes(content)
            os.replace(partial, self.path / name)

    def read_json(self, name: str) -> dict[str, Any]:
        """Values of a JSON file.

        Raises
        ------
        InputError
            If it is missing, or holds no JSON object.
        """
        try:
            values = json.loads((self.path / name).read_text(encoding="utf-8", errors="surrogateescape"))
        except (OSError, ValueError, RecursionError):
            values = None
        if not isinstance(values, dict):
            raise InputError("folder", f"{self.path} without a readable {name}", "a run's folder")
        return values

    def keep_stage(self, name: str, stage: Stage) -> Stage:
        """Write a stage and return it as it is read back."""
        with self.writing():
            write_stage(self._stages / name, stage, self._identity())
        return self.read_stage(name)

    def save_policy(self, policy: Any, notes: dict[str, str]) -> None:
        """Write the final policy (a `LearnedPolicy`) with notes."""
        path = self.path / "policy.safetensors"
        partial = path.with_suffix(".partial")
        with self.writing():
            saved(partial, lambda path: policy.save(path, **notes))
            os.replace(partial, path)

    def has(self, name: str) -> bool:
        """Whether a stage is finished."""
        return (self._stages / name).is_dir()

    def finished(self) -> list[str]:
        """Names of the finished stages, oldest first."""
        if not self._stages.is_dir():
            return []
        folders = [p for p in self._stages.iterdir() if p.is_dir() and not p.name.endswith(".partial")]
        return [p.name for p in sorted(folders, key=_written_at)]

    def read_stage(self, name: str) -> Stage:
        """Finished stage.

        Raises
        ------
        InputError
            If a file of it is missing, was changed, or belongs to another run.
        """
        try:
            return read_stage(self._stages / name, self._identity())
        except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile) as error:
            got = f"a damaged stage {self._stages / name} ({error})"
            raise InputError("folder", got, "it as written", "Delete it, and the run computes it again.") from None

    def _identity(self) -> str:
        """Hash of run.json; empty without that file."""
        if not (self.path / "run.json").is_file():
            return ""
        canonical = json.dumps(self.read_json("run.json"), sort_keys=True)
        return hashlib.sha256(canonical.encode()).hexdigest()

    @property
    def _stages(self) -> Path:
        return self.path / "stages"


def _written_at(stage: Path) -> int:
    """Time [ns] at which a stage was finished; 0 if damaged."""
    try:
        return (stage / "values.json").stat().st_mtime_ns
    except OSError:
        return 0


def _locks(file: IO[str]) -> bool:
    """Lock an open file for this process; False if another holds it."""
    try:
        import fcntl

        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except ImportError:  # Windows
        import msvcrt

        try:
            msvcrt.locking(file.fileno(), msvcrt.LK_NBLCK, 1)  # type: ignore[attr-defined]
        except OSError:
            return False
    except BlockingIOError:
        return False
    except OSError:  # a file system without locks
        return True
    return True
