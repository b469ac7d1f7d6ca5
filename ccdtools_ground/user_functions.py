"""Messages about a user's function that stops, a CasADi function among others."""

from __future__ import annotations

import inspect
import re
import traceback
from pathlib import Path
from typing import Any

from ccdtools_ground.door import brief
from ccdtools_ground.errors import InputError, SimulatorError

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


def at_step(k: int, error: InputError) -> SimulatorError:
    """Error of a simulator or environment that names the step."""
    named = SimulatorError(error.argument, error.got, error.expected, error.cure)
    named.step = k
    return named


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
