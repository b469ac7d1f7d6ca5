"""Which test enters which function of the library: a plugin of pytest, ``python -m pytest -p reach_of_tests``.

Every process of the tests writes what it saw into ``$REACH.<its number>``, one line of JSON a test: its name, the
processor seconds it took, whether it is quick, whether it passed, and every function that it or one of its fixtures
entered, as ``file:first line``. What a test does in another process is not seen; that it started one is.
"""

import json
import os
import subprocess
import sys
import threading
import time
from collections import defaultdict
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
PACKAGES = ("ccdtools", "mpc", "invariant_sets", "learning")
CHILDREN = "a child process"  # stands for what a test runs in another process
OUT = os.environ.get("REACH", "reach")

_entered: list[dict] = [{}]  # code that was entered, by number: one recording in another
_of_fixture: dict[str, set[str]] = defaultdict(set)
_names: dict[int, tuple[object, str | None]] = {}
_failed: set[str] = set()


def _traced(frame, event, arg):
    code = frame.f_code
    _entered[-1][id(code)] = code


def _name(code) -> str | None:
    """Return ``file:first line`` of a function of the library; the code is kept, so that no other takes its number."""
    if id(code) not in _names:
        path = Path(code.co_filename)
        inside = path.is_relative_to(ROOT) and path.relative_to(ROOT).parts[0] in PACKAGES
        _names[id(code)] = code, f"{path.relative_to(ROOT).as_posix()}:{code.co_firstlineno}" if inside else None
    return _names[id(code)][1]


def _left() -> set[str]:
    """Close the innermost recording: the names of what was entered in it."""
    return {name for code in _entered.pop().values() if (name := _name(code)) is not None}


@pytest.hookimpl(hookwrapper=True)
def pytest_fixture_setup(fixturedef, request):
    """What a fixture enters counts for every test that asks for it, also where it was made before."""
    _entered.append({})
    yield
    inner = dict(_entered[-1])
    _of_fixture[f"{fixturedef.baseid}::{fixturedef.argname}"] |= _left()
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
    _entered.append({})
    clock = time.process_time()
    threading.settrace(_traced)
    sys.settrace(_traced)
    yield
    sys.settrace(None)
    threading.settrace(None)
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
