"""Recombined runs: refused where errors depend on each other, unbiased and honestly uncertain where they do not."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.signal import lfilter

import ccdtools.twin.replay
from ccdtools import InputError, QuadraticObjective, Trajectory
from ccdtools.statistics import summarise
from ccdtools.twin.recombination import Dependence, dealt, dependence, drawn, shuffled
from ccdtools.twin.recombined_returns import (
    MOVED,
    NOT_ASKED,
    PLAINLY,
    SLIGHTLY,
    TOO_FEW,
    independence,
    over_blocks,
    recombined_gain,
)  # fmt: skip
from ccdtools.twin.replay import Replay
from ccdtools.twin.residuals import Residuals

COST = QuadraticObjective(Q=[[1.0]], R=[[1e-9]])
STEPS = 100


def coloured(runs, rho, rng, share=1.0, steps=STEPS):
    """White noise with so large a share of AR(1) noise, of variance one."""
    slow = lfilter([1], [1, -rho], rng.standard_normal((runs, steps + 200)), axis=1)[:, 200:] * np.sqrt(1 - rho**2)
    return np.sqrt(share) * slow + np.sqrt(1 - share) * rng.standard_normal((runs, steps))


def log_of(e, unit=1.0, **fields):
    """A log of one state with these errors (n, T), from x = 1."""
    e_next = unit * np.asarray(e)[..., None]
    x = np.full(e_next.shape, unit)
    return Residuals(np.zeros_like(e_next), x, np.zeros_like(e_next), np.zeros(0), e_next, **fields)


def loop(pole, edge=np.inf):
    """Return what runs x⁺ = pole x + e; a run beyond the edge is lost."""

    def run(x0, w):
        driven = np.concatenate([x0, w[..., 0]], axis=1)
        x = lfilter([1], [1, -pole], driven, axis=1)
        lost = np.abs(x[:, 1:]) > edge
        at = np.where(lost.any(axis=1), lost.argmax(axis=1), -1)
        x = np.clip(x, -edge, edge)
        return Trajectory(x[..., None], np.zeros_like(w), w, at, np.zeros(0), 0.1)

    return run


def alone(pole):
    """Return what drives one service."""
    return lambda x0, w: (loop(pole)(x0, w),)


def both(after, before):
    """Return what drives a candidate and the service."""
    return lambda x0, w: (loop(after)(x0, w), loop(before)(x0, w))


def told(e, pole=0.9, unit=1.0, seed=0):
    """Whether a log is recombined where a loop of that pole is in service."""
    return independence(Replay([log_of(e, unit)]), alone(pole), COST, np.random.default_rng(seed))


# ── what errors show ──


def seen(e):
    """The dependence of errors (n, T)."""
    return dependence(np.asarray(e)[..., None], np.ones((*np.shape(e), 1)))


@pytest.mark.parametrize("runs", [36, 60, 200])
def test_independent_errors_show_no_plain_dependence_however_their_size_changes(runs):
    rng = np.random.default_rng(0)
    white = rng.standard_normal((runs, STEPS))
    sizes = {"constant": 1.0, "loud start": 1 + 1000 * (np.arange(STEPS) < 3), "season": 1.1 + np.sin(np.arange(STEPS))}
    for name, size in sizes.items():
        assert seen(white * size) is not Dependence.PLAIN, name
    spikes = np.where(rng.random(white.shape) < 0.01, 100 * white, white)
    assert seen(spikes) is not Dependence.PLAIN


@pytest.mark.parametrize("rho", [0.3, 0.6, 0.9, -0.5])
@pytest.mark.parametrize("runs", [36, 200])
@pytest.mark.parametrize("hidden", ["no", "spike", "loud start", "heavy tails"])
def test_correlation_is_seen_behind_a_spike_and_a_loud_start(rho, runs, hidden):
    e = coloured(runs, rho, np.random.default_rng(1))
    if hidden == "spike":
        e[3, 50] += 3000
    elif hidden == "loud start":
        e[:, :2] *= 3000
    elif hidden == "heavy tails":
        e = np.sinh(2 * e)
    assert seen(e) is Dependence.PLAIN


def test_a_road_is_plainly_correlated(suspension):
    w = suspension.real.disturbance.sample(40, 200, np.random.default_rng(0))[..., 0]
    assert seen(w) is Dependence.PLAIN


def test_a_slow_part_that_no_single_lag_shows_is_seen_in_sums():
    e = coloured(200, 0.9, np.random.default_rng(2), share=0.02)
    assert np.abs([(e[:, k:] * e[:, :-k]).mean() for k in range(1, 10)]).max() < 0.035
    assert seen(e) is not Dependence.NONE


def test_errors_that_are_rounding_are_none():
    rng = np.random.default_rng(3)
    slow = 1e-12 * np.cumsum(rng.standard_normal((60, STEPS)), axis=1)
    errors = np.stack([rng.standard_normal((60, STEPS)), slow], axis=-1)
    assert dependence(errors, np.ones_like(errors)) is Dependence.NONE
    assert dependence(errors, 1e-9 * np.ones_like(errors)) is Dependence.PLAIN
    assert dependence(np.zeros_like(errors), np.ones_like(errors)) is Dependence.NONE


def bursts(runs, rng):
    """White noise that is loud for ten steps in every fourth run."""
    size = np.ones((runs, STEPS))
    for run in np.flatnonzero(rng.random(runs) < 0.25):
        size[run, (begun := rng.integers(0, STEPS - 10)) : begun + 10] = 5
    return size * rng.standard_normal((runs, STEPS))


@pytest.mark.parametrize("runs", [36, 60, 200])
def test_errors_of_one_state_that_come_later_in_another_are_plainly_dependent(runs):
    """Each state alone is white: a road that meets the second wheel later."""
    rng = np.random.default_rng(13)
    for later, sign in ((1, 1), (7, -1), (25, 1)):
        w = rng.standard_normal((runs, STEPS + later))
        errors = np.stack([w[:, later:], sign * w[:, :-later]], axis=-1)
        assert all(seen(errors[..., k]) is not Dependence.PLAIN for k in (0, 1))
        assert dependence(errors, np.ones_like(errors)) is Dependence.PLAIN


def test_a_slow_part_that_only_two_states_together_show_is_seen_in_sums():
    """What the second state holds of the first is so small that no single lag and no state alone shows it."""
    rng = np.random.default_rng(14)
    both, alone = [], []
    for _ in range(4):
        w = rng.standard_normal((1000, STEPS + 40))
        slow = lfilter(np.ones(40), [1], w[:, :-1], axis=1)[:, 39:]
        errors = np.stack([w[:, 40:], 0.007 * slow + rng.standard_normal((1000, STEPS))], axis=-1)
        both.append(dependence(errors, np.ones_like(errors)) is not Dependence.NONE)
        alone.append(seen(errors[..., 1]) is not Dependence.NONE)
    assert all(both)
    assert sum(alone) <= 2


@pytest.mark.parametrize("runs", [36, 60, 200])
def test_errors_that_are_loud_together_are_dependent_however_white_their_signs(runs):
    rng = np.random.default_rng(15)
    found = [seen(bursts(runs, rng)) for _ in range(10)]
    assert sum(one is Dependence.NONE for one in found) <= (2 if runs == 36 else 0)
    by_run = np.exp(rng.standard_normal((runs, 1))) * rng.standard_normal((runs, STEPS))
    assert seen(by_run) is Dependence.PLAIN


def test_independent_errors_pass_as_often_however_many_states_they_have():
    """In at least nine of ten logs, less two and a half standard errors of 80."""
    rng = np.random.default_rng(16)
    mixed = np.array([[1.0, 0.9], [0.0, np.sqrt(0.19)]])
    for states in (1, 2, 4, 8):
        passed = [dependence(rng.standard_normal((60, STEPS, states)), np.ones((60, STEPS, states)))
                  for _ in range(80)]  # fmt: skip
        assert sum(one is Dependence.NONE for one in passed) >= 65, states
    passed = [dependence(rng.standard_normal((60, STEPS, 2)) @ mixed, np.ones((60, STEPS, 2))) for _ in range(80)]
    assert sum(one is Dependence.NONE for one in passed) >= 65


def test_errors_that_are_the_same_in_all_runs_change_nothing():
    rng = np.random.default_rng(17)
    for e in (rng.standard_normal((60, STEPS)), coloured(60, 0.3, rng), coloured(60, 0.9, rng, share=0.02)):
        x = np.cumsum(e, axis=1)
        bias = np.stack([np.full_like(e, 0.1), (x + 0.1) - x, np.tile(e[:1], (60, 1))], axis=-1)
        errors, states = np.concatenate([e[..., None], bias], axis=-1), np.repeat(x[..., None], 4, axis=-1)
        assert dependence(bias, states[..., 1:]) is Dependence.NONE
        assert dependence(errors, states) is dependence(e[..., None], x[..., None])
    late = np.where(np.arange(STEPS) < 55, 0.3, rng.standard_normal((60, STEPS)))
    assert seen(late) is Dependence.NONE
    assert seen(np.where(np.arange(STEPS) < 55, 0.3, coloured(60, 0.3, rng))) is Dependence.PLAIN


@pytest.mark.parametrize("unit", [1e-6, 1e6])
def test_units_do_not_matter(unit):
    rng = np.random.default_rng(4)
    for e in (rng.standard_normal((60, STEPS)), coloured(60, 0.9, rng, share=0.02)):
        one, other = told(e), told(e, unit=unit)
        assert (one.dependence, one.independent) == (other.dependence, other.independent)
        assert other.change.mean == pytest.approx(unit**2 * one.change.mean)


# ── whether a log is recombined ──


def test_independent_errors_are_recombined_nearly_always():
    rng = np.random.default_rng(5)
    taken = [told(rng.standard_normal((runs, STEPS)), pole).independent
             for runs in (36, 60, 200) for pole in (0.5, 0.98) for _ in range(8)]  # fmt: skip
    assert np.mean(taken) > 0.75


@pytest.mark.quick(4)
@pytest.mark.parametrize("runs", [36, 60, 200])
@pytest.mark.parametrize("pole", [0.7, 0.99])
def test_slow_noise_of_a_fortieth_of_the_variance_is_refused_or_moves_the_return_by_little(runs, pole):
    """By less than one standard error of the mean over the runs as logged, on average over all logs."""
    rng = np.random.default_rng(6)
    true = np.mean([returns(pole, coloured(5000, 0.9, rng, share=0.025)).mean() for _ in range(4)])
    moved = []
    for _ in range(16):
        e = coloured(runs, 0.9, rng, share=0.025)
        if told(e, pole).independent:
            means = [returns(pole, e[shuffled(dealt(np.arange(runs)), STEPS, rng), np.arange(STEPS)]) for _ in range(8)]
            moved.append((np.mean(means) - true) / (returns(pole, e).std() / np.sqrt(runs)))
    assert len(moved) <= (0 if runs == 200 else 11)
    assert abs(np.sum(moved)) < 16


def returns(pole, e):
    """Returns (n,) of a loop."""
    return loop(pole)(np.ones((len(e), 1)), e[..., None]).returns(COST)


def test_an_error_that_follows_the_state_is_refused():
    """The real pole is 0.95, the model's 0.9: what holds the errors together is what makes the real loop dear."""
    rng = np.random.default_rng(7)
    w = rng.standard_normal((200, STEPS))
    x = lfilter([1], [1, -0.95], np.concatenate([np.ones((200, 1)), w], axis=1), axis=1)
    assert not told(w + 0.05 * x[:, :-1], 0.9).independent


