"""Computations in other processes, while this one goes on."""

import os
import subprocess
import sys
import threading
import time
import warnings

import pytest

from ccdtools.jobs import beside

HERE = os.getpid()


@pytest.mark.parametrize(("jobs", "seen"), [(1, 6.0), (2, 3.0)])
def test_what_is_begun_has_its_inputs_and_runs_elsewhere(jobs, seen):
    values = [1.0, 2.0]
    with beside(jobs) as begun:
        ended, total = begun(lambda given: (sum(given), os.getpid()), values)
        values.append(3.0)
        found, where = total()
        assert ended()
    assert found == seen
    assert (where == HERE) == (jobs == 1)


def end_elsewhere(here):
    """End the process, unless it is this one."""
    if os.getpid() != here:
        os._exit(1)
    return True


@pytest.mark.parametrize(
    ("function", "given", "said"),
    [(end_elsewhere, HERE, "terminated"), (lambda value: value.acquire(False) or True, threading.Lock(), "lock")],
    ids=["ends", "cannot be sent"],
)
def test_what_another_process_cannot_do_is_done_here_and_said(function, given, said):
    with beside(2) as begun:
        for _ in range(2):
            with pytest.warns(UserWarning, match=f"in one process.*{said}"):
                assert begun(function, given)[1]()


class Broken(Exception):
    """One that no other process can send."""

    def __init__(self, first, second):
        super().__init__(f"{first} and {second}")


def fail():
    """Fail in the user's own way."""
    raise Broken("one", "two")


def test_an_error_of_the_computation_is_that_error():
    with pytest.raises(Broken, match="one and two") as found, beside(2) as begun:
        begun(fail)[1]()
    assert found.traceback[-1].name == "fail"


class Own(UserWarning):
    """One that no other process can send."""

    def __init__(self, first, second):
        super().__init__(f"{first} and {second}")


def test_what_cannot_be_sent_back_leaves_the_other_process_to_others():
    with beside(2) as begun:
        with pytest.warns(Own), pytest.warns(UserWarning, match="in one process"):
            begun(lambda: warnings.warn(Own("one", "two"), stacklevel=1))[1]()
        assert begun(os.getpid)[1]() != HERE


def warn_of(text):
    """Warn, twice in one place."""
    for _ in range(2):
        warnings.warn(text, stacklevel=1)
    return text


def test_a_warning_is_heard_here_as_often():
    with pytest.warns(UserWarning, match="old law") as heard, beside(2) as begun:
        assert begun(warn_of, "old law")[1]() == "old law"
    assert len(heard) == 1


KILLED = """
import time
from ccdtools.jobs import beside
with beside(2) as begun:
    import os
    print(begun(os.getpid)[1](), flush=True)
    time.sleep(60)
"""


def lives(process):
    """Whether a process of a number is there."""
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    return True


@pytest.mark.long
def test_another_process_ends_with_this_one():
    with subprocess.Popen([sys.executable, "-c", KILLED], stdout=subprocess.PIPE, text=True) as program:
        other = int(program.stdout.readline())
        assert lives(other)
        program.kill()
    until = time.monotonic() + 20
    while lives(other) and time.monotonic() < until:
        time.sleep(0.2)
    assert not lives(other)
