"""What one task of an experiment found, kept in one file."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping
from dataclasses import dataclass, field
from hashlib import sha256
from pathlib import Path
from typing import Any
from uuid import uuid4

import numpy as np

from ccdtools.arrays import Array, Immutable, Mask
from ccdtools.exceptions import InputError

ARRAYS = ("returns", "lost", "fraction", "peak", "times", "series")
WORDS = ("scenario", "plant", "exceeded", "single", "design_cost", "metrics")


@dataclass(frozen=True, eq=False)
class Cell(Immutable):
    """One controller, design and seed on one scenario and plant."""

    scenario: str
    plant: str
    returns: Array  # (N,): of the runs
    lost: Mask  # (N,)
    fraction: Array  # (n,): part of the states outside the limits, of the runs or of the stretches of a single one
    peak: Array  # (n,): largest depth in half-widths
    exceeded: str  # the limit that is exceeded most
    single: bool  # whether there is one run
    times: Array  # (k,): of single calls of the controller [s]
    series: Array  # (T,): rewards of a single run with a disturbance; empty otherwise
    design_cost: float  # part of every return that the design costs
    metrics: Mapping[str, float]


@dataclass(frozen=True, eq=False)
class Record:
    """One controller made for one design with one seed."""

    controller: str
    design: str
    seed: int
    cells: tuple[Cell, ...] = field(default=())  # without those in which the controller was refused
    seconds: float = float("nan")  # that it took to be made
    steps: int = 0  # samples of the environment that it was trained on
    refused: str = ""  # why there is no controller, or none in some scenario
    remark: str = ""  # what the controller says of itself
    about: str = ""  # the controller in words
    c_step_time: float = float("nan")  # median of its exported C [s], where it was asked for and exists
    c_step_time_99: float = float("nan")  # 99th percentile


def digest(*parts: Any) -> str:
    """Name made of the bytes of arrays and of the texts of all else."""
    found = sha256()
    for part in parts:
        array = isinstance(part, np.ndarray)
        found.update((repr(part.shape) if array else repr(part)).encode() + b"\0")
        found.update(np.ascontiguousarray(part).tobytes() if array else b"")
    return found.hexdigest()[:24]


def write_record(file: Path, record: Record) -> None:
    """Write a record whole or not at all."""
    about = {name: value for name, value in vars(record).items() if name != "cells"}
    about["cells"] = [{name: getattr(cell, name) for name in WORDS} for cell in record.cells]
    arrays = {f"{i}.{name}": getattr(cell, name) for i, cell in enumerate(record.cells) for name in ARRAYS}
    partial = file.with_suffix(f".{uuid4().hex}.partial")
    with partial.open("wb") as stream:
        np.savez(stream, about=np.array(json.dumps(about)), **arrays)
    os.replace(partial, file)


def read_record(file: Path) -> Record:
    """Record of a file.

    Raises
    ------
    InputError
        If it holds none.
    """
    try:
        with np.load(file, allow_pickle=False) as found:
            about = json.loads(str(found["about"]))
            cells = tuple(
                Cell(**words, **{name: found[f"{i}.{name}"] for name in ARRAYS})
                for i, words in enumerate(about.pop("cells"))
            )
            return Record(**about, cells=cells)
    except Exception as error:
        got = f"{file}, which cannot be read ({type(error).__name__})"
        raise InputError("folder", got, "records of an experiment", "Delete that file: its task runs again.") from None
