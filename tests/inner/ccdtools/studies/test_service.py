"""What is deployed replaces what is in service only if it delivers."""

from types import SimpleNamespace

import numpy as np
import pytest

from ccdtools import QuadraticObjective, Trajectory
from ccdtools.statistics import summarise
from ccdtools.studies.account import account
from ccdtools.studies.redesign import InService
from ccdtools.studies.report.formatting import FORMER
from ccdtools.studies.service import (
    JudgeStatus,
    Served,
    ServiceStatus,
    _agreement,
    after_deployment,
    judge_deployment,
    welch_difference,
)

OBJECTIVE = QuadraticObjective([[1.0]], [[1.0]])
RUNS, STEPS = 60, 20
PROMISE = summarise(np.linspace(-1.1, -0.9, 40) * STEPS)


def log(cost=1.0, *, noise_seed=0, disturbance_seed=0, diverged=0, spread=0.5, runs=RUNS):
    """A log whose runs cost about `cost` a step; runs of one noise seed share their noise."""
    noise = np.abs(np.random.default_rng(noise_seed).standard_normal((runs, 1, 1)))
    states = np.sqrt(cost * (1 - spread + spread * noise)) * np.ones((runs, STEPS + 1, 1))
    w = np.random.default_rng(disturbance_seed).standard_normal((runs, STEPS, 1))
    at = np.where(np.arange(runs) < diverged, 3, -1)
    return Trajectory(states, np.zeros((runs, STEPS, 1)), w, at, np.ones(1), 0.1)


def verdict(deployed, former, *, redesigned=True, promise=PROMISE):
    return judge_deployment(deployed, former, OBJECTIVE, promise, redesigned=redesigned)


def test_the_first_generation_serves_whatever_it_delivers():
    assert verdict(log(9.0), None).status is ServiceStatus.FIRST


def test_pairs_on_the_same_disturbances_tell_half_a_per_cent():
    assert verdict(log(0.995), log(1.0)).status is ServiceStatus.BETTER
    worse = verdict(log(1.005), log(1.0))
    assert worse.status is ServiceStatus.WORSE
    assert worse.paired
    assert not worse.status.replaces
    assert worse.status.advice


def test_other_disturbances_are_compared_by_welch_which_tells_less():
    worse = verdict(log(1.005, noise_seed=1, disturbance_seed=1), log(1.0))
    assert not worse.paired
    assert worse.change.ci95[0] < 0 < worse.change.ci95[1]
    assert verdict(log(2.0, noise_seed=1, disturbance_seed=1), log(1.0)).status is ServiceStatus.WORSE


def test_a_redesign_that_brings_a_loss_within_chance_does_not_stay_and_one_without_loss_does():
    for seed in range(20):
        delivered = verdict(log(1.0, noise_seed=seed + 1, disturbance_seed=1), log(1.0))
        low, high = delivered.change.ci95
        if low < 0 < high:
            expected = ServiceStatus.NOT_WORSE if delivered.change.mean >= 0 else ServiceStatus.NOT_BETTER
            assert delivered.status is expected
    unchanged = verdict(log(1.0), log(1.0), redesigned=False)
    assert unchanged.change.mean == 0
    assert unchanged.status is ServiceStatus.NOT_WORSE


def test_more_divergence_is_never_taken_however_good_the_rest():
    assert verdict(log(0.5, diverged=1), log(1.0)).status is ServiceStatus.DIVERGED
    assert verdict(log(0.5, diverged=1), log(1.0, diverged=1)).status is ServiceStatus.BETTER
    everything = verdict(log(0.5, diverged=RUNS), log(1.0))
    assert everything.status is ServiceStatus.DIVERGED
    assert everything.judge is JudgeStatus.LESS


def test_a_single_run_is_compared_block_by_block():
    rng = np.random.default_rng(0)
    states = rng.standard_normal((1, 3001, 1))
    w = np.zeros((1, 3000, 1))
    runs = [Trajectory(c * states, np.zeros((1, 3000, 1)), w, np.array([-1]), np.ones(1), 0.1) for c in (1.0, 1.01)]
    worse = verdict(runs[1], runs[0])
    assert worse.paired
    assert worse.status is ServiceStatus.WORSE


