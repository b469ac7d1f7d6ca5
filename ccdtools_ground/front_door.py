"""Lazy public names of a package, stated in its stub."""

from __future__ import annotations

import ast
import sys
from collections.abc import Callable, Sequence
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import Any


def front_door(
    package: str, file: str, groups: Sequence[str] = ()
) -> tuple[list[str], Callable[[str], Any], Callable[[], list[str]]]:
    """Sorted public names of a package, with its `__getattr__` and `__dir__`.

    A name that only a group has, one of the modules in the package, is found there, too.
    """
    tree = ast.parse(Path(file).with_suffix(".pyi").read_text(encoding="utf-8"))
    imports = (node for node in tree.body if isinstance(node, ast.ImportFrom))
    homes = {alias.name: node.module or "" for node in imports for alias in node.names}

    def load(name: str) -> Any:
        """Object of a public name, or a module of the package."""
        if name in homes:
            value = getattr(import_module(homes[name]), name)
            setattr(sys.modules[package], name, value)  # found at once from now on
            return value
        if not name.startswith("_"):
            if find_spec(f"{package}.{name}") is not None:
                return import_module(f"{package}.{name}")
            for group in (import_module(f"{package}.{one}") for one in groups):
                if name in group.__all__:
                    return getattr(group, name)
        said = f"module {package!r} has no attribute {name!r}"
        raise AttributeError(said, name=name, obj=sys.modules[package])  # which Python compares with dir()

    names = sorted(homes)
    return names, load, lambda: sorted([*names, *groups])