def test_few_runs_and_single_runs_are_replayed_as_logged():
    rng = np.random.default_rng(8)
    for runs in (1, 2, 3, 35):
        found = told(rng.standard_normal((runs, STEPS)))
        assert found == replace(NOT_ASKED, change=found.change, reason=TOO_FEW)
    assert told(rng.standard_normal((60, 2))).reason == TOO_FEW
    few = Replay([log_of(rng.standard_normal((11, STEPS)), independent=True)])
    assert few.blocks() is None
    assert not few.recombines


def test_every_logged_error_is_met_twice_at_least_however_few_runs_are_asked_for():
    e = np.random.default_rng(9).standard_normal((60, STEPS))
    replay = Replay([log_of(e, independent=True)])
    assert [replay.rounds(count) for count in (30, 119, 120, 200)] == [2, 2, 2, 3]
    made = []

    def drive(x0, w):
        """Return runs, and keep their number."""
        made.append(len(x0))
        return both(0.9, 0.9)(x0, w)

    recombined_gain(replay, drive, COST, 30, np.random.default_rng(0))
    assert made == [120, 60]


def test_runs_are_recombined_only_where_all_logs_are_independent_to_train_and_to_judge():
    e = np.arange(60)[:, None] + np.zeros((60, 5))
    assert Replay([log_of(e, independent=True), log_of(e, independent=True)]).recombines
    assert not Replay([log_of(e)]).recombines
    mixed = Replay([log_of(e, independent=True), log_of(e)])
    assert not mixed.recombines
    _, w = mixed.sample(100, 5, np.random.default_rng(0))
    np.testing.assert_array_equal(w, np.tile(w[:, :1], (1, 5, 1)))