@pytest.mark.parametrize(
    ("cost", "judge"), [(1.0, JudgeStatus.AGREED), (4.0, JudgeStatus.LESS), (0.2, JudgeStatus.MORE)]
)
def test_the_judge_is_wrong_where_the_delivered_interval_lies_below_the_promised_one(cost, judge):
    assert verdict(log(cost, spread=0.0 if cost == 1 else 0.5), None).judge is judge
    assert judge.kept == {"within chance": True, "more than promised": None}.get(judge.value, False)


def test_a_judge_who_is_right_is_called_wrong_in_one_deployment_of_five_hundred():
    rng = np.random.default_rng(0)
    told = {"many": 0, "few": 0}
    for name, runs in (("many", 100), ("few", 4)):
        for _ in range(1000):
            promise = summarise(rng.standard_normal(400) - 20)
            told[name] += _agreement(promise, summarise(rng.standard_normal(runs) - 20)) is JudgeStatus.LESS
    assert max(told.values()) <= 8  # 2 expected
    assert _agreement(promise, summarise(rng.standard_normal(100) - 20.5)) is JudgeStatus.LESS


def test_without_an_interval_a_loss_on_the_drive_is_enough_to_take_updates_back():
    """A drift is no series that an interval can come from."""
    states = np.linspace(1, 3, 501)[None, :, None]
    logs = [Trajectory(c * states, np.zeros((1, 500, 1)), np.zeros((1, 500, 1)), np.array([-1]), np.ones(1), 0.1)
            for c in (1.0, 1.01, 0.99)]  # fmt: skip
    worse, better = (verdict(one, logs[0], redesigned=False) for one in logs[1:])
    assert np.isnan(worse.change.ci95).all()
    assert worse.status is ServiceStatus.NOT_BETTER
    assert better.status is ServiceStatus.NOT_WORSE


def test_an_empty_promise_says_nothing_of_the_judge():
    assert verdict(log(), None, promise=summarise([-20.0])).judge is JudgeStatus.OPEN


def test_welch_is_scipys_interval_and_nan_for_a_single_value():
    a, b = np.random.default_rng(0).standard_normal((2, 30)) * [[1], [3]]
    difference = welch_difference(a, b)
    assert difference.ci95[0] < difference.mean < difference.ci95[1]
    assert difference.mean == pytest.approx(a.mean() - b.mean())
    assert np.isnan(welch_difference(a[:1], b).ci95).all()


def test_what_fell_short_is_taken_back_and_updates_that_hurt_too():
    before = InService(SimpleNamespace(name="at the end of 1"), np.ones(1))
    first = Served(1, InService(SimpleNamespace(name="designed in 1"), np.ones(1)), log())
    second = Served(2, InService(SimpleNamespace(name="designed in 2"), 2 * np.ones(1)), log())
    end = SimpleNamespace(name="at the end of 2")
    service, speaks = after_deployment(ServiceStatus.BETTER, second, end, before, first, redesigned=True, updated=False)
    assert service.agent is end
    assert service.design == 2
    assert speaks is second
    service, speaks = after_deployment(ServiceStatus.WORSE, second, end, before, first, redesigned=True, updated=False)
    assert service is before
    assert speaks is first
    service, _ = after_deployment(ServiceStatus.WORSE, second, end, before, first, redesigned=False, updated=True)
    assert service is first.designed
    _, speaks = after_deployment(ServiceStatus.NOT_WORSE, second, end, before, first, redesigned=False, updated=False)
    assert speaks.generation == 1
    assert speaks.log is second.log


# ── the sentence of a generation ──


def decision(*, accepted, moved=True):
    """The values of a redesign's decision."""
    promise = {"promise": "+0.1 % [−0.2, +0.4]", "reason": "less than its price of 0.5 %"}
    gain = {"mean": 0.5, "ci95": [0.25, 0.75]}
    return promise | {"accepted": accepted, "moved": moved, "gain": gain}


