"""Recorded roads, speeds and disturbances: CSV files read and checked once, at the door."""

from __future__ import annotations

import csv
import math
import re
from collections.abc import Sequence
from dataclasses import dataclass
from os import PathLike
from pathlib import Path
from typing import NoReturn, TypeAlias

import numpy as np
from numpy.typing import NDArray

from ccdtools.exceptions import InputError

__all__ = ["read_disturbance", "read_road", "read_speed"]

Array: TypeAlias = NDArray[np.float64]
FilePath: TypeAlias = str | PathLike[str]

TIME_COLUMNS = ("time", "t", "timestamp", "seconds")  # in any case, with or without a unit behind
SAMPLING_TOLERANCE = 1e-3  # relative to dt
KMH = 1 / 3.6  # one km/h in m/s


def read_disturbance(path: FilePath, *, dt: float, column: str | None = None, argument: str = "--disturbance") -> Array:
    """The recorded disturbance, one value per time step.

    Parameters
    ----------
    path : path
        CSV file with a header: one column of values, and possibly one of times [s]:
        `time`, `t`, `timestamp` or `seconds`, in any case, with or without a unit behind ("Time [s]").
    dt : float
        Time step the samples must have [s]; a time column is checked against it (relative tolerance 1e-3).
    column : str, optional
        Which column holds the disturbance; needed only if the file has several besides the time.
    argument : str
        How messages name this input.

    Returns
    -------
    (T,) array
        The column as recorded; for a road, its vertical velocity ż₀ [m/s].

    Raises
    ------
    InputError
        If the file, the column, a cell, the sampling or `dt` is not as described.
    """
    if not (math.isfinite(dt) and dt > 0):
        raise InputError(f"dt: got {dt} s, expected a finite number > 0; pass the time step of the model")
    table = _read_table(path, argument)
    name = column if column is not None else table.only_value_column()
    if _is_time(name):
        table.fail(f"column '{name}', which holds the times, expected the column of the disturbance")
    values = table.column(name)
    table.check_no_gap()
    for time_name in filter(_is_time, table.header):
        if time_name != name:
            _check_sampling(table, table.column(time_name), dt)
    return values


def read_road(path: FilePath, *, argument: str = "--road") -> tuple[Array, Array]:
    """The recorded road: distance [m], strictly increasing, and elevation [m].

    Parameters
    ----------
    path : path
        CSV file with the columns `distance` [m] and `elevation` [m].
    argument : str
        How messages name this input.

    Returns
    -------
    distance, elevation : (S,) arrays
        Both in [m].

    Raises
    ------
    InputError
        If the file, a column or a cell is not as described.
    """
    table = _read_table(path, argument)
    distance, elevation = table.column("distance"), table.column("elevation")
    table.check_increasing("distance", distance)
    return distance, elevation


def read_speed(path: FilePath, *, argument: str = "--speed") -> tuple[Array, Array]:
    """The recorded speed: time [s], strictly increasing, and speed, converted from km/h to m/s.

    Parameters
    ----------
    path : path
        CSV file with the columns `time` [s] and `speed` [km/h]; the sampling need not be equal.
    argument : str
        How messages name this input.

    Returns
    -------
    time, speed : (S,) arrays
        In [s] and [m/s].

    Raises
    ------
    InputError
        If the file, a column or a cell is not as described, or a speed is negative.
    """
    table = _read_table(path, argument)
    time, speed = table.column("time"), table.column("speed")
    table.check_increasing("time", time)
    if (speed < 0).any():
        row = int(np.argmax(speed < 0))
        table.fail(f"negative speed {speed[row]:g} km/h in line {table.lines[row]}, expected speed >= 0")
    return time, speed * KMH


