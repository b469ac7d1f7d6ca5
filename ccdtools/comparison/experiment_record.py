"""What one task of an experiment found, kept in one file."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from uuid import uuid4

import numpy as np

from ccdtools.arrays import Array, Immutable, Indices, Mask
from ccdtools.exceptions import InputError

ARRAYS = ("returns", "lost", "fractions", "peaks", "times", "series", "rows")
WORDS = ("scenario", "plant", "texts", "single", "design_cost", "metrics", "stopped", "idle")


@dataclass(frozen=True, eq=False)
class Cell(Immutable):
    """One controller, design and seed on one scenario and plant."""

    scenario: str
    plant: str
    returns: Array  # (N,): of the runs; NaN of one that stopped
    lost: Mask  # (N,): diverged, or stopped
    # Part of the states outside and largest depth in half-widths, of the runs or of the stretches of a single one,
    # (k, n): of all limits, then of each of several kinds; and the limit that is exceeded most by each.
    fractions: Array
    peaks: Array
    rows: Indices
    texts: Sequence[Sequence[str]]  # of the limits of each kind
    single: bool  # whether there is one run
    times: Array  # (k,): of single calls of the controller [s]
    series: Array  # (T,): rewards of a single run with a disturbance; empty otherwise
    design_cost: float  # part of every return that the design costs
    metrics: Mapping[str, float]
    stopped: str  # why there is no controller, or a run stopped
    idle: bool  # whether all inputs were 0

    @property
    def undefined(self) -> Indices:
        """Runs (k,) that were not lost, and whose return is no number."""
        return np.flatnonzero(~self.lost & ~np.isfinite(self.returns))


@dataclass(frozen=True, eq=False)
class Record:
    """One controller made for one design with one seed."""

    controller: str
    design: str
    seed: int
    cells: tuple[Cell, ...]  # of every scenario and plant
    seconds: float = float("nan")  # that it took to be made; NaN of one that could not
    steps: int = 0  # samples of the environment that it was trained on
    remark: str = ""  # what the controller says of itself
    about: str = ""  # the controller in words
    c_step_time: float = float("nan")  # median of its exported C [s], where it was asked for and exists
    c_step_time_99: float = float("nan")  # 99th percentile

    @property
    def made(self) -> bool:
        """Whether there is a controller."""
        return bool(np.isfinite(self.seconds))


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
