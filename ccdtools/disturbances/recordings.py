"""CSV files of recorded roads, speeds and disturbances, checked when read."""

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

from ccdtools.arrays import Array
from ccdtools.disturbances.tolerances import SAMPLING
from ccdtools.exceptions import InputError
from ccdtools_ground.door import as_positive, shown

FilePath: TypeAlias = str | PathLike[str]

TIME_COLUMNS = ("time", "t", "timestamp", "seconds")  # in any case, with or without a unit behind


def read_disturbance(path: FilePath, *, dt: float, column: str | None = None, argument: str = "path") -> Array:
    """Recorded disturbance, one value per time step.

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
    as_positive("dt", dt, unit="s")
    if column is not None and not isinstance(column, str):
        raise InputError("column", shown(column), "the name of a column")
    table = _read_table(path, argument)
    name = column if column is not None else table.only_value_column()
    if _is_time(name):
        table.fail(f"column '{name}', which holds the times", "the column of the disturbance")
    values = table.column(name)
    table.check_no_gap()
    for time_name in filter(_is_time, table.header):
        if time_name != name:
            _check_sampling(table, table.column(time_name), dt)
    return values


def read_road(path: FilePath, *, argument: str = "path") -> tuple[Array, Array]:
    """Recorded road: strictly increasing distance [m], and elevation [m].

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
    distance = table.column("distance")
    elevation = table.column("elevation")
    table.check_increasing("distance", distance)
    return distance, elevation


