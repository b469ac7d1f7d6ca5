"""Work that goes on beside what follows, and where it is found if a process fails."""

import functools
import os

import pytest

from ccdtools.jobs import begun


def test_what_one_process_finds_is_found_at_once():
    calls = []
    asked = begun(lambda: calls.append(1) or len(calls), jobs=1)
    assert calls == [1]
    assert asked() == 1


@pytest.mark.check
def test_what_another_process_finds_is_found_there_and_else_here():
    here, cached = os.getpid(), functools.cache(lambda: os.getpid())
    assert begun(lambda: os.getpid(), jobs=2)() != here
    assert begun(lambda: cached(), jobs=2)() == here  # cannot be sent
    assert begun(lambda: os.getpid() if os.getpid() == here else os._exit(9), jobs=2)() == here


@pytest.mark.check
def test_an_error_is_told_where_it_is():
    with pytest.raises(ZeroDivisionError) as told:
        begun(lambda: 1 / 0, jobs=2)()
    assert told.traceback[-1].path.name == "test_begun_beside.py"