def test_the_line_of_a_log_says_why_its_runs_are_not_recombined():
    rng = np.random.default_rng(18)
    e = rng.standard_normal((60, STEPS))
    lines = {told(e).describe(), told(e[:20]).describe(), told(coloured(60, 0.9, rng)).describe()}
    assert lines == {
        "errors of different steps are taken as independent: runs are recombined step by step",
        f"runs are replayed as logged: {TOO_FEW}", f"runs are replayed as logged: {PLAINLY}",
    }  # fmt: skip
    found = [told(coloured(60, 0.9, rng, share=share), 0.99) for share in (0.03, 0.04, 0.05) for _ in range(20)]
    for one in found:
        reasons = {(True, True): "", (True, False): SLIGHTLY, (False, False): MOVED}
        assert one.reason == (PLAINLY if one.dependence == "plain" else reasons[one.possible, one.independent])
    assert {one.reason for one in found} >= {MOVED, SLIGHTLY}


# ── recombined runs ──


def test_every_error_of_a_block_is_met_once_and_the_first_stays_with_its_state():
    blocks = dealt(np.arange(60))
    source = shuffled(blocks, 20, np.random.default_rng(0))
    np.testing.assert_array_equal(source[:, 0], np.arange(60))
    np.testing.assert_array_equal(blocks[source], np.tile(blocks[:, None], (1, 20)))
    np.testing.assert_array_equal(np.sort(source, axis=0), np.tile(np.arange(60)[:, None], (1, 20)))
    assert (source[:, 1:] != np.arange(60)[:, None]).any(axis=1).all()