def read_speed(path: FilePath, *, argument: str = "path") -> tuple[Array, Array]:
    """Recorded speed: strictly increasing time [s], and speed [m/s] from [km/h].

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
    time = table.column("time")
    speed = table.column("speed")
    table.check_increasing("time", time)
    if (speed < 0).any():
        row = int(np.argmax(speed < 0))
        table.fail(f"negative speed {speed[row]:g} km/h in line {table.lines[row]}", "speeds ≥ 0")
    return time, speed * (1 / 3.6)  # km/h in m/s


@dataclass(frozen=True)
class _Table:
    """Rows of text under a header, with their file line numbers."""

    argument: str
    path: Path
    header: tuple[str, ...]
    rows: tuple[Sequence[str], ...]
    lines: tuple[int, ...]

    def fail(self, got: str, expected: str, cure: str = "") -> NoReturn:
        """Raise an `InputError` that names argument and file, with advice on format."""
        raise InputError(self.argument, f"{self.path}: {got}", expected, self._unusual() or cure)

    def _unusual(self) -> str:
        """Advice about a file that is not plain CSV, or empty."""
        written = "\n".join(",".join(row) for row in (self.header, *self.rows[:20]))
        if written.startswith("#") or "\n#" in written:
            return "Remove # and what follows it: a first line with the names of the columns is read, comments are not."
        cells = [cell for row in self.rows[:20] for cell in row]
        spaced = any(len(cell.split()) > 1 and all(map(_is_number, cell.split())) for cell in cells)
        names = "".join(self.header)
        for found, name in (("\t" in names, "tabs"), (";" in names, "semicolons"), (spaced, "spaces")):
            if found:
                return f"Separate the columns by commas, not {name}, and write decimals with a point."
        size = len(self.header)
        twice = {2 * size, 2 * size - any(map(_is_time, self.header))} - {size}  # cells of a row; times may be whole
        decimal = any("," in cell and _is_number(cell.replace(",", ".")) for cell in cells)
        decimal |= any(len(row) in twice for row in self.rows[:20])
        return "Write decimals with a point: a comma separates columns." if decimal else ""

    def only_value_column(self) -> str:
        """Name of the only column besides the time."""
        names = [name for name in self.header if not _is_time(name)]
        if len(names) != 1:
            self.fail(
                f"{len(names)} columns that could be the disturbance (found {_listed(self.header)})",
                "one besides the time", "Name the column, or remove the others.",
            )  # fmt: skip
        return names[0]

    def check_no_gap(self) -> None:
        """Raise if a blank line stands for a sample and would shift the rest.

        A time column shows by itself whether a sample is missing; blank lines after every row are double spacing.
        """
        steps = np.diff(self.lines)
        if any(_is_time(name) for name in self.header) or steps.max() == steps.min():
            return
        line = self.lines[int(np.argmax(steps > steps.min()))] + 1
        self.fail(f"a blank line {line}", "one row per sample", "Fill in the sample, or remove the line.")

    def column(self, name: str) -> Array:
        """Numbers of one column, every one finite."""
        if self.header.count(name) != 1:
            found = "several columns" if name in self.header else "no column"
            self.fail(f"{found} '{name}' among {_listed(self.header)}", f"one header '{name}' in the first line")
        index = self.header.index(name)
        return np.array([self._number(row[index], name, line) for row, line in zip(self.rows, self.lines)])

    def check_increasing(self, name: str, values: Array) -> None:
        """Raise unless values increase strictly."""
        step = np.diff(values)
        if (step <= 0).any():
            row = int(np.argmax(step <= 0)) + 1
            self.fail(
                f"column '{name}' going from {values[row - 1]:g} to {values[row]:g} in line {self.lines[row]}",
                "strictly increasing values", "Sort the rows and remove duplicates.",
            )  # fmt: skip

    def _number(self, cell: str, name: str, line: int) -> float:
        try:
            value = float(cell) if "_" not in cell else math.nan  # Python reads "1_0" as 10
        except ValueError:
            value = math.nan
        if not math.isfinite(value):
            cell = repr(cell.strip()[:40])
            self.fail(f"{cell} in column '{name}', line {line}", "a finite number", "Fill or remove the row.")
        return value


def _read_table(path: FilePath, argument: str) -> _Table:
    """Header and at least two rows of a CSV file."""
    if not isinstance(path, str | PathLike) or not str(path):
        raise InputError(argument, shown(path), "the path of a CSV file")
    path = Path(path)
    numbered = [(line, row) for line, row in _read_rows(path, argument) if any(cell.strip() for cell in row)]
    if not numbered:
        raise InputError(argument, f"{path}, which is empty", "a CSV file: a header, then numbers")
    header = tuple(cell.strip() for cell in numbered[0][1])
    lines = tuple(line for line, _ in numbered[1:])
    rows = tuple(row for _, row in numbered[1:])
    table = _Table(argument, path, header, rows, lines)
    if all(_is_number(name) for name in header):
        table.fail(f"no header, but {_listed(header)} in the first line", "column names there")
    if len(rows) < 2:
        table.fail(f"{len(rows)} rows below the header ({_listed(header)})", "at least 2")
    for line, row in zip(lines, rows):
        if len(row) != len(header):
            table.fail(f"{len(row)} cells in line {line}", f"{len(header)} ({_listed(header)})")
    return table


def _read_rows(path: Path, argument: str) -> list[tuple[int, list[str]]]:
    """Rows of the file with line numbers, or a clear `InputError`."""
    try:
        with path.open(newline="", encoding="utf-8-sig") as file:
            reader = csv.reader(file)
            return [(reader.line_num, row) for row in reader]
    except FileNotFoundError:
        raise InputError(argument, f"{path}, which does not exist", "the path of a CSV file") from None
    except OSError as error:
        reason = error.strerror or type(error).__name__
        raise InputError(argument, f"{path}, which cannot be read ({reason})", "a readable CSV file") from None
    except (UnicodeDecodeError, csv.Error, ValueError) as error:
        reason = "not UTF-8 text" if isinstance(error, UnicodeDecodeError) else str(error)
        raise InputError(argument, f"{path}, which cannot be read ({reason})", "a CSV file in UTF-8") from None


def _check_sampling(table: _Table, time: Array, dt: float) -> None:
    """Raise unless `time` advances by equal steps of `dt`."""
    step = np.diff(time)
    typical = float(np.median(step))
    unequal = np.abs(step - typical) > SAMPLING * abs(typical)
    if unequal.any() or typical <= 0:
        row = int(np.argmax(unequal | (step <= 0))) + 1
        table.fail(
            f"unequal sampling: a step of {step[row - 1]:g} s in line {table.lines[row]}",
            f"{dt:g} s throughout", "Resample the file at equal steps.",
        )  # fmt: skip
    if abs(typical - dt) > SAMPLING * dt:
        table.fail(f"samples every {typical:g} s", f"dt = {dt:g} s", f"Resample the file at {dt:g} s.")


def _is_time(name: str) -> bool:
    return re.sub(r"[\[(].*", "", name).strip().lower() in TIME_COLUMNS


def _is_number(cell: str) -> bool:
    try:
        float(cell)
    except ValueError:
        return False
    return True


def _listed(names: Sequence[str]) -> str:
    """First dozen names, as a message lists them."""
    listed = ", ".join(repr(name[:40]) for name in names[:12])
    return listed if len(names) <= 12 else f"{listed}, … ({len(names)} columns)"
