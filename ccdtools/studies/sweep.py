"""Runs of one study with every combination of options, stated in a TOML file."""

from __future__ import annotations

import csv
import io
import re
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass, fields
from itertools import product
from pathlib import Path
from typing import Any

from ccdtools.exceptions import InputError
from ccdtools.studies.options import FILES, Options
from ccdtools.studies.run_folder import RunFolder
from ccdtools_ground.door import nearest, shown

NAMES = [field.name for field in fields(Options)]
VECTORS = ("x0", "p0")  # themselves lists: those of lists are swept


@dataclass(frozen=True)
class SweptRun:
    """One run of a sweep."""

    name: str  # of its folder
    changes: Mapping[str, Any]  # what is swept, and its value here
    options: Options

    def folder(self, within: Path) -> RunFolder:
        """Folder of the run, in that of the sweep; what it holds is checked to be of the same options."""
        folder = RunFolder(within / self.name)
        if (folder.path / "run.json").is_file():
            kept = Options.from_json(folder.read_json("run.json").get("options"))
            if kept != self.options:
                raise InputError("--output", f"{folder.path}, begun with other options", "a new folder")
        return folder


def read_sweep(path: str | Path) -> list[SweptRun]:
    """Runs that a TOML file states: options of ``ccdtools run``, of which lists are swept.

    Paths are relative to the file. Of `x0` and `p0` a list of lists is swept.

    Raises
    ------
    InputError
        If the file cannot be read, or a key or value is not one of those options, or repeats.
    """
    where = Path(path)
    try:
        given = tomllib.loads(where.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or " ".join(str(error).split())
        raise InputError("file", f"{str(path)[:80]}: {reason}", "a TOML file with options of `ccdtools run`") from None
    stated = {key.replace("-", "_"): value for key, value in given.items()}
    for key in stated:
        if key not in NAMES:
            raise InputError("file", f"the key {key!r}", f"one of {', '.join(NAMES)}", nearest(key, NAMES))
    if "study" not in stated:
        raise InputError("file", "no study", 'a line such as study = "suspension"')
    swept = {name: _values(name, value, where.resolve().parent) for name, value in stated.items()}
    several = [name for name, values in swept.items() if _is_swept(name, stated[name])]
    runs = []
    for values in product(*swept.values()):
        options = dict(zip(swept, values))
        changes = {name: options[name] for name in several}
        text = "_".join(f"{name}-{_text(value)}" for name, value in changes.items()) or "run"
        runs.append(SweptRun(re.sub(r"[^\w.,+=-]", "_", text), changes, Options(**options)))
    for name in several:
        texts = [_text(value) for value in swept[name]]
        if len(set(texts)) < len(texts):
            raise InputError("file", f"{name} = {', '.join(texts)}", "values that do not repeat")
    if len({run.name for run in runs}) < len(runs):
        raise InputError("file", "runs whose folders have one name", "values that differ by letters or digits")
    return runs


def _is_swept(name: str, value: Any) -> bool:
    """Whether a value is a list of values."""
    return isinstance(value, list) and (name not in VECTORS or any(isinstance(one, list) for one in value))


def _values(name: str, value: Any, folder: Path) -> list[Any]:
    """Values of an option, paths absolute."""
    values = value if _is_swept(name, value) else [value]
    if not values:
        raise InputError("file", f"{name} = []", "at least one value")
    path = name in FILES or name == "study"
    for one in values:
        if path and not isinstance(one, str):
            raise InputError("file", f"{name} = {shown(one)}", "text")
    return [str((folder / one).resolve()) if path and (name != "study" or one.endswith(".py")) else one
            for one in values]  # fmt: skip


def _text(value: Any) -> str:
    """Value in the name of a folder."""
    if isinstance(value, list):
        return ",".join(map(str, value))
    return Path(value).stem if isinstance(value, str) and "/" in value else str(value)


def tidy(runs: list[SweptRun], within: Path) -> str:
    """Gains of all runs by place and source as CSV, what is swept in the first columns."""
    rows = []
    for run in runs:
        with (run.folder(within).path / "gains.csv").open(encoding="utf-8", newline="") as file:
            rows += [{"run": run.name} | dict(run.changes) | row for row in csv.DictReader(file)]
    columns = list(dict.fromkeys(name for row in rows for name in row))
    out = io.StringIO()
    writer = csv.DictWriter(out, columns, lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    return out.getvalue()
