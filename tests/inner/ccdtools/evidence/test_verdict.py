"""A candidate takes the place of another only where it shows what is asked of it, on every distribution."""

from dataclasses import replace

import numpy as np
import pytest

from ccdtools import CVaR, InputError, QuadraticObjective
from ccdtools.co_design.risk import MEAN
from ccdtools.evidence.evidence import NOTHING, Asked, Evidence, Pairing, Violation
from ccdtools.evidence.verdict import Status, Verdict, decide
from ccdtools.statistics import PairedDifference
from ccdtools.trajectory import Trajectory

NAN = float("nan")
BROKEN = Violation((0.1, 0.2), (0.0, 0.0), (0.01, 0.05), "v > 1", False)


def evidence(mean, low, high, asked=Asked.GAIN, *, size=100.0, distribution="the log", **others):
    """A gain of 400 runs in units of a hundredth of the return."""
    gain = PairedDifference(mean, (low, high))
    return Evidence("B", "A", distribution, asked, gain, (mean - size, -size), size, 400, "400 runs", **others)


GAIN = evidence(2.0, 1.0, 3.0)


@pytest.mark.parametrize(
    ("records", "status", "words"),
    [
        ([GAIN], Status.BETTER, "+2 % [+1, +3] on the log"),
        ([evidence(2.0, -0.1, 4.1)], Status.NO_GAIN, "+2 % [−0.1, +4.1] on the log"),
        ([evidence(0.0, 0.0, 0.0)], Status.NO_GAIN, "0 %"),
        ([evidence(-2.0, -3.0, -1.0)], Status.WORSE, "−2 %"),
        ([evidence(0.3, 0.2, 0.4, needed=0.5)], Status.BELOW_PRICE, "price 0.5 %"),
        ([evidence(0.3, -0.2, 0.8, needed=0.5)], Status.BELOW_PRICE, "price 0.5 %"),
        ([evidence(NAN, NAN, NAN)], Status.NO_GAIN, "n/a on the log"),
        # elsewhere a loss is accepted up to the tolerance, by the lower end of its interval
        ([GAIN, evidence(-0.3, -0.4, -0.2, Asked.TOLERANCE)], Status.BETTER, ""),
        ([GAIN, evidence(-5.4, -5.5, -5.3, Asked.TOLERANCE, distribution="the study's start")], Status.LOSS,
         "−5.4 % [−5.5, −5.3] on the study's start, tolerance 0.5 %"),
        ([GAIN, evidence(0.1, -0.6, 0.8, Asked.TOLERANCE)], Status.UNDECIDED, "+0.1 % [−0.6, +0.8]"),
        ([GAIN, evidence(0.4, NAN, NAN, Asked.TOLERANCE)], Status.UNDECIDED, "+0.4 %"),
        ([GAIN, evidence(NAN, NAN, NAN, Asked.TOLERANCE, lost=(5, 5))], Status.UNDECIDED, ""),
        # what costs nothing is not replaced by what costs something
        ([GAIN, evidence(-5.0, -6.0, -4.0, Asked.TOLERANCE, size=0.0)], Status.LOSS, ""),
        ([GAIN, evidence(0.0, 0.0, 0.0, Asked.TOLERANCE, size=0.0)], Status.BETTER, ""),
        # better is what gains where it was made for
        ([evidence(-3.0, -8.0, 2.0, Asked.NO_SURE_LOSS), evidence(0.3, 0.2, 0.4, Asked.NO_SURE_LOSS)],
         Status.NO_LOSS_SHOWN, "−3 % [−8, +2] on the log"),
        ([evidence(-0.1, -0.4, 0.2, Asked.NO_SURE_LOSS)], Status.NOT_WORSE, ""),
        ([evidence(NAN, NAN, NAN, Asked.NO_LOSS)], Status.NOT_COMPARED, "n/a on the log"),
        ([evidence(NAN, NAN, NAN, Asked.NO_SURE_LOSS)], Status.NOT_COMPARED, "n/a on the log"),
        # what corrects a bias must lose on the nominal model, which is shown
        ([GAIN, evidence(-9.0, -9.1, -8.9, Asked.SHOWN)], Status.BETTER, ""),
        # lost runs and limits come before any return
        ([replace(GAIN, lost=(3, 1))], Status.MORE_LOST, "3 of 400 runs on the log, where A loses 1"),
        ([replace(GAIN, lost=(1, 1))], Status.BETTER, ""),
        ([GAIN, evidence(1.0, 0.9, 1.1, Asked.TOLERANCE, distribution="box", lost=(1, 0))], Status.MORE_LOST, "box"),
        ([replace(GAIN, violation=BROKEN)], Status.LIMITS, "v > 1: 10.00% of the samples"),
        # where the current one loses every run there is nothing to compare
        ([GAIN, evidence(NAN, NAN, NAN, Asked.TOLERANCE, size=0.0, lost=(400, 400))], Status.BETTER, ""),
        # a deployment must not be a loss: in the mean where something was redesigned, else beyond chance
        ([evidence(-0.2, -0.6, 0.2, Asked.NO_LOSS)], Status.NOT_BETTER, ""),
        ([evidence(-0.2, -0.6, 0.2, Asked.NO_SURE_LOSS)], Status.NO_LOSS_SHOWN, ""),
        ([evidence(-0.2, -0.3, -0.1, Asked.NO_SURE_LOSS)], Status.WORSE, ""),
        ([evidence(-0.2, NAN, NAN, Asked.NO_SURE_LOSS)], Status.NOT_BETTER, ""),
        ([evidence(0.2, NAN, NAN, Asked.NO_SURE_LOSS)], Status.NO_LOSS_SHOWN, ""),
        ([evidence(0.2, 0.1, 0.3, Asked.NO_LOSS)], Status.BETTER, ""),
    ],
)  # fmt: skip
def test_a_verdict_follows_from_its_evidence(records, status, words):
    verdict = decide(records)
    assert verdict.status is status
    assert words in verdict.reason
    stays = (Status.BETTER, Status.NOT_WORSE, Status.NO_LOSS_SHOWN, Status.NOT_COMPARED)
    assert verdict.replaces is (status in stays)
    assert verdict.status.replaces or verdict.status.advice
    kept = verdict.as_dict()
    assert kept["status"] == status.value
    assert len(kept["evidence"]) == len(records)
    assert kept["evidence"][0]["distribution"] == "the log"


