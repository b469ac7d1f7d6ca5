"""A long computation says how far it is: with a bar on a terminal, in plain lines elsewhere."""

import io
import re
import sys
import time

import numpy as np
import pytest

from ccdtools import Nested, Search, codesign
from ccdtools.progress import at, bar, counted, telling


class Terminal(io.StringIO):
    """A stream that says it is a terminal."""

    def isatty(self):
        return True


def shown(monkeypatch, stream, **options):
    """What a bar over three items writes."""
    monkeypatch.setattr(sys, "stderr", stream)
    assert list(bar(range(3), label="simulating", total=3, **options)) == [0, 1, 2]
    return stream.getvalue()


def test_without_a_terminal_there_is_a_line_at_the_start_and_no_control_character(monkeypatch):
    text = shown(monkeypatch, io.StringIO(), progress=True)
    assert text.splitlines()[0] == "simulating: 0 of 3 after 0 s"
    assert text.endswith("\n")
    assert all(letter.isprintable() or letter == "\n" for letter in text)


def test_lines_follow_as_items_do(monkeypatch):
    monkeypatch.setattr("ccdtools.progress.SECONDS_BETWEEN_LINES", 0.0)
    text = shown(monkeypatch, io.StringIO(), progress=True)
    assert "simulating: 2 of 3 after 0 s, about 0 s left at this pace" in text.splitlines()


def test_on_a_terminal_there_is_a_bar_and_without_progress_nothing(monkeypatch):
    assert "\r" in shown(monkeypatch, Terminal(), progress=True)
    for stream in (Terminal(), io.StringIO()):
        assert not shown(monkeypatch, stream, progress=False)


def test_a_stage_that_takes_long_says_what_it_is_at(monkeypatch):
    monkeypatch.setattr("ccdtools.progress.SECONDS_BETWEEN_LINES", 0.01)
    lines = []
    with telling(lines.append):
        at("iteration 3 of at most 7")
        while not lines:
            time.sleep(0.005)
    count = len(lines)
    assert lines[-1].startswith("    … iteration 3 of at most 7, after ")
    time.sleep(0.05)
    assert len(lines) == count  # nothing is told once it has ended


def test_a_stage_that_takes_long_says_how_long_the_rest_takes(monkeypatch):
    monkeypatch.setattr("ccdtools.progress.SECONDS_BETWEEN_LINES", 0.02)
    lines = []
    with telling(lines.append):
        at("landscape")
        for k in range(1, 5):
            time.sleep(0.01)
            at(f"iteration {k} of 100", k / 100)
        while not lines:
            time.sleep(0.005)
    assert re.fullmatch(r"    … iteration \d of 100, after \d+ s, about \d+ s left at this pace", lines[-1])


def test_a_stage_that_ends_soon_or_has_no_echo_says_nothing():
    lines = []
    with telling(lines.append), telling(None):
        pass
    assert not lines


def test_an_interrupted_stage_is_told_of_no_more(monkeypatch):
    monkeypatch.setattr("ccdtools.progress.SECONDS_BETWEEN_LINES", 0.01)
    lines = []
    with pytest.raises(KeyboardInterrupt), telling(lines.append):
        raise KeyboardInterrupt
    time.sleep(0.05)
    assert not lines


def test_items_are_all_yielded_and_said(monkeypatch):
    monkeypatch.setattr("ccdtools.progress.SECONDS_BETWEEN_LINES", 0.01)
    lines = []
    found = []
    with telling(lines.append):
        for item in counted(range(4), "X_fea(p)", total=4):
            found.append(item)
            while item == 2 and not any("X_fea(p): 2 of 4, after " in line for line in lines):
                time.sleep(0.005)
    assert found == [0, 1, 2, 3]


@pytest.mark.parametrize("method", ["nested", "search"])
def test_a_co_design_without_a_terminal_says_in_lines_what_it_is_at(monkeypatch, illustrative, method):
    monkeypatch.setattr("ccdtools.progress.SECONDS_BETWEEN_LINES", 0.005)
    kinds = {"nested": Nested("lqr", runs=64, starts=1, evaluations=4), "search": Search(runs=64, evaluations=12)}
    written = {}
    for stream, progress in ((io.StringIO(), True), (io.StringIO(), False)):
        monkeypatch.setattr(sys, "stderr", stream)
        codesign(illustrative.problem(), method=kinds[method], rng=np.random.default_rng(0), progress=progress)
        written[progress] = stream.getvalue()
    assert re.search(r"^    … evaluation \d+, after \d+ s", written[True], re.MULTILINE)
    assert "\r" not in written[True]
    assert not written[False]
