"""Updates on recombined runs: told by all runs so far, judged on held-out ones."""

from dataclasses import replace

import numpy as np
from deployments import ONLINE, deployed, told_independent, training_gives, weakened

from ccdtools.statistics import PairedDifference
from ccdtools.twin.recombined_returns import NOT_ASKED, LoggedGain


def test_updates_are_told_by_all_runs_so_far_and_judged_on_recombined_held_out_ones(illustrative, clone, monkeypatch):
    good, weak = clone(illustrative), weakened(clone(illustrative))
    trained = training_gives(monkeypatch, good)
    looked, judged = told_independent(monkeypatch)
    config = replace(ONLINE, judged=100)
    done = deployed(illustrative, weak, runs=120, steps=40, config=config)
    np.testing.assert_array_equal(looked[0], np.arange(40))
    np.testing.assert_array_equal(looked[1], np.arange(80))
    so_far = [np.arange(28, 40), np.arange(40), [*range(28, 40), *range(68, 80)], np.arange(80)]
    for runs, expected in zip(judged, so_far):
        np.testing.assert_array_equal(runs, expected)
    assert all(log.independent for problem, _ in trained for log in problem.scenarios.logs)
    assert done.updates[0].accepted
    again = deployed(illustrative, weak, runs=120, steps=40, config=config)
    assert [update.gain for update in again.updates] == [update.gain for update in done.updates]


def test_updates_are_judged_on_runs_as_logged_where_recombination_is_off_or_refused(illustrative, clone, monkeypatch):
    trained = training_gives(monkeypatch, clone(illustrative))
    looked, judged = told_independent(monkeypatch, answer=False)
    refused = deployed(illustrative, weakened(clone(illustrative)), runs=60, steps=40)
    assert len(looked) == 2
    plain = replace(ONLINE, recombine=False)
    off = deployed(illustrative, weakened(clone(illustrative)), runs=60, steps=40, config=plain)
    assert len(looked) == 2
    assert not judged
    assert not any(log.independent for problem, _ in trained for log in problem.scenarios.logs)
    assert [update.gain for update in off.updates] == [update.gain for update in refused.updates]


def test_an_update_that_all_runs_so_far_deny_is_not_taken(illustrative, clone, monkeypatch):
    """A dozen runs are few, and held-out ones that are fewer than the trained ones know less of rare events."""
    training_gives(monkeypatch, clone(illustrative))
    says = {12: PairedDifference(2.0, (1.0, 3.0)), 40: PairedDifference(-0.5, (-1.0, 0.5))}
    monkeypatch.setattr(
        "ccdtools.twin.update_judge.recombined_gain",
        lambda replay, *_: LoggedGain(says[sum(log.runs for log in replay.logs)], 10.0, False),
    )
    for possible, low in ((True, -1.0), (False, 1.0)):
        told = replace(NOT_ASKED, independent=True, possible=possible)
        monkeypatch.setattr("ccdtools.twin.update_judge.independence", lambda *_, told=told: told)
        config = replace(ONLINE, updates=1, judged=100)
        (update,) = deployed(illustrative, clone(illustrative), runs=80, steps=40, config=config).updates
        assert update.gain.ci95 == (low, 3.0)
        assert update.accepted is not possible