def test_a_loss_is_accepted_where_the_user_says_so():
    loss = evidence(-0.8, -0.95, -0.6, Asked.TOLERANCE, distribution="the box of starts")
    assert decide([GAIN, loss]).status is Status.LOSS
    assert decide([GAIN, loss], tolerance=0.009).status is Status.UNDECIDED
    assert decide([GAIN, loss], tolerance=0.01).replaces
    assert not decide([GAIN, loss], tolerance=0.009).replaces


def test_a_verdict_names_its_evidence_by_distribution():
    verdict = decide([GAIN, evidence(0, 0, 0, Asked.SHOWN, distribution="the nominal model")])
    assert verdict.on("the nominal model").asked is Asked.SHOWN
    assert verdict.on("the moon") is None
    assert str(Verdict(Status.FIRST)) == "the first deployed"


@pytest.mark.parametrize(
    ("arguments", "options", "message"),
    [
        (([],), {}, r"evidence: got .*, expected at least one Evidence"),
        (([evidence(-30, -31, -29, Asked.SHOWN)],), {}, r"evidence: got .* one that is not only shown"),
        (([replace(GAIN, needed=NAN)],), {}, r"got a gain of 2, 1, 3, a price of nan and a size of 100 on"),
        (([evidence(1.0, -np.inf, 2.0)],), {}, r"evidence: got a gain of 1, -inf, 2, .*, expected finite numbers"),
        (([evidence(np.inf, 1.0, np.inf)],), {}, r"evidence: got a gain of inf, .*, expected finite numbers"),
        (([GAIN, evidence(1.0, 0.0, 2.0, Asked.TOLERANCE, size=NAN)],), {}, r"a size of nan on the log"),
        ((["better"],), {}, r"evidence: got .*, expected at least one Evidence"),
        (([GAIN],), {"tolerance": 5.0}, r"tolerance: got 5\.0, expected a fraction from 0 to 1"),
        (([GAIN],), {"tolerance": -0.1}, r"tolerance: got -0\.1, expected a fraction"),
    ],
)
def test_wrong_calls_are_refused(arguments, options, message):
    with pytest.raises(InputError, match=message):
        decide(*arguments, **options)


