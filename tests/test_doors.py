"""Tests of behaviour speak through what users import; those that need inner names stand in `tests/inner`."""

import ast
from importlib import import_module
from pathlib import Path

import ccdtools

TESTS = Path(__file__).parent
DOORS = (
    "ccdtools", *(f"ccdtools.{group}" for group in ccdtools.GROUPS), "ccdtools.cli", "ccdtools.plants.library",
    "ccdtools.studies", "invariant_sets",
    "invariant_sets.exceptions", "learning", "learning.exceptions", "mpc", "mpc.exceptions", "mpc.optimal_control",
    "mpc.optimal_control.estimation",
)  # fmt: skip
PACKAGES = {door.split(".")[0] for door in DOORS}


def imported(tree: ast.Module):
    """Yield what a file imports from the packages or replaces in them: (module, name or None)."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute) and node.func.attr == "setattr":
            places = [part.value for part in node.args[:1] if isinstance(part, ast.Constant)]
            yield from (tuple(place.rsplit(".", 1)) for place in places if place.split(".")[0] in PACKAGES)
        if isinstance(node, ast.Import):
            yield from ((alias.name, None) for alias in node.names if alias.name.split(".")[0] in PACKAGES)
        if isinstance(node, ast.ImportFrom) and node.module and node.module.split(".")[0] in PACKAGES:
            yield from ((node.module, alias.name) for alias in node.names)


def is_public(module: str, name: str | None) -> bool:
    """Whether users may import that."""
    if name is None or f"{module}.{name}" in DOORS or module not in DOORS:
        return module in DOORS or f"{module}.{name}" in DOORS
    door = import_module(module)
    exported = getattr(door, "__all__", None) or [word for word in vars(door) if not word.startswith("_")]
    return name in exported


def test_tests_outside_inner_import_public_names_alone():
    """Move the test to `tests/inner`, or let it speak through what users import."""
    inner = {}
    for path in TESTS.rglob("*.py"):
        if TESTS / "inner" not in path.parents:
            names = imported(ast.parse(path.read_text(encoding="utf-8")))
            inner[path.relative_to(TESTS).as_posix()] = [name for name in names if not is_public(*name)]
    assert {path: names for path, names in inner.items() if names} == {}
