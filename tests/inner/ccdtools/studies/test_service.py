"""What is deployed stays only if it is not worse, as measured, than what was deployed before: stretch by stretch."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from ccdtools import CVaR, QuadraticObjective
from ccdtools.evidence.evidence import Asked, Evidence, Pairing, Violation
from ccdtools.evidence.verdict import Status, Verdict
from ccdtools.statistics import PairedDifference, Summary, summarise
from ccdtools.studies.account import account, proposed, refused
from ccdtools.studies.names import FORMER
from ccdtools.studies.redesign import Redesign
from ccdtools.studies.report.headline import _brought, _phrase
from ccdtools.studies.service import (
    UPDATED_SINCE,
    Agreement,
    Delivery,
    Deployed,
    _agreement,
    after_deployment,
    judge_deployment,
    measured,
)
from ccdtools.trajectory import Trajectory
from ccdtools.twin.deployable import Deployable
from ccdtools.twin.online import OnlineUpdate

OBJECTIVE = QuadraticObjective([[1.0]], [[1.0]])
PAIRING = Pairing(OBJECTIVE)
RUNS, STEPS = 60, 20
BROKEN = Violation((0.1, 0.2), (0.0, 0.0), (0.01, 0.05), "v > 1", False)
PREDICTED = summarise(np.linspace(-1.1, -0.9, 40) * STEPS)


def policy(name, weight):
    """A deployable that another of the same weight is the same as."""
    return Deployable(SimpleNamespace(state_dict=lambda: {"w": np.array([weight])}), np.ones(1), name)


A, AFTER, B, B_AFTER = (policy(name, k) for k, name in enumerate(("A", "A updated", "B", "B updated")))


def log(cost=1.0, *, noise_seed=0, disturbance_seed=0, diverged=0, spread=0.5, runs=RUNS):
    """A log whose runs cost about `cost` (n,) a step; runs of one noise seed share their noise."""
    noise = np.abs(np.random.default_rng(noise_seed).standard_normal((runs, 1, 1)))
    cost = np.broadcast_to(cost, (runs,))[:, None, None]
    states = np.sqrt(cost * (1 - spread + spread * noise)) * np.ones((runs, STEPS + 1, 1))
    w = np.random.default_rng(disturbance_seed).standard_normal((runs, STEPS, 1))
    at = np.where(np.arange(runs) < diverged, 3, -1)
    return Trajectory(states, np.zeros((runs, STEPS, 1)), w, at, np.ones(1), 0.1)


def first(trajectory, changes=()):
    """The former deployment: of A, updated on the way."""
    return Deployed(1, A, AFTER if changes else A, trajectory, changes)


def second(trajectory, changes=(), designed=B):
    """The later one, of B or of what was deployed."""
    after = {"B": B_AFTER, "A": AFTER}[designed.name] if changes else designed
    return Deployed(2, designed, after, trajectory, changes)


def judged(deployed, former, current=A, *, redesigned=True, predicted=PREDICTED, pairing=PAIRING, **others):
    return judge_deployment(
        deployed, former, current, pairing, lambda _: predicted, redesigned=redesigned, **others
    )  # fmt: skip


def status(*arguments, **options):
    return judged(*arguments, **options).verdict.status


def test_the_first_generation_stays_whatever_is_measured():
    assert status(second(log(9.0)), None, None) is Status.FIRST


def test_pairs_on_the_same_disturbances_tell_half_a_per_cent():
    assert status(second(log(0.995)), first(log(1.0))) is Status.BETTER
    worse = judged(second(log(1.005)), first(log(1.0)))
    assert worse.verdict.status is Status.WORSE
    assert worse.verdict.status.advice
    (found,) = worse.verdict.evidence
    assert found.candidate == "B in deployment 2, runs 1 to 60"
    assert found.current == "A in deployment 1, runs 1 to 60"
    assert found.runs == 30  # every second run met the same disturbance


def test_a_worse_redesign_is_not_credited_with_an_update_of_the_deployment_before():
    """A was replaced by its update after half of the runs. B is better than A, and worse than what is deployed."""
    mixed = log(np.where(np.arange(RUNS) < 30, 1.3, 1.0))
    delivery = judged(second(log(1.02)), first(mixed, changes=(30 * STEPS,)), AFTER)
    assert OBJECTIVE is PAIRING.objective
    whole = log(1.02).returns(OBJECTIVE) - mixed.returns(OBJECTIVE)
    assert whole.mean() > 0  # beside the whole former deployment it would look better
    assert delivery.verdict.status is Status.WORSE
    assert not delivery.verdict.replaces
    (found,) = delivery.verdict.evidence
    assert found.current == "A updated in deployment 1, runs 31 to 60"
    assert found.candidate == "B in deployment 2, runs 31 to 60"
    np.testing.assert_allclose(100 * found.gain.mean / found.size, -2, rtol=1e-6)


def test_of_one_run_the_same_steps_are_compared():
    rng = np.random.default_rng(0)
    x = rng.standard_normal((1, 3001, 1))
    scale = np.where(np.arange(3001) < 1500, 1.2, 1.0)[None, :, None]
    logs = [Trajectory(c * x, np.zeros((1, 3000, 1)), np.zeros((1, 3000, 1)), np.array([-1]), np.ones(1), 0.1)
            for c in (scale, 1.01)]  # fmt: skip
    delivery = judged(second(logs[1]), first(logs[0], changes=(1500,)), AFTER)
    assert delivery.verdict.status is Status.WORSE
    (found,) = delivery.verdict.evidence
    assert found.current == "A updated in deployment 1, steps 1500 to 3000"
    assert found.gain.mean == pytest.approx(-(1.01**2 - 1) * np.square(x[0, 1501:]).sum())


def test_a_redesign_that_is_updated_on_the_way_is_judged_by_its_whole_deployment():
    """A loss within chance in the first stretch, of 40 runs, and a gain in the second."""
    rng = np.random.default_rng(0)
    noise = np.where(np.arange(RUNS) // 2 % 2, 1, -1)  # of every second run, half each
    before, base = np.arange(RUNS) < 40, 1 + 0.1 * rng.random(RUNS)

    def deployed(change, then):
        cost = base * (1 + np.where(before, change, then) + 0.02 * noise)
        return second(log(cost, spread=0), changes=(40 * STEPS,)), first(log(base, spread=0))

    def delivery(change, then):
        return judged(*deployed(change, then))

    later, former = deployed(0.004, -0.02)
    alone = measured(PAIRING, [B], later, A, former, Asked.NO_LOSS)
    assert alone.gain.mean < 0 < alone.gain.ci95[1]
    kept = judged(later, former)
    whole, after = kept.verdict.evidence
    assert kept.replaces
    assert whole.candidate == "B and B updated in deployment 2, runs 1 to 60"
    assert after.candidate == "B updated in deployment 2, runs 41 to 60"
    assert after.gain.mean > whole.gain.mean > 0
    assert delivery(0.02, 0.0).verdict.status is Status.WORSE
    harmed = delivery(-0.06, 0.05)
    assert harmed.verdict.evidence[0].gain.mean > 0
    assert harmed.verdict.status is Status.WORSE  # what would stay is the update
    assert UPDATED_SINCE in harmed.verdict.reason
    text = account(2, harmed, [OnlineUpdate(100, made(Status.BETTER), None)], REDESIGN, "m = 1 kg")
    gain, loss = (one.percent for one in harmed.verdict.evidence)
    assert f"and measured with its updates {gain} against generation 1" in text
    assert f"worse: {loss} on the deployment since its last update, so design and policy of generation 1 stay" in text


def test_what_never_met_the_policy_before_is_not_named_and_not_judged():
    """A was updated after 40 runs, B after 30: of B alone no run is beside what was deployed before."""
    cost = np.where(np.arange(RUNS) < 30, 2.0, 0.97)
    found = judged(second(log(cost), changes=(30 * STEPS,)), first(log(1.0), changes=(40 * STEPS,)), AFTER)
    (one,) = found.verdict.evidence
    assert one.candidate == "B updated in deployment 2, runs 41 to 60"
    assert found.verdict.status is Status.BETTER


def test_an_update_that_drove_one_common_run_is_shown_and_judged_with_the_rest():
    cost = np.where(np.arange(RUNS) < 58, 1.0, 1.5)
    found = judged(second(log(cost), changes=(58 * STEPS,)), first(log(1.0)))
    assert [one.asked for one in found.verdict.evidence] == [Asked.NO_LOSS, Asked.SHOWN]
    assert found.verdict.status is Status.NOT_BETTER


def test_policies_that_never_met_the_same_disturbance_are_not_compared():
    former = first(log(), changes=(30 * STEPS,))
    assert measured(PAIRING, [B], second(log(), changes=(20 * STEPS,)), AFTER, former, Asked.NO_LOSS) is None
    assert measured(PAIRING, [B], second(log(disturbance_seed=1)), A, first(log()), Asked.NO_LOSS) is None
    assert measured(PAIRING, [policy("C", 9)], second(log()), A, first(log()), Asked.NO_LOSS) is None


def test_updates_of_the_former_deployment_are_measured_by_the_next_and_rolled_back_where_they_hurt():
    """Nothing was redesigned: what was updated drives a whole deployment, beside the stretch before the update."""
    former = first(log(1.0), changes=(40 * STEPS,))
    again = second(log(1.05), designed=AFTER)
    delivery = judged(again, former, AFTER, redesigned=False)
    assert delivery.carried
    assert delivery.verdict.status is Status.WORSE
    assert delivery.verdict.evidence[0].current == "A in deployment 1, runs 1 to 40"
    service, reference = after_deployment(again, AFTER, former, replaces=False, carried=True)
    assert (service, reference) == (A, former)
    idle = judged(second(log(), designed=A), first(log()), A, redesigned=False)
    assert idle.verdict.status is Status.NOT_WORSE
    assert idle.verdict.evidence == ()
    _, reference = after_deployment(second(log(), designed=A), A, first(log()), replaces=True, carried=False)
    assert reference.generation == 1


def test_what_fell_short_is_rolled_back():
    former = first(log(), changes=(40 * STEPS,))
    later = second(log(1.1), changes=(40 * STEPS,))
    service, reference = after_deployment(later, AFTER, former, replaces=False, carried=False)
    assert (service, reference) == (AFTER, former)
    service, reference = after_deployment(later, AFTER, former, replaces=True, carried=False)
    assert (service, reference) == (B_AFTER, later)


def test_a_redesign_that_brings_a_loss_within_chance_does_not_stay_and_updates_do():
    rng = np.random.default_rng(0)
    base = 1 + 0.1 * rng.random(RUNS)
    found = set()
    for _ in range(20):
        other = base + 0.05 * rng.standard_normal(RUNS)
        delivery = judged(second(log(other, spread=0)), first(log(base, spread=0)))
        (one,) = delivery.verdict.evidence
        if one.gain.ci95[0] < 0 < one.gain.ci95[1]:
            stays = Status.NOT_WORSE if one.gain.ci95[0] >= -0.005 * one.size else Status.NO_LOSS_SHOWN
            assert delivery.verdict.status is (stays if one.gain.mean >= 0 else Status.NOT_BETTER)
            found.add(delivery.verdict.replaces)
            updates = second(log(other, spread=0), designed=AFTER)
            assert status(updates, first(log(base, spread=0)), A, redesigned=False) is stays
    assert len(found) == 2


def test_more_lost_runs_are_never_taken_however_good_the_rest():
    assert status(second(log(0.5, diverged=1)), first(log(1.0))) is Status.MORE_LOST
    assert status(second(log(0.5, diverged=1)), first(log(1.0, diverged=1))) is Status.BETTER
    everything = judged(second(log(0.5, diverged=RUNS)), first(log(1.0)))
    assert everything.verdict.status is Status.MORE_LOST
    assert everything.agreement is Agreement.LESS


def test_limits_that_were_broken_come_before_a_gain():
    delivery = judged(second(log(0.9)), first(log(1.0)), limits=lambda after, before: BROKEN)
    assert delivery.verdict.status is Status.LIMITS
    assert delivery.as_dict()["breach"] == str(BROKEN)


@pytest.mark.parametrize(("cost", "agreement"), [(1.0, Agreement.AGREED), (4.0, Agreement.LESS), (0.2, Agreement.MORE)])
def test_a_prediction_is_wrong_where_the_measured_return_lies_beyond_both_intervals(cost, agreement):
    assert judged(second(log(cost, spread=0.0 if cost == 1 else 0.5)), None, None).agreement is agreement
    assert agreement.kept == {"within chance": True, "more than predicted": None}.get(agreement.value, False)


def test_predicted_and_measured_returns_are_of_the_policy_as_designed():
    """Its updates are not what was predicted."""
    mixed = log(np.where(np.arange(RUNS) < 40, 1.0, 0.5), spread=0.0)
    delivery = judged(second(mixed, changes=(40 * STEPS,)), None, None)
    assert delivery.returns.n == 40
    assert delivery.returns.mean == pytest.approx(-STEPS)


@pytest.mark.check
def test_a_prediction_that_is_right_is_called_wrong_in_one_deployment_of_five_hundred():
    rng = np.random.default_rng(0)
    told = {"many": 0, "few": 0}
    for name, runs in (("many", 100), ("few", 4)):
        for _ in range(1000):
            predicted = summarise(rng.standard_normal(400) - 20)
            told[name] += _agreement(predicted, summarise(rng.standard_normal(runs) - 20)) is Agreement.LESS
    assert max(told.values()) <= 8  # 2 expected
    assert _agreement(predicted, summarise(rng.standard_normal(100) - 20.5)) is Agreement.LESS


@pytest.mark.parametrize(("apart", "agreement"), [(1.95, Agreement.AGREED), (2.2, Agreement.LESS)])
def test_a_right_prediction_is_called_wrong_with_a_chance_of_two_in_a_thousand(apart, agreement):
    """Two intervals of ±1 at 1.96 errors each: 2.88 errors are 2.08; at 0.6 % they would be 1.81, at 0.07 % 2.32."""
    predicted, measured = (Summary(mean, 1.0, mean, 10**6, (mean - 1, mean + 1)) for mean in (apart, 0.0))
    assert _agreement(predicted, measured) is agreement


def test_returns_whose_intervals_are_apart_are_not_said_to_agree():
    """A drive of few degrees of freedom may lie outside the interval of what was predicted, and say little."""
    predicted = Summary(-4585.0, 500.0, -4585.0, 400, (-4620.0, -4550.0))
    measured = Summary(-7465.0, 1200.0, -7465.0, 1, (-10000.0, -4930.0))
    assert _agreement(predicted, measured) is _agreement(measured, predicted) is Agreement.APART
    assert _agreement(predicted, predicted) is Agreement.AGREED
    assert _agreement(predicted, replace(measured, ci95=(-10000.0, -4600.0))) is Agreement.AGREED


def test_without_an_interval_a_loss_on_the_drive_is_enough_to_roll_updates_back():
    """A drift is no series that an interval can come from."""
    states = np.linspace(1, 3, 501)[None, :, None]
    logs = [Trajectory(c * states, np.zeros((1, 500, 1)), np.zeros((1, 500, 1)), np.array([-1]), np.ones(1), 0.1)
            for c in (1.0, 1.01, 0.99)]  # fmt: skip
    worse, better = (judged(second(one, designed=AFTER), first(logs[0]), A, redesigned=False) for one in logs[1:])
    assert np.isnan(worse.verdict.evidence[0].gain.ci95).all()
    assert worse.verdict.status is Status.NOT_BETTER
    assert better.verdict.status is Status.NO_LOSS_SHOWN


def test_an_empty_prediction_says_nothing():
    assert judged(second(log()), None, None, predicted=summarise([-20.0])).agreement is Agreement.OPEN


def test_what_is_better_in_the_mean_and_worse_in_the_worst_runs_does_not_stay():
    rng = np.random.default_rng(0)
    small = 0.01 * rng.random(RUNS)
    rough = np.arange(RUNS) % 4 < 2  # half of the common runs, which are every second one
    before = np.where(rough, 1.6, 1.2) + small
    after = np.where(rough, 1.9, 0.1) + small
    runs = (second(log(after, spread=0)), first(log(before, spread=0)))
    assert status(*runs) is Status.BETTER
    risky = judged(*runs, pairing=Pairing(OBJECTIVE, CVaR(0.4)))
    assert risky.verdict.status is Status.WORSE
    assert risky.as_dict()["measure"] == "mean of the worst 40 %"


@pytest.mark.parametrize("constant", [0.0, 1e6])
def test_changes_are_parts_of_what_control_makes_whatever_the_design_costs(constant):
    objective = QuadraticObjective([[1.0]], [[1.0]], design_cost=lambda p: constant)
    found = judged(second(log(1.0, spread=0)), first(log(1.2, spread=0)), pairing=Pairing(objective))
    assert found.size == pytest.approx(1.2 * STEPS)


# ── the sentence of a generation ──


def made(status, change=-1.0, *, broken=None, size=50.0, measure="mean", reason=""):
    """A verdict on a change of a return of that size."""
    gain = PairedDifference(change, (change - 0.5, change + 0.5))
    one = Evidence("B", "A", "the replayed log", Asked.GAIN, gain, (-51.0, -50.0), size, 20, "20 runs",
                   violation=broken, measure=measure)  # fmt: skip
    return Verdict(status, (one,), reason)


REDESIGN = Redesign(True, True, "moved the design to m = 1 kg, predicted +3 %")
REFUSED = made(Status.BELOW_PRICE, reason="+0.1 % on the replayed log, price 0.5 %", change=1.0, size=100.0)


def delivery(status, *, agreement=Agreement.AGREED, carried=False, **of):
    """A delivery that is compared with generation 1."""
    predicted, returns = (Summary(mean, 1.0, mean, 20, (mean - 1, mean + 1)) for mean in (-40.0, -51.0))
    return Delivery(predicted, returns, agreement, made(status, **of), 50.0, carried, 1)


def said(status, *, accepted=False, updates=(False, False), moved=True, chosen="redesign", edges=None, **others):
    """The account of a generation 3."""
    text = refused(REFUSED, moved=moved)
    if accepted:
        text = proposed(chosen, REFUSED, "m = 1 kg", edges or {}, moved=moved)
    tried = [OnlineUpdate(100, made(Status.BETTER if taken else Status.NO_GAIN), None) for taken in updates]
    return account(3, delivery(status, **others), tried, Redesign(accepted, moved, text), "m = 1 kg")


def test_a_generation_that_changed_nothing_says_so_and_why():
    assert said(Status.NOT_WORSE) == (
        "generation 3 changed nothing: the best redesign found was predicted +1 % [+0.5, +1.5] and refused, less than "
        "its price: +0.1 % on the replayed log, price 0.5 %; 0 of 2 updates accepted, the deployed policy is that of "
        "generation 1, unchanged"
    )


def test_a_redesign_rolled_back_says_what_was_predicted_and_measured():
    assert said(Status.WORSE, accepted=True, agreement=Agreement.LESS) == (
        "generation 3 moved the design to m = 1 kg, predicted +1 % [+0.5, +1.5] and measured −2 % [−3, −1] against "
        "generation 1; worse, so design and policy of generation 1 stay deployed; less than predicted, a deployed "
        "return of −40.00; 0 of 2 updates accepted, none of it is due to updates"
    )


def test_a_redesign_that_the_trust_region_holds_back_and_a_return_to_the_start_say_so():
    text = said(Status.BETTER, accepted=True, edges={"m": "upper"})
    assert text.startswith("generation 3 moved the design to m = 1 kg, at the edge of the trust region (m), predicted")
    text = said(Status.BETTER, accepted=True, chosen=FORMER + "the start")
    assert text.startswith("generation 3 returned to the start, m = 1 kg, predicted +1 %")


@pytest.mark.parametrize("agreement", [Agreement.AGREED, Agreement.LESS])
def test_the_first_generation_says_that_less_was_measured_than_predicted(agreement):
    less = ", less than predicted" if agreement is Agreement.LESS else ""
    assert account(1, delivery(Status.FIRST, agreement=agreement), [], None, "m = 1 kg") == (
        "generation 1 designed m = 1 kg on the nominal model; predicted a deployed return of −40.00, measured "
        f"−51.00{less}; no update was tried; the policy is as designed"
    )


def test_updates_alone_are_named_and_so_is_what_was_rolled_back():
    text = said(Status.BETTER, updates=(True, False))
    assert "changed the policy only, by updates while deployed" in text
    assert "measured −2 % [−3, −1] against generation 1" in text
    assert text.endswith("1 of 2 updates accepted, design of generation 1, policy updated") or text.endswith("accepted")
    assert "its updates were rolled back" in said(Status.WORSE, updates=(True, False))
    carried = said(Status.WORSE, carried=True)
    assert carried.startswith(
        "generation 3 was worse than generation 1 (−2 % [−3, −1]), so that the updates of generation 1, measured by a "
        "whole deployment, were rolled back: the best redesign found"
    )
    assert "the deployed policy is that of generation 1 before its updates" in carried
    assert "in the mean of the worst 10 %)" in said(Status.WORSE, carried=True, measure="mean of the worst 10 %")
    assert f"({BROKEN})" in said(Status.LIMITS, broken=BROKEN)


def test_the_headline_says_whose_updates_were_rolled_back():
    generation = {"generation": 2, "redesign": {"accepted": False}, "online_updates": [],
                  "delivery": delivery(Status.WORSE, carried=True).as_dict()}  # fmt: skip
    assert _brought(generation)
    assert "updates of generation 1" in _phrase({}, generation, moved=False)
    generation["delivery"] = delivery(Status.WORSE).as_dict()
    assert not _brought(generation)


def test_what_is_not_compared_says_why_and_names_no_number():
    why = "the plant has changed"
    alone = said(Status.NOT_COMPARED, updates=(True, False), reason=why)
    assert f"; not compared with generation 1, {why}; 1 of 2 updates accepted" in alone
    moved = said(Status.NOT_COMPARED, accepted=True, reason="no samples in common")
    assert "predicted +1 % [+0.5, +1.5] and not compared with generation 1, no samples in common" in moved
    assert "measured" not in alone + moved


def test_deployments_of_two_plants_are_not_compared_and_updates_of_the_second_are_judged_by_the_next():
    one, other = first(log(1.0)), second(log(2.0))
    assert status(other, one) is Status.WORSE
    assert status(other, one, other_plant=True) is Status.NOT_COMPARED
    changed = second(log(1.0, disturbance_seed=3), changes=(30 * STEPS,), designed=A)
    delivery = judged(changed, one, A, redesigned=False, other_plant=True)
    service, served = after_deployment(changed, A, one, replaces=delivery.replaces, carried=delivery.carried)
    assert service is AFTER
    again = Deployed(3, AFTER, AFTER, log(1.05, disturbance_seed=3))
    after = judged(again, served, service, redesigned=False)
    assert after.verdict.status is Status.WORSE
    kept, _ = after_deployment(again, service, served, replaces=after.replaces, carried=after.carried)
    assert kept is A
