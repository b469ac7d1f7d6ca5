"""Messages about a user's function that stops, a CasADi function among others."""

from __future__ import annotations

import inspect
import re
import traceback
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from ccdtools_ground.door import brief
from ccdtools_ground.errors import CCDError, InputError, SimulatorError

CASADI = re.compile(r'^\.\.\./casadi/\S+:\d+: (?:Assertion ".*?" failed:\s)?')
KNOWN = (
    (r"Slice \(start=(\d+), stop=\d+, step=1\) out of bounds with supplied length of (\d+)",
     "index {0} beyond a column of {1}", "Entries are counted from 0."),
    (r"getScalar: out of bounds", "an index beyond a column",
     "Entries are counted from 0, and from the end by −1, −2, …"),
    (r"Got elements in range \[(\S+)\], which is outside the range \[\S+,(\d+)\)",
     "indices {0} beyond a column of {1}", "Entries are counted from 0."),
    (r"incompatible dimensions. Lhs is (\S+) and rhs is (\S+?)\.?$", "a product of {0} and {1}",
     "A product of two columns is ca.dot(a, b), a square ca.sumsqr(x)."),
    (r"truth value", "a choice by the value of a symbol (if, and, or, min, max, abs)",
     "Use ca.if_else, ca.logic_and, ca.fmin, ca.fmax, ca.fabs."),
    (r"Notify the CasADi developers|must be real number, not (?:SX|MX)|__float__",
     "float(), or a function of math, of a symbol", "Use ca.sin and the like instead of math.sin."),
)  # fmt: skip


def stopped(argument: str, given: Any, error: Exception, expected: str, cure: str = "", *, at: str = "") -> InputError:
    """Error that replaces the one a user's function stopped with."""
    reason, own = in_words(error)
    cure = f"{own} {cure}".strip()
    return InputError(argument, f"a function that stops with {reason}{at}{_line(given, error)}", expected, cure)


@contextmanager
def at_step(k: int, argument: str = "plant") -> Iterator[None]:
    """Raise what stops in a step as a `SimulatorError` that names the step."""
    try:
        yield
    except Exception as error:
        if isinstance(error, CCDError | MemoryError) and not isinstance(error, InputError):
            raise
        reason = f"a step that stops with {in_words(error)[0]}"
        own = error if isinstance(error, InputError) else InputError(argument, reason, "an answer")
        named = SimulatorError(own.argument, own.got, own.expected, own.cure)
        named.step = k
        raise named from error


def in_words(error: Exception) -> tuple[str, str]:
    """Message of a CasADi error without file names, and its cure."""
    text = " ".join(CASADI.sub("", str(error), count=1).split())
    for pattern, words, cure in KNOWN:
        found = re.search(pattern, text)
        if found:
            return brief(words.format(*found.groups())), cure
    if isinstance(error, RuntimeError) and "casadi" in str(error):  # what was called stands above what went wrong
        last = CASADI.sub("", (str(error).splitlines() or [type(error).__name__])[-1])
        return brief(last).rstrip("."), ""
    return brief(f"{type(error).__name__}: {text}"), ""


def _line(given: Any, error: Exception) -> str:
    """Line in the file of a function where an error arose."""
    code = getattr(inspect.unwrap(given), "__code__", None)
    frames = traceback.extract_tb(error.__traceback__)
    own = [frame for frame in frames if code is not None and frame.filename == code.co_filename]
    return f" (line {own[-1].lineno} of {Path(own[-1].filename).name})" if own else ""
