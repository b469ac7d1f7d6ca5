"""Compiled kernels of the exploration and of point location."""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path

NUMBERS = (Path(__file__).parents[2] / name for name in ("tolerances.py", "budgets.py"))
SOURCES = (*Path(__file__).parent.glob("*.py"), *NUMBERS)


def forget_stale(cache: str | None) -> None:
    """Remove what numba kept in a folder, if in any, before the last change of any kernel, tolerance or budget.

    Numba itself notices a change in the file of a function, not in what it calls and in the constants that it takes.
    """
    changed = max(source.stat().st_mtime for source in SOURCES)
    for kept in Path(cache).glob("*.nb[ci]") if cache else ():
        with suppress(OSError):  # another process may have been quicker
            if kept.stat().st_mtime < changed:
                kept.unlink()