def test_blocks_hold_runs_of_both_kinds_and_the_same_number_in_every_log():
    numbers = np.array([*range(60), *range(0, 60, 2)])
    blocks = dealt(numbers)
    assert len(np.unique(blocks)) == 10
    for number in range(0, 60, 2):
        assert len(np.unique(blocks[numbers == number])) == 1
    for block in range(10):
        assert set(numbers[blocks == block] % 2) == {0, 1}
    for runs, number in ((12, 6), (36, 6), (60, 10), (120, 10), (200, 16), (1000, 20)):
        assert len(np.unique(dealt(np.arange(runs)))) == number
    assert dealt(np.arange(11)) is None


def test_runs_of_two_logs_are_recombined_with_those_of_their_own():
    e = np.arange(60)[:, None] + np.zeros((60, 5))
    replay = Replay([log_of(e, independent=True), log_of(1000 + e, independent=True)])
    ((x0, w, blocks),) = replay.recombined(3, np.random.default_rng(0))
    assert x0.shape == (360, 1)
    assert w.shape == (360, 5, 1)
    logs = w[..., 0] >= 1000
    np.testing.assert_array_equal(logs, np.tile(logs[:, :1], (1, 5)))
    met = dealt(np.arange(60))[(w[..., 0] % 1000).astype(int)]
    np.testing.assert_array_equal(met, np.tile(blocks[:, None], (1, 5)))


