"""Compiled kernels of the exploration and of point location."""

from pathlib import Path

SOURCES = (*Path(__file__).parent.glob("*.py"), Path(__file__).parents[2] / "tolerances.py")


def forget_stale(cache: str) -> None:
    """Remove what numba has kept in a folder from before the last change of any kernel or tolerance.

    Numba itself notices a change of the file of a function, not of what that function calls and which constants it takes.
    """
    changed = max(source.stat().st_mtime for source in SOURCES)
    for kept in Path(cache).glob("*.nb[ci]"):
        if kept.stat().st_mtime < changed:
            kept.unlink(missing_ok=True)
