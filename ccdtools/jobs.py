"""One computation for many items, in processes, and its interruption."""

from __future__ import annotations

import os
import signal
import threading
import time
import warnings
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from functools import partial
from pickle import PicklingError, dumps, loads
from typing import Any, NoReturn

from ccdtools.budgets import REPEAT_INTERRUPT
from ccdtools.exceptions import InputError
from ccdtools.progress import bar
from ccdtools_ground.door import as_count, shown

_felt: list[int] = []  # signals since the last `insisting` began


def as_jobs(value: Any, argument: str = "jobs") -> int:
    """Number of processes: at least one, or −1 for all cores."""
    if isinstance(value, int) and not isinstance(value, bool) and value == -1:
        return -1
    try:
        return as_count(argument, value)
    except InputError:
        raise InputError(argument, shown(value), "a number of processes, or -1 for all cores") from None


def in_processes(
    function: Callable[[Any], Any], items: Sequence[Any], *, jobs: int, label: str, progress: bool = False
) -> list[Any]:
    """Values of a function at all items, in order; see `as_they_end`."""
    return list(as_they_end(function, items, jobs=jobs, label=label, progress=progress))


def as_they_end(
    function: Callable[[Any], Any],
    items: Sequence[Any],
    *,
    jobs: int,
    label: str,
    names: Sequence[str] = (),
    progress: bool = False,
) -> Iterator[Any]:
    """Values of a function at all items, in order, each once available.

    Parameters
    ----------
    function : callable
        What it needs is sent to the processes by joblib, if `jobs` is not 1.
    items : sequence
    jobs : int
        Processes; −1 for all cores.
    label : str
        Of the bar.
    names : sequence of str
        Of the items: in one process the bar says which one it is at.
    progress : bool

    Raises
    ------
    InputError
        If a process ends before its work is done, or something cannot be sent to one.
    """
    if jobs != 1 and len(items) > 1:
        from joblib import Parallel, delayed

        found = Parallel(n_jobs=jobs, return_as="generator")(delayed(_kept)(function, item) for item in items)
        ended = 0
        with _processes_named(lambda: f" at {names[ended]}, or at what follows it" if names else ""):
            for value in bar(found, label=label, total=len(items), progress=progress):
                ended += 1
                yield value
        return
    with bar(label=label, total=len(items), progress=progress) as shown_bar:
        for i, item in enumerate(items):
            if names:
                shown_bar.set_description(f"{label}, now {names[i]}")
            yield function(item)
            if names:  # the next line says it
                shown_bar.n += 1
            else:
                shown_bar.update()


Begun = tuple[Callable[[], bool], Callable[[], Any]]  # whether it has ended, and one that waits for its value


@contextmanager
def beside(jobs: int, most: int = 1) -> Iterator[Callable[..., Begun]]:
    """Computations in other processes, while this one goes on.

    What a computation needs is sent when it is begun. In one process, and what cannot be sent or fails there, it is
    computed here when its value is asked for: so a result or an error is that of one process. There are no more
    processes than the `most` computations that are begun.
    """
    if jobs == 1:
        yield lambda function, *inputs: (lambda: True, partial(function, *inputs))
        return
    from joblib import cpu_count, wrap_non_picklable_objects
    from joblib.externals.loky import ProcessPoolExecutor

    workers = max(min(cpu_count() if jobs == -1 else jobs, most + 1) - 1, 1)
    threads = {"OMP_NUM_THREADS": os.environ.get("OMP_NUM_THREADS", "1")}
    pool = ProcessPoolExecutor(workers, initializer=_end_with, initargs=(os.getpid(),), env=threads)

    def begun(function: Callable[..., Any], *inputs: Any) -> Begun:
        """Begin a computation."""
        here = partial(function, *inputs)
        try:
            future = pool.submit(_kept, _sent, dumps(wrap_non_picklable_objects(here, keep_wrapper=False)))
        except Exception as error:
            _tell(error)
            return lambda: True, here

        def value() -> Any:
            """Value, once it is there."""
            try:
                found, caught = loads(future.result())
            except Exception as error:
                found = here()
                _tell(error)
                return found
            for one in caught:
                warnings.warn_explicit(one.message, one.category, one.filename, one.lineno)
            return found

        return future.done, value

    try:
        yield begun
    except BaseException:
        pool.shutdown(kill_workers=True)
        raise
    pool.shutdown()


def _tell(error: Exception) -> None:
    """Warn of what was computed in one process after all."""
    reason = str(error).strip().splitlines() or [type(error).__name__]
    warnings.warn(f"computed in one process, as another one could not: {reason[0]}", stacklevel=3)


def _sent(task: bytes) -> bytes:
    """Value of what was sent, and its warnings.

    An error in words, as one's own may not be sent.
    """
    try:
        with warnings.catch_warnings(record=True) as caught:
            value = loads(task)()
        return dumps((value, caught))
    except Exception as error:
        raise RuntimeError(f"{type(error).__name__}: {error}") from None


def _end_with(parent: int) -> None:
    """Let this process end with another, which Ctrl-C is for."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)

    def watch() -> None:
        """Wait until it has ended."""
        while os.getppid() == parent:  # always on Windows
            time.sleep(1.0)
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()


@contextmanager
def _processes_named(at: Callable[[], str] = str) -> Iterator[None]:
    """Say where a process ended, or what cannot be sent to one."""
    try:
        yield
    except BrokenProcessPool as error:
        cure = "It was killed, ran out of memory, or what it called ended it: jobs=1 shows where."
        raise InputError("jobs", f"a process that ended{at()}", "processes that live to the end", cure) from error
    except PicklingError as error:
        reason = str(error.__cause__ or error).strip('\n" ').splitlines()[-1]
        got = f"what cannot be sent to a process ({reason})"
        raise InputError("jobs", got, "jobs=1, or functions and classes that stand in a module") from error


def _kept(function: Callable[[Any], Any], item: Any) -> Any:
    """Value of a function at an item, in a process that may grow.

    One that has grown by 300 MB is told to end by loky, and was seen to wait for that for ever, with its value kept.
    The limit stays off in a process that is used again.
    """
    from joblib.externals.loky import process_executor

    process_executor._MAX_MEMORY_LEAK_SIZE = float("inf")  # noqa: SLF001  (there is no public way)
    return function(item)


def interrupted() -> bool:
    """Whether Ctrl-C was pressed within the last `insisting`."""
    return bool(_felt)


@contextmanager
def held_back() -> Iterator[None]:
    """Hold Ctrl-C back until the end of the block."""
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
    """Let Ctrl-C arrive even if CasADi swallows an exception.

    What it does not swallow it may turn into an error of its own, which is then no error.
    """
    _felt.clear()

    def interrupt(number: int, frame: object) -> NoReturn:
        """Interrupt now, and again unless that was felt."""
        _felt.append(number)
        if hasattr(signal, "setitimer"):  # not on Windows
            signal.setitimer(signal.ITIMER_REAL, REPEAT_INTERRUPT)
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
