"""Packages of this distribution, and files that hide them."""

from __future__ import annotations

from importlib.util import find_spec
from pathlib import Path

NAMES = ("ccdtools", "ccdtools_ground", "invariant_sets", "learning", "mpc")


def what_hides_ours() -> str:
    """Advice on the first file or folder that hides a package; empty if none."""
    home = Path(__file__).resolve().parents[1]
    for name in NAMES:
        try:
            spec = find_spec(name)
        except ValueError:  # a module without a specification, such as one that a test has made
            continue
        own = (home / name).resolve()
        if spec is None or not own.is_dir():
            continue
        folders = spec.submodule_search_locations or [""]  # of a folder without __init__.py, which has no origin
        found = Path(spec.origin or f"{next(iter(folders))}/__init__.py").resolve()
        if found.parent != own:
            file = found.parent if found.name == "__init__.py" else found
            return f"{file} hides the package `{name}` that ccdtools is made of. Rename it, or run from another folder."
    return ""
