"""Content of functions that are reached through modules, wrappers and classes."""

import contextlib
import functools
import sys
from types import ModuleType

import numpy as np
import pytest

from ccdtools_ground.content import content_of


def made(source, name):
    """What a text of a user's own module defines by a name."""
    space = {"__name__": "a_study_of_mine", "functools": functools}
    exec(source, space)
    return space[name]


def scaled(gain):
    """Decorator of a user's."""

    def wrap(f):
        @functools.wraps(f)
        def wrapped(*given):
            return gain * f(*given)

        return wrapped

    return wrap


class Law:
    """A law with a method that remembers."""

    def __init__(self, gain):
        self.gain = gain

    @scaled(1.0)
    def times(self, x):
        return self.gain * x


PROPERTY = """
class Law:
    @property
    def gain(self):
        return {}
    @classmethod
    def of(cls):
        return cls()
    def __matmul__(self, x):
        return self.gain * x
make = lambda p, rng: Law
"""


@pytest.mark.parametrize("kind", ["module", "installed closure", "decorator", "method", "property", "built-in"])
def test_what_is_reached_otherwise_than_by_a_name_counts(kind, monkeypatch):
    def content(gain):
        """Content of a maker with a number."""
        if kind == "module":
            module = ModuleType("a_library_of_mine")
            exec(f"GAIN = {gain}\ndef law(x):\n    return GAIN * x", module.__dict__)
            monkeypatch.setitem(sys.modules, "a_library_of_mine", module)
            return content_of(made("import a_library_of_mine\nmake = lambda p, rng: a_library_of_mine.law", "make"))
        return content_of({
            "installed closure": lambda: contextlib.contextmanager(lambda: gain),
            "decorator": lambda: scaled(gain)(np.sum),
            "method": lambda: Law(gain).times,
            "property": lambda: made(PROPERTY.format(gain), "make"),
            "built-in": lambda: {1: gain}.get,
        }[kind]())  # fmt: skip

    assert content(0.3) == content(0.3)
    assert content(0.3) != content(0.9)


class Closed:
    """An object that does not say what it holds."""

    def __reduce_ex__(self, protocol):
        raise TypeError


def test_what_does_not_say_what_it_holds_is_another_one_each_time():
    closed = Closed()
    assert content_of(closed) != content_of(closed)