@dataclass(frozen=True)
class _Table:
    """Rows of text under a header, with the line of the file each row came from."""

    argument: str
    path: Path
    header: tuple[str, ...]
    rows: tuple[Sequence[str], ...]
    lines: tuple[int, ...]

    def fail(self, text: str) -> NoReturn:
        """Raise one line that names the argument and the file."""
        raise InputError(f"{self.argument}: {self.path}: {text}")

    def only_value_column(self) -> str:
        """Name of the one column that is not the time."""
        names = [name for name in self.header if not _is_time(name)]
        if len(names) != 1:
            self.fail(
                f"{len(names)} columns that could be the disturbance (found {_listed(self.header)}),"
                " expected one besides the time; name the column, or remove the others"
            )
        return names[0]

    def check_no_gap(self) -> None:
        """Raise if a blank line stands for a sample: dropped, it would shift the rest of the recording by one.

        A time column shows by itself whether a sample is missing; blank lines after every row are double spacing.
        """
        steps = np.diff(self.lines)
        if any(_is_time(name) for name in self.header) or steps.max() == steps.min():
            return
        line = self.lines[int(np.argmax(steps > steps.min()))] + 1
        self.fail(f"a blank line {line}, expected one row per sample; fill in the sample, or remove the line")

    def column(self, name: str) -> Array:
        """The numbers of one column, every one finite."""
        if self.header.count(name) != 1:
            found = "several columns" if name in self.header else "no column"
            self.fail(f"{found} '{name}', found {_listed(self.header)}; expected one header '{name}' in the first line")
        index = self.header.index(name)
        return np.array([self._number(row[index], name, line) for row, line in zip(self.rows, self.lines)])

    def check_increasing(self, name: str, values: Array) -> None:
        """Raise unless every value is larger than the one before."""
        step = np.diff(values)
        if (step <= 0).any():
            row = int(np.argmax(step <= 0)) + 1
            self.fail(
                f"column '{name}' goes from {values[row - 1]:g} to {values[row]:g} in line {self.lines[row]},"
                " expected strictly increasing values; sort the rows and remove duplicates"
            )

    def _number(self, cell: str, name: str, line: int) -> float:
        try:
            value = float(cell) if "_" not in cell else math.nan  # Python reads "1_0" as 10
        except ValueError:
            value = math.nan
        if not math.isfinite(value):
            self.fail(
                f"{cell.strip()[:40]!r} in column '{name}', line {line}, expected a finite number;"
                " fill or remove the row"
            )
        return value


def _read_table(path: FilePath, argument: str) -> _Table:
    """Header and rows of a CSV file with at least two rows of data."""
    path = Path(path)
    numbered = [(line, row) for line, row in _read_rows(path, argument) if any(cell.strip() for cell in row)]
    if not numbered:
        raise InputError(f"{argument}: {path}: the file is empty, expected a CSV file: a header, then numbers")
    header = tuple(cell.strip() for cell in numbered[0][1])
    lines, rows = tuple(line for line, _ in numbered[1:]), tuple(row for _, row in numbered[1:])
    table = _Table(argument, path, header, rows, lines)
    if all(_is_number(name) for name in header):
        table.fail(f"no header, the first line is {_listed(header)}; expected column names there")
    if len(rows) < 2:
        table.fail(f"got {len(rows)} rows below the header ({_listed(header)}), expected at least 2")
    for line, row in zip(lines, rows):
        if len(row) != len(header):
            table.fail(f"{len(row)} cells in line {line}, expected {len(header)} ({_listed(header)})")
    return table


def _read_rows(path: Path, argument: str) -> list[tuple[int, list[str]]]:
    """Every row of the file with its line number, or one clear line why there is none."""
    try:
        with path.open(newline="", encoding="utf-8-sig") as file:
            reader = csv.reader(file)
            return [(reader.line_num, row) for row in reader]
    except FileNotFoundError:
        raise InputError(f"{argument}: no such file: {path}; expected the path of a CSV file") from None
    except OSError as error:
        reason = error.strerror or type(error).__name__
        raise InputError(f"{argument}: cannot read {path}: {reason}; expected a readable CSV file") from None
    except (UnicodeDecodeError, csv.Error, ValueError) as error:
        reason = "not UTF-8 text" if isinstance(error, UnicodeDecodeError) else str(error)
        raise InputError(f"{argument}: cannot read {path}: {reason}; expected a CSV file in UTF-8") from None


def _check_sampling(table: _Table, time: Array, dt: float) -> None:
    """Raise unless `time` advances by equal steps, and these are `dt`."""
    step = np.diff(time)
    typical = float(np.median(step))
    unequal = np.abs(step - typical) > SAMPLING_TOLERANCE * abs(typical)
    if unequal.any() or typical <= 0:
        row = int(np.argmax(unequal | (step <= 0))) + 1
        table.fail(
            f"unequal sampling: a step of {step[row - 1]:g} s in line {table.lines[row]},"
            f" expected {dt:g} s throughout; resample the file at equal steps"
        )
    if abs(typical - dt) > SAMPLING_TOLERANCE * dt:
        table.fail(f"sampled every {typical:g} s, expected dt = {dt:g} s; resample the file at {dt:g} s")


def _is_time(name: str) -> bool:
    return re.sub(r"[\[(].*", "", name).strip().lower() in TIME_COLUMNS


def _is_number(cell: str) -> bool:
    try:
        float(cell)
    except ValueError:
        return False
    return True


def _listed(names: Sequence[str]) -> str:
    shown = ", ".join(repr(name[:40]) for name in names[:12])
    return shown if len(names) <= 12 else f"{shown}, … ({len(names)} columns)"