def test_episodes_of_independent_logs_take_every_step_at_its_own_time():
    time = np.tile(np.arange(30.0), (50, 1)) + 1e-3 * np.arange(50)[:, None]
    _, w = Replay([log_of(time, independent=True)]).sample(200, 10, np.random.default_rng(0))
    steps, runs = np.floor(w[..., 0]), np.round((w[..., 0] % 1) * 1e3)
    np.testing.assert_array_equal(np.diff(steps, axis=1), 1.0)
    assert len(np.unique(runs)) == 50
    assert (np.array([len(np.unique(row)) for row in runs]) > 5).all()


def test_the_first_error_of_an_episode_is_that_of_its_state():
    assert (drawn(np.arange(7), 7, 4, np.random.default_rng(0))[:, 0] == np.arange(7)).all()


def test_logs_that_are_not_independent_are_drawn_as_whole_windows():
    e = np.arange(60)[:, None] + np.zeros((60, 5))
    _, w = Replay([log_of(e)]).sample(100, 5, np.random.default_rng(0))
    np.testing.assert_array_equal(w, np.tile(w[:, :1], (1, 5, 1)))


def test_the_parts_of_recombined_runs_do_not_change_what_they_say(monkeypatch):
    replay = Replay([log_of(np.random.default_rng(0).standard_normal((60, STEPS)), independent=True)])
    whole, again = (recombined_gain(replay, both(0.6, 0.9), COST, 600, np.random.default_rng(1)) for _ in range(2))
    assert whole == again
    monkeypatch.setattr(ccdtools.twin.replay, "NUMBERS_AT_ONCE", 1)
    assert len(list(replay.recombined(10, np.random.default_rng(1)))) == 10
    parts = recombined_gain(replay, both(0.6, 0.9), COST, 600, np.random.default_rng(1))
    assert parts.gain.mean == pytest.approx(whole.gain.mean)
    np.testing.assert_allclose(parts.gain.ci95, whole.gain.ci95)


def test_logs_of_different_lengths_are_refused():
    logs = [log_of(np.zeros((60, steps)), independent=True) for steps in (5, 6)]
    with pytest.raises(InputError, match="logs: got runs of 5 to 6 steps"):
        next(Replay(logs).recombined(2, np.random.default_rng(0)))


# ── what a candidate brings ──


@pytest.mark.quick(1)
@pytest.mark.parametrize(("size", "runs"), [("constant", 60), ("falling", 60), ("constant", 200), ("constant", 24)])
def test_the_interval_covers_the_truth_and_is_narrower_than_that_of_whole_runs(size, runs):
    """In at least 88 of 100 logs: 95 less three and a half standard errors, as returns are skewed."""
    scale = 1.0 if size == "constant" else 1 + 9 * np.exp(-np.arange(STEPS) / 5)
    rng = np.random.default_rng(10)
    true = np.mean([gains(scale * rng.standard_normal((5000, STEPS))).mean() for _ in range(10)])
    covered, narrower = [], []
    for _ in range(100):
        e = scale * rng.standard_normal((runs, STEPS))
        found = recombined_gain(Replay([log_of(e, independent=True)]), both(0.7, 0.97), COST, 6 * runs, rng).gain
        covered.append(found.ci95[0] < true < found.ci95[1])
        whole = summarise(gains(e)).ci95
        narrower.append((found.ci95[1] - found.ci95[0]) / (whole[1] - whole[0]))
    assert np.sum(covered) >= 88
    assert np.mean(narrower) < 0.9


def gains(e):
    """What the pole 0.7 brings in the place of 0.97, run by run."""
    return returns(0.7, e) - returns(0.97, e)


def test_nothing_changed_brings_nothing():
    replay = Replay([log_of(np.random.default_rng(0).standard_normal((60, STEPS)), independent=True)])
    found = recombined_gain(replay, both(0.9, 0.9), COST, 600, np.random.default_rng(0))
    assert (found.gain.mean, found.gain.ci95, found.more_lost) == (0.0, (0.0, 0.0), False)
    assert found.size > 0