# ── what evidence is made of ──


def runs(cost, *, diverged=0, design=1.0, constant=0.0):
    """Runs of 20 steps that cost so much a step, (n,)."""
    states = np.sqrt(np.asarray(cost))[:, None, None] * np.ones((len(cost), 21, 1))
    at = np.where(np.arange(len(cost)) < diverged, 3, -1)
    return Trajectory(states, np.zeros((len(cost), 20, 1)), np.zeros((len(cost), 20, 1)), at, [design], 0.1)


def of(after, before, objective=None, **options):
    """The evidence of two sets of runs."""
    pairing = Pairing(objective or QuadraticObjective([[1.0]], [[1.0]]), **options.pop("pairing", {}))
    return pairing.evidence(after, before, names=("B", "A"), distribution="there", asked=Asked.GAIN, **options)


def test_evidence_is_the_paired_difference_of_whole_runs_by_students_t():
    rng = np.random.default_rng(0)
    before = 1 + 0.5 * rng.random(30)
    after = before - 0.1 + 0.02 * np.tile([-1.0, 1.0], 15)  # not skewed: the interval is that of the book
    found = of(runs(after), runs(before))
    difference = 20 * (before - after)
    half = 2.0452 * difference.std(ddof=1) / np.sqrt(30)
    assert found.gain.mean == pytest.approx(difference.mean())
    assert found.gain.ci95 == pytest.approx((difference.mean() - half, difference.mean() + half), rel=1e-4)
    assert found.values == pytest.approx((-20 * after.mean(), -20 * before.mean()))
    assert (found.size, found.runs, found.grouped) == (pytest.approx(20 * before.mean()), 30, "30 runs")


@pytest.mark.parametrize("risk", [MEAN, CVaR(0.1)])
def test_a_reward_that_is_not_finite_is_refused_in_every_risk(risk):
    broken = np.where(np.arange(40) == 7, np.nan, 1.0)
    with pytest.raises(InputError, match=r"rewards of B: got (nan|-?inf) at index"):
        of(runs(broken), runs(np.ones(40)), pairing={"risk": risk})
    assert of(runs(np.roll(broken, -7), diverged=1), runs(np.ones(40)), pairing={"risk": risk}).gain.mean == 0.0


def test_runs_that_met_one_disturbance_are_one_piece_of_evidence():
    rng = np.random.default_rng(1)
    before, after = 1 + rng.random((2, 10))
    once = of(runs(after), runs(before))
    labels = np.repeat(np.arange(10), 4)
    four_times = of(runs(np.repeat(after, 4)), runs(np.repeat(before, 4)), groups=labels)
    np.testing.assert_allclose(four_times.gain.ci95, once.gain.ci95)
    assert four_times.grouped == "40 runs in 10 groups"


def test_lost_runs_are_counted_and_left_out_of_both():
    found = of(runs(np.full(10, 2.0), diverged=3), runs(np.linspace(1, 2, 10), diverged=1))
    assert found.lost == (3, 1)
    assert found.values == pytest.approx((-40, -20 * np.linspace(1, 2, 10)[3:].mean()))
    nothing = of(runs(np.full(4, 2.0)), runs(np.full(4, 2.0), diverged=4))
    assert nothing.gain is NOTHING
    assert nothing.size == 0


def test_a_risk_and_the_cost_of_a_design_are_named_and_left_out():
    costly = QuadraticObjective([[1.0]], [[1.0]], design_cost=lambda p: 1e6)
    before = np.linspace(1, 2, 200)
    found = of(runs(0.9 * before), runs(before), costly, pairing={"risk": CVaR(0.1)})
    assert found.measure == "mean of the worst 10 %"
    assert found.percent.endswith("] in the mean of the worst 10 %")
    assert found.size == pytest.approx(20 * before.mean())
    assert found.gain.mean == pytest.approx(0.1 * 20 * np.sort(before)[-20:].mean())
