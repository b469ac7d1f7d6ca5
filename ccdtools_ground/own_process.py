"""A function in a process of its own, where it may hang or die."""

from __future__ import annotations

import os
import signal
import threading
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from typing import Any

from ccdtools_ground.door import brief, shown
from ccdtools_ground.errors import InputError, SimulatorError


class OwnProcess:
    """Function of arrays, called in a process of its own.

    The process is begun at the first call, and again after it hung or died; it ends with this object.

    Parameters
    ----------
    function : callable
        It goes to the process with what it refers to.
    limit : float
        Time of a call [s].
    names : sequence of str
        Of what it is given, the last ones.

    Raises
    ------
    InputError
        At the first call, if the function cannot go to another process.
    SimulatorError
        If a call takes longer than the limit, or ends the process.
    """

    def __init__(self, function: Callable[..., Any], limit: float, names: Sequence[str] = "xuwp") -> None:
        self.function = function
        self.limit = limit
        self.names = names
        self._running: Any = None  # process and pipe

    def __call__(self, *given: Any) -> Any:
        """Value of the function."""
        if self._running is None:
            self._running = self._begun()
        process, pipe = self._running
        fault = "does not come back"
        try:
            pipe.send(given)
            found = pipe.recv() if pipe.poll(self.limit) else None
        except (EOFError, ConnectionError):
            process.join()
            code = process.exitcode
            fault = f"ends its process by {signal.Signals(-code).name if code < 0 else f'code {code}'}"
            found = None
        except BaseException:  # an interruption: its answer must not be taken for that of the next call
            self._end()
            raise
        if found is None:
            self._end()
            at = ", ".join(f"{name} = {shown(value)}" for name, value in zip(self.names[-len(given) :], given))
            raise SimulatorError("advance", f"a simulator that {fault} at {at}", f"an answer within {self.limit:g} s")
        value, error = found
        if error is not None:
            raise error
        return value

    def _begun(self) -> tuple[Any, Any]:
        """Process that waits for a call, and the pipe to it."""
        from joblib import wrap_non_picklable_objects
        from joblib.externals.loky.backend import get_context

        context = get_context("loky")  # begins without the memory of this process and without its main file
        pipe, far = context.Pipe()
        process = context.Process(target=_serve, args=(far, wrap_non_picklable_objects(self.function)), daemon=True)
        try:
            process.start()
        except Exception as error:
            got = f"{self.limit:g} s, and a simulator that cannot go to another process: {brief(str(error))}"
            raise InputError("step_limit", got, "one that can be pickled", "Without a limit it need not.") from error
        far.close()
        with suppress(EOFError, ConnectionError):  # the first call will tell
            pipe.recv()
        return process, pipe

    def _end(self) -> None:
        """End the process, and those that it began."""
        from joblib.externals.loky.backend.utils import kill_process_tree

        process, pipe = self._running
        self._running = None
        kill_process_tree(process)
        pipe.close()


def _serve(pipe: Any, function: Callable[..., Any]) -> None:
    """Answer calls until the caller ends."""
    threading.Thread(target=_end_with, args=(os.getppid(),), daemon=True).start()
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # an interruption is the caller's
    pipe.send("ready")
    with suppress(EOFError, ConnectionError):
        while True:
            given = pipe.recv()
            try:
                pipe.send((function(*given), None))
            except Exception as error:
                pipe.send((None, error))


def _end_with(caller: int) -> None:
    """End this process after the caller, also while a call hangs."""
    while os.getppid() == caller:
        time.sleep(1)
    os._exit(1)
