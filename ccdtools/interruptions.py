"""Ctrl-C: held back where it would leave something half made, and insisted on where it is swallowed."""

from __future__ import annotations

import signal
from collections.abc import Iterator
from contextlib import contextmanager
from typing import NoReturn

AGAIN = 1.0  # s after which an interruption that nobody has felt comes again
_felt: list[int] = []  # signals since the last `insisting` began


def interrupted() -> bool:
    """Whether Ctrl-C was pressed within the last `insisting`: an error that follows may be no error."""
    return bool(_felt)


@contextmanager
def held_back() -> Iterator[None]:
    """Hold Ctrl-C back: an import or a folder interrupted half-way could not be continued."""
    caught: list[int] = []
    before = signal.signal(signal.SIGINT, lambda number, frame: caught.append(number))
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)
    if caught:
        raise KeyboardInterrupt


@contextmanager
def insisting() -> Iterator[None]:
    """Let Ctrl-C arrive: CasADi swallows every second exception that is raised while it reads its arguments.

    What it does not swallow it may turn into an error of its own, which is then no error.
    """
    _felt.clear()

    def interrupt(number: int, frame: object) -> NoReturn:
        """Interrupt now, and again unless that was felt."""
        _felt.append(number)
        if hasattr(signal, "setitimer"):  # not on Windows
            signal.setitimer(signal.ITIMER_REAL, AGAIN)
        raise KeyboardInterrupt

    numbers = [getattr(signal, name) for name in ("SIGINT", "SIGALRM") if hasattr(signal, name)]
    before = [signal.signal(number, interrupt) for number in numbers]
    try:
        yield
    except Exception:
        if _felt:
            raise KeyboardInterrupt from None
        raise
    finally:
        if hasattr(signal, "setitimer"):
            signal.setitimer(signal.ITIMER_REAL, 0)
        for number, handler in zip(numbers, before):
            signal.signal(number, handler)
