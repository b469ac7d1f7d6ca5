"""Tables that are asked for: each row by the scripts that measure it, one after the other.

``python benchmarks/bench_learning.py --table FOLDER [ROW ...]`` and ``bench_comparison.py`` do so. What a command has
printed is kept in the folder, and is not run again; ``--list`` prints rows and commands alone.
"""

from __future__ import annotations

import os
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

HERE = Path(__file__).resolve().parent


@dataclass(frozen=True)
class Row:
    """A row: its name, what it is held against and what is asked, and the command lines that measure it."""

    name: str
    asked: str
    commands: tuple[str, ...]


def printed(rows: tuple[Row, ...], folder: Path | None, only: list[str]) -> None:
    """Print rows, all or some, with what their commands print; without a folder the commands alone."""
    for row in rows:
        if only and row.name not in only:
            continue
        print(f"\n## {row.name}: {row.asked}", flush=True)
        for number, command in enumerate(row.commands):
            print(f"\n$ python benchmarks/{command}", flush=True)
            if folder is not None:
                print(_output(command, folder / f"{row.name.replace(' ', '_')}-{number}-{_commit()}.txt"), flush=True)


def _commit() -> str:
    """Commit at which the rows are measured, so that the output of another one does not stand for it."""
    found = subprocess.run(["git", "rev-parse", "--short=8", "HEAD"], cwd=HERE, capture_output=True, text=True)
    return found.stdout.strip() or "unknown"


def _output(command: str, kept: Path) -> str:
    """What a command prints, or has printed into a file; of one that fails the end of its errors, which is not kept."""
    if not kept.is_file():
        kept.parent.mkdir(parents=True, exist_ok=True)
        path = os.pathsep.join([str(HERE.parent), *filter(None, [os.environ.get("PYTHONPATH")])])
        own = os.environ | {"PYTHONPATH": path, "OMP_NUM_THREADS": "1"}
        done = subprocess.run([sys.executable, *command.split()], cwd=HERE, env=own, capture_output=True, text=True)
        if done.returncode:
            return f"failed with {done.returncode}:\n{done.stderr[-2000:]}"
        kept.write_text(done.stdout)
    return kept.read_text()
