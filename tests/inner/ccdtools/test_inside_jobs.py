"""Computations in other processes, while this one goes on."""

import os
import threading

import pytest

from ccdtools import InputError
from ccdtools.jobs import beside


def test_what_is_begun_has_the_inputs_of_that_moment_and_runs_elsewhere():
    values = [1.0, 2.0]
    with beside(2) as begun:
        ended, total = begun(lambda given: (sum(given), os.getpid()), values)
        values.append(3.0)
        found, where = total()
        assert ended()
    assert found == 3.0
    assert where != os.getpid()


@pytest.mark.parametrize(
    ("function", "inputs", "said"),
    [(os._exit, (1,), "a process that ended"), (str, (threading.Lock(),), "cannot be sent to a process .*lock")],
)
def test_a_process_that_ends_and_what_cannot_be_sent_are_named(function, inputs, said):
    with pytest.raises(InputError, match=said), beside(2) as begun:
        begun(function, *inputs)[1]()


def test_an_error_of_the_computation_is_that_error():
    with pytest.raises(ZeroDivisionError), beside(2) as begun:
        begun(lambda: 1 / 0)[1]()
