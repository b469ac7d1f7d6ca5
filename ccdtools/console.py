"""Output of the command line, on one line and in plain characters."""

from __future__ import annotations

import codecs
import errno
import sys
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from ccdtools_ground.door import nearest
from ccdtools_ground.errors import CCDError

PLAIN = {
    "→": "->", "⁺": "+", "−": "-", "…": "...", "·": "*", "×": "x", "≤": "<=", "≥": ">=", "“": '"', "”": '"',
    "’": "'", "–": "-", "₀": "0", "₁": "1", "₂": "2", "∞": "inf", "ż": "dz", "ᵀ": "'", "µ": "u",
}  # fmt: skip
SUPERSCRIPTS = dict(zip("⁻⁰¹²³⁴⁵⁶⁷⁸⁹", "-0123456789"))
UNWRITABLE = (errno.ENOSPC, errno.EDQUOT, errno.EROFS, errno.EACCES, errno.EPERM)
EXPECTED = {
    "study": "the name of a study, or a Python file",
    "folder": "the folder of a run",
    "name": "a name for the study file",
}


def plain_where_needed() -> None:
    """Make standard streams replace characters that their encoding lacks."""
    codecs.register_error("ccdtools.plain", _in_plain)
    for stream in (sys.stdout, sys.stderr):
        reconfigure = getattr(stream, "reconfigure", None)
        if reconfigure is not None:
            reconfigure(errors="ccdtools.plain")


@contextmanager
def warnings_on_one_line() -> Iterator[None]:
    """Print each warning once, on one line, without its place in the source."""
    printed: set[str] = set()

    def show(message: Warning | str, *place: Any) -> None:
        line = f"ccdtools: warning: {' '.join(str(message).split())}"
        if line not in printed:
            print(line, file=sys.stderr)
        printed.add(line)

    with warnings.catch_warnings():
        warnings.showwarning = show  # type: ignore[assignment]
        yield


def one_line_of(error: Exception) -> str | None:
    """Text of an error that the user can mend; None for a defect."""
    if callable(getattr(error, "format_message", None)):
        return _of_usage(error)
    if isinstance(error, CCDError):
        return " ".join(str(error).split())
    if isinstance(error, OSError) and error.errno in UNWRITABLE:
        return f"{error.filename or 'output'}: got {error.strerror}, expected a file that can be written and has room."
    if isinstance(error, MemoryError):
        return f"memory: got too little ({error}), expected room for the study; take fewer runs or steps."
    return None


def _of_usage(error: Any) -> str:
    """Complaint of the option parser in the grammar of the package."""
    help_of = f" See `{error.ctx.command_path} --help`." if getattr(error, "ctx", None) is not None else ""
    kind = type(error).__name__
    if kind == "NoSuchOption":
        near = f" Did you mean {error.possibilities[0]}?" if error.possibilities else ""
        return f"{error.option_name}: got an unknown option, expected one that exists.{near}{help_of}"
    if kind == "NoSuchCommand" or (kind == "UsageError" and "command" in error.format_message().lower()):
        *others, last = error.ctx.command.commands
        _, *quoted = error.format_message().split("'")
        word = repr(quoted[0]) if quoted else "nothing"
        near = nearest(word.strip("'"), [*others, last])
        return f"command: got {word}, expected {', '.join(others)} or {last}.{near and ' ' + near}{help_of}"
    if kind == "MissingParameter":
        name = error.param.name if error.param is not None else "argument"
        return f"{name}: got nothing, expected {EXPECTED.get(name, 'a value')}.{help_of}"
    if kind == "BadOptionUsage":
        took = "expected a value after it" if "requires" in error.format_message() else "expected it alone"
        got = "got it without a value" if "requires" in error.format_message() else "got it with a value"
        return f"{error.option_name}: {got}, {took}.{help_of}"
    if "extra argument" in error.format_message():
        extra = error.format_message().rpartition("(")[2].rstrip(").")
        return f"arguments: got {extra} besides what is needed, expected no more.{help_of}"
    return f"arguments: got {' '.join(error.format_message().split())}{help_of}"


def _in_plain(error: UnicodeError) -> tuple[str, int]:
    """ASCII replacement for characters that an encoding lacks."""
    if not isinstance(error, UnicodeEncodeError):
        raise error
    text = error.object
    return "".join(_plain(text[i], text[i - 1 : i]) for i in range(error.start, error.end)), error.end


def _plain(letter: str, before: str) -> str:
    """ASCII form of one character; a power begins with ^."""
    if letter in SUPERSCRIPTS:
        return ("" if before in SUPERSCRIPTS else "^") + SUPERSCRIPTS[letter]
    return PLAIN.get(letter, "?")