def test_a_gain_is_half_that_of_the_logged_runs():
    """Every run pushes to one side, and recombined that is lost: were it not seen, half of it would still count."""
    e = np.random.default_rng(1).standard_normal((60, STEPS))
    e = np.sign(e[:, :1]) * np.abs(e)
    replay = Replay([log_of(e, independent=True)])
    found = recombined_gain(replay, both(0.7, 0.97), COST, 600, np.random.default_rng(0)).gain
    recombined = np.concatenate([w[..., 0] for _, w, _ in replay.recombined(10, np.random.default_rng(0))])
    assert gains(recombined).mean() < 0.9 * gains(e).mean()
    assert found.mean == pytest.approx((gains(recombined).mean() + gains(e).mean()) / 2)


def test_one_or_two_lost_runs_among_many_are_chance_and_a_share_is_not():
    e = np.random.default_rng(2).standard_normal((60, STEPS))
    replay = Replay([log_of(e, independent=True)])

    def judged(edge):
        """Return what is said of a candidate that loses the runs beyond an edge."""
        drive = lambda x0, w: (loop(0.9, edge)(x0, w), loop(0.9)(x0, w))  # noqa: E731
        lost = sum(drive(x0, w)[0].diverged.sum() for x0, w, _ in replay.recombined(20, np.random.default_rng(0)))
        return lost, recombined_gain(replay, drive, COST, 1200, np.random.default_rng(0))

    most = max(np.abs(loop(0.9)(x0, w).states).max(axis=(1, 2)).max()
               for x0, w, _ in replay.recombined(20, np.random.default_rng(0)))  # fmt: skip
    lost, found = judged(0.99 * most)
    assert 1 <= lost <= 3
    assert not found.more_lost
    assert np.isfinite(found.gain.ci95).all()
    lost, found = judged(0.5 * most)
    assert lost > 60
    assert found.more_lost
    none = recombined_gain(replay, lambda x0, w: (loop(0.9, 1e-9)(x0, w), loop(0.9)(x0, w)), COST, 120,
                           np.random.default_rng(0))  # fmt: skip
    assert none.more_lost
    assert np.isnan(none.gain.mean)


def test_a_candidate_that_loses_logged_runs_has_more_lost_whatever_becomes_of_recombined_ones():
    e = np.random.default_rng(1).standard_normal((60, STEPS))
    logged = {run.tobytes() for run in e[:6]}

    def drive(x0, w):
        """Return the runs of a candidate that only these six logged runs throw off."""
        run = loop(0.8)(x0, w)
        lost = np.array([one.tobytes() in logged for one in w[..., 0]])
        return replace(run, diverged_at=np.where(lost, 50, -1)), loop(0.95)(x0, w)

    found = recombined_gain(Replay([log_of(e, independent=True)]), drive, COST, 4000, np.random.default_rng(0))
    assert found.gain.ci95[0] > 0
    assert found.more_lost
    turned = lambda x0, w: drive(x0, w)[::-1]  # noqa: E731
    assert not recombined_gain(Replay([log_of(e, independent=True)]), turned, COST, 4000,
                               np.random.default_rng(0)).more_lost  # fmt: skip


def test_equal_blocks_have_students_interval_and_empty_ones_count_for_nothing():
    means = np.random.default_rng(3).standard_normal(8)
    found = over_blocks(means, np.full(8, 5.0))
    assert found.mean == pytest.approx(summarise(means).mean)
    np.testing.assert_allclose(found.ci95, summarise(means).ci95)
    with_empty = over_blocks(np.append(means, 1e9), np.append(np.full(8, 5.0), 0.0))
    np.testing.assert_allclose(with_empty.ci95, found.ci95)
    heavy = over_blocks(means, np.array([1e6, *np.ones(7)]))
    assert heavy.mean == pytest.approx(means[0], abs=1e-4)
    assert np.isnan(over_blocks(means, np.eye(8)[0]).ci95).all()
    assert np.isnan(over_blocks(means, np.zeros(8)).mean)


def test_a_log_keeps_what_was_told_of_it():
    log = log_of(np.zeros((40, 5)), independent=True)
    assert log.part(slice(0, 3), slice(0, 2)).independent
    assert log.carried(np.eye(1)).independent
    assert not replace(log, independent=False).independent
