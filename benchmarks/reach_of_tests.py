"""Which test enters which function of the library: a plugin of pytest, ``python -m pytest -p reach_of_tests``.

Every process of the tests writes what it saw into ``$REACH.<its number>``, one line of JSON a test: its name, the
processor seconds it took, whether it is quick, whether it passed, and every function that it or one of its fixtures
entered, as ``file:first line``. What a test does in another process is not seen; that it started one is. It is for a
copy of the tree in which every function says that it was entered (`told`).
"""

import ast
import builtins
import json
import os
import subprocess
import time
from collections import defaultdict

import pytest

PACKAGES = ("ccdtools", "mpc", "invariant_sets", "learning")
CHILDREN = "a child process"  # stands for what a test runs in another process
OUT = os.environ.get("REACH", "reach")

_entered: list[set[str]] = [set()]  # names that were entered: one recording in another
_of_fixture: dict[str, set[str]] = defaultdict(set)
_failed: set[str] = set()


def told(source: str, name: str) -> str:
    """The source of a file in which every function says first that it was entered, as ``name:first line``."""
    lines, tree = source.split("\n"), ast.parse(source)
    heads: dict[int, list[str]] = defaultdict(list)  # what to put before a line
    for node in ast.walk(tree):
        compiled = any("jit" in ast.unparse(d) for d in getattr(node, "decorator_list", []))  # sees no Python
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef) and not compiled:
            first = next((part for part in node.body if not _is_text(part)), None)
            at = min([node.lineno, *(d.lineno for d in node.decorator_list)])
            if first is not None and first.lineno > node.lineno:
                line = min([first.lineno, *(d.lineno for d in getattr(first, "decorator_list", []))])
                if not lines[line - 1][: first.col_offset].strip():  # not behind the colon
                    heads[line].append(f'{" " * first.col_offset}_entered_("{name}:{at}")')
    first = next((p for p in tree.body if not _is_text(p) and getattr(p, "module", "") != "__future__"), None)
    if first is not None:
        line = min([first.lineno, *(d.lineno for d in getattr(first, "decorator_list", []))])
        heads[line].insert(0, 'import builtins; builtins.__dict__.setdefault("_entered_", set().add)')
    return "\n".join(text for i, line in enumerate(lines, 1) for text in (*heads[i], line))


def _is_text(node) -> bool:
    return isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant) and isinstance(node.value.value, str)


def _open(names: set[str]) -> None:
    """Begin a recording within the present one, or go on with it."""
    _entered.append(names)
    builtins._entered_ = names.add


def _left() -> set[str]:
    """Close the innermost recording: the names of what was entered in it."""
    names = _entered.pop()
    builtins._entered_ = _entered[-1].add
    return names


@pytest.hookimpl(hookwrapper=True)
def pytest_fixture_setup(fixturedef, request):
    """What a fixture enters counts for every test that asks for it, also where it was made before."""
    _open(set())
    yield
    inner = _left()
    _of_fixture[f"{fixturedef.baseid}::{fixturedef.argname}"] |= inner
    _entered[-1].update(inner)


def pytest_runtest_logreport(report):
    """Remember which tests failed."""
    if report.failed:
        _failed.add(report.nodeid)


@pytest.hookimpl(hookwrapper=True)
def pytest_runtest_protocol(item):
    """Record what one test enters."""
    start_process = subprocess.Popen.__init__
    started = []

    def watched(self, *args, **kwargs):
        started.append(True)
        start_process(self, *args, **kwargs)

    subprocess.Popen.__init__ = watched
    _open(set())
    clock = time.process_time()
    yield
    subprocess.Popen.__init__ = start_process
    entered = _left()
    for name in item.fixturenames:
        for definition in item._fixtureinfo.name2fixturedefs.get(name, ()):
            entered |= _of_fixture[f"{definition.baseid}::{definition.argname}"]
    if started:
        entered.add(CHILDREN)
    row = {
        "test": item.nodeid, "seconds": time.process_time() - clock, "passed": item.nodeid not in _failed,
        "quick": not any(item.get_closest_marker(name) for name in ("check", "slow")), "entered": sorted(entered),
    }  # fmt: skip
    with open(f"{OUT}.{os.getpid()}", "a", encoding="utf-8") as file:
        file.write(json.dumps(row) + "\n")
