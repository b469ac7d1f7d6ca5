"""The public names of a package, stated once in the stub beside its `__init__.py`, each loaded when it is asked for."""

from __future__ import annotations

import ast
import sys
from collections.abc import Callable
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import Any


def front_door(package: str, file: str) -> tuple[list[str], Callable[[str], Any]]:
    """Public names of a package, sorted as in its stub, and its `__getattr__`."""
    tree = ast.parse(Path(file).with_suffix(".pyi").read_text(encoding="utf-8"))
    imports = (node for node in tree.body if isinstance(node, ast.ImportFrom))
    homes = {alias.name: node.module or "" for node in imports for alias in node.names}

    def load(name: str) -> Any:
        """Object of a public name, or a module of the package."""
        if name not in homes and not name.startswith("_") and find_spec(f"{package}.{name}") is not None:
            return import_module(f"{package}.{name}")
        if name not in homes:
            said = f"module {package!r} has no attribute {name!r}"
            raise AttributeError(said, name=name, obj=sys.modules[package])  # which Python compares with dir()
        return getattr(import_module(homes[name]), name)

    return sorted(homes), load
