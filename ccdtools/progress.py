"""Progress of a long computation: a bar or lines of text."""

from __future__ import annotations

import sys
import threading
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from typing import Any, TypeVar

from tqdm import tqdm

from ccdtools.budgets import SECONDS_BETWEEN_LINES

Echo = Callable[[str], None]
Item = TypeVar("Item")
_where: list[Any] = ["", 0.0, 0.0, 0.0]  # what the computation is at, and how far; when it was first told, and how far


class Lines(tqdm):  # type: ignore[misc]
    """Progress bar as lines of text, for a file or a notebook."""

    def display(self, msg: str | None = None, pos: int | None = None) -> bool:
        """Write a line; none where a bar would be cleared."""
        if msg is None:
            elapsed = self._time() - self.start_t if hasattr(self, "start_t") else 0.0  # of the first line
            done = f"{self.n} of {self.total} after {elapsed:.0f} s"
            self.fp.write(f"{self.desc.removesuffix(': ')}: {done}{_left(elapsed, self.n, self.total - self.n)}\n")
            self.fp.flush()
        return False


def bar(items: Any = None, *, label: str, total: int, progress: bool) -> tqdm:
    """Progress bar on a terminal, lines elsewhere; nothing without `progress`."""
    if not progress or sys.stderr.isatty():
        return tqdm(items, desc=label, total=total, disable=not progress, leave=False)
    return Lines(items, desc=label, total=total, leave=False, mininterval=SECONDS_BETWEEN_LINES, miniters=1)


def counted(items: Iterable[Item], label: str, *, total: int, progress: bool = False) -> Iterator[Item]:
    """Yield the items, with a bar if `progress`, and record the position."""
    for count, item in enumerate(bar(items, label=label, total=total, progress=progress)):
        at(f"{label}: {count} of {total}", count / total)
        yield item


def at(text: str, part: float = 0.0) -> None:
    """Record what the computation is at, and the part done."""
    if part <= _where[1]:
        _where[2:] = time.perf_counter(), part
    _where[:2] = text, part


def _left(seconds: float, done: float, rest: float) -> str:
    """Remaining time in words at the pace so far; empty without one."""
    known = seconds >= SECONDS_BETWEEN_LINES / 2 and done > 0 and rest > 0
    return f", about {seconds * rest / done:.0f} s left at this pace" if known else ""


@contextmanager
def telling(echo: Echo | None, what: str = "") -> Iterator[None]:
    """Report every ten seconds what the computation is `at`; nothing without `echo`."""
    if echo is None:
        yield
        return
    at(what)
    ended = threading.Event()
    begun = time.perf_counter()

    def tell() -> None:
        """Repeat the line until the computation has ended."""
        while not ended.wait(SECONDS_BETWEEN_LINES):
            now = time.perf_counter()
            text, part, since, first = _where
            left = _left(now - since, part - first, 1 - part)
            echo(f"    … {text and text + ', '}after {now - begun:.0f} s{left}")

    teller = threading.Thread(target=tell, daemon=True)
    teller.start()
    try:
        yield
    finally:
        ended.set()
        teller.join()
