"""Ctrl-C arrives."""

import contextlib
import os
import signal
import time

import pytest

from ccdtools import jobs
from ccdtools.cli import held_back, insisting


@pytest.mark.skipif(not hasattr(signal, "setitimer"), reason="needs a timer that interrupts")
def test_an_interruption_arrives_even_where_a_library_swallows_it(monkeypatch):
    monkeypatch.setattr(jobs, "REPEAT_INTERRUPT", 0.05)
    before = signal.getsignal(signal.SIGINT)

    def swallow():
        with contextlib.suppress(KeyboardInterrupt):
            os.kill(os.getpid(), signal.SIGINT)
            time.sleep(1.0)
        time.sleep(60.0)

    with pytest.raises(KeyboardInterrupt), insisting():
        swallow()
    assert signal.getsignal(signal.SIGINT) is before


def test_an_error_that_an_interruption_caused_is_an_interruption():
    def confuse():
        try:
            os.kill(os.getpid(), signal.SIGINT)
            time.sleep(1.0)
        except KeyboardInterrupt:
            raise NotImplementedError("Wrong number or type of arguments") from None

    with pytest.raises(KeyboardInterrupt), insisting():
        confuse()
    with pytest.raises(NotImplementedError), insisting():
        raise NotImplementedError("not of an interruption")


def test_an_interruption_is_held_back_until_what_must_be_whole_is_done():
    done = []

    def interrupted():
        os.kill(os.getpid(), signal.SIGINT)
        time.sleep(0.05)
        done.append("whole")

    with pytest.raises(KeyboardInterrupt), held_back():
        interrupted()
    assert done == ["whole"]