def redesign(*, accepted, moved=True, chosen="redesign", edges=None):
    """The values of a redesign."""
    decisions = dict.fromkeys(("redesign", chosen), decision(accepted=accepted, moved=moved))
    region = {"edges": edges or {}}
    return {"accepted": accepted, "chosen": chosen if accepted else None, "decisions": decisions, "region": region}


def said(status, *, accepted=False, updates=(False, False), judge=JudgeStatus.AGREED, moved=True,
         chosen="redesign", edges=None):  # fmt: skip
    """The account of a generation 3 that was compared with generation 1."""
    delivery = {"former": 1, "status": status.value, "replaces": status.replaces, "judge": judge.value, "size": 50.0,
                "change": {"mean": -1.0, "ci95": [-1.5, -0.5]}, "promised": {"mean": -40.0}}  # fmt: skip
    values = {"delivery": delivery, "updates": [{"accepted": taken} for taken in updates],
              "deployed_return": {"mean": -51.0}}  # fmt: skip
    return account(3, values, redesign(accepted=accepted, moved=moved, chosen=chosen, edges=edges), "m = 1 kg")


def test_a_generation_that_changed_nothing_says_so_and_why():
    assert said(ServiceStatus.NOT_WORSE) == (
        "generation 3 changed nothing: the best redesign found promised +0.1 % [−0.2, +0.4], less than its price of "
        "0.5 %; 0 of 2 updates accepted, the policy in service is that of generation 1, unchanged"
    )


def test_a_redesign_taken_back_says_what_it_promised_and_delivered_and_that_the_judge_was_wrong():
    assert said(ServiceStatus.WORSE, accepted=True, judge=JudgeStatus.LESS) == (
        "generation 3 moved the design to m = 1 kg, promised +1 % [+0.5, +1.5] and delivered −2 % [−3, −1] against "
        "generation 1; worse, so design and policy of generation 1 stay in service; the judge was wrong: it promised a "
        "deployed return of −40.00; 0 of 2 updates accepted, all of it is the redesign's"
    )


def test_promised_and_delivered_changes_are_of_one_deployment_in_per_cent_of_one_return():
    """The promise of a redesign is of the deployed return in service, whatever its price was a part of."""
    assert "promised +1 % [+0.5, +1.5] and delivered −2 % [−3, −1]" in said(ServiceStatus.WORSE, accepted=True)


def test_a_redesign_that_the_trust_region_holds_back_says_so():
    text = said(ServiceStatus.BETTER, accepted=True, edges={"m": "upper"})
    assert text.startswith("generation 3 moved the design to m = 1 kg, at the edge of the trust region (m), promised")


def test_a_return_to_the_start_says_so():
    text = said(ServiceStatus.BETTER, accepted=True, chosen=FORMER + "the start")
    assert text.startswith("generation 3 returned to the start, m = 1 kg, promised +1 %")


@pytest.mark.parametrize("judge", [JudgeStatus.AGREED, JudgeStatus.LESS])
def test_the_first_generation_names_a_nominal_model_that_was_wrong(judge):
    delivery = {"former": None, "judge": judge.value, "promised": {"mean": -40.0}}
    values = {"delivery": delivery, "updates": [], "deployed_return": {"mean": -51.0}}
    wrong = "; the judge, here the nominal model, was wrong" if judge is JudgeStatus.LESS else ""
    assert account(1, values, None, "m = 1 kg") == (
        "generation 1 designed m = 1 kg on the nominal model; promised a deployed return of −40.00 and delivered "
        f"−51.00{wrong}; no update was tried; the policy is as designed"
    )


def test_updates_alone_are_named_as_what_did_it():
    text = said(ServiceStatus.BETTER, updates=(True, False))
    assert "changed the policy only, by updates while deployed" in text
    assert "delivered −2 % [−3, −1]" in text
    assert text.endswith("1 of 2 updates accepted")
    back = said(ServiceStatus.WORSE, updates=(True, False))
    assert "its updates were taken back" in back
