"""What is deployed is compared in the study's risk; what is taken back is named as what it was."""

import numpy as np
import pytest

from ccdtools import CVaR, QuadraticObjective, Trajectory
from ccdtools.statistics import summarise
from ccdtools.studies.account import account
from ccdtools.studies.report.headline import _brought, _phrase
from ccdtools.studies.service import ServiceStatus, judge_deployment

RUNS, STEPS = 60, 20
PROMISE = summarise(np.linspace(-1.1, -0.9, 40) * STEPS)
WORST = CVaR(0.1)


def log(cost, *, seed=0):
    """Runs that cost so much a step, (n,); those of one seed met the same disturbances."""
    states = np.sqrt(cost)[:, None, None] * np.ones((RUNS, STEPS + 1, 1))
    w = np.random.default_rng(seed).standard_normal((RUNS, STEPS, 1))
    return Trajectory(states, np.zeros((RUNS, STEPS, 1)), w, np.full(RUNS, -1), np.ones(1), 0.1)


def costs(worst):
    """Costs of runs, of which every fifth costs so much."""
    return np.where(np.arange(RUNS) % 5 == 0, worst, 0.8) + 0.01 * np.random.default_rng(0).random(RUNS)


@pytest.mark.parametrize("seed", [0, 1])
def test_what_is_better_in_the_mean_and_worse_in_the_worst_runs_does_not_stay(seed):
    """Compared in pairs on the same disturbances, and by Welch on others."""
    before, after = log(costs(1.2) + 0.4), log(costs(2.2), seed=seed)
    objective = QuadraticObjective([[1.0]], [[1.0]])
    plain = judge_deployment(after, before, objective, PROMISE, redesigned=True)
    risky = judge_deployment(after, before, objective, PROMISE, redesigned=True, risk=WORST)
    assert plain.paired is risky.paired is (seed == 0)
    assert plain.status is ServiceStatus.BETTER
    assert risky.status is ServiceStatus.WORSE
    assert risky.measure == "mean of the worst 10 %"
    worst = np.sort(after.returns(objective))[:6].mean() - np.sort(before.returns(objective))[:6].mean()
    if seed:
        assert risky.change.mean == pytest.approx(worst)


@pytest.mark.parametrize("constant", [0.0, 1e6])
def test_changes_are_parts_of_what_control_makes_whatever_the_design_costs(constant):
    objective = QuadraticObjective([[1.0]], [[1.0]], design_cost=lambda p: constant)
    found = judge_deployment(log(costs(1.0)), log(costs(1.2)), objective, PROMISE, redesigned=True)
    assert found.size == pytest.approx(costs(1.2).mean() * STEPS)
    assert found.status is ServiceStatus.BETTER


# ── what was taken back ──


def delivery(status, **others):
    """The values of a delivery that is compared with generation 1."""
    return {"former": 1, "status": status.value, "replaces": status.replaces, "judge": "within chance", "size": 50.0,
            "change": {"mean": -1.0, "ci95": [-1.5, -0.5]}, "promised": {"mean": -40.0}, "measure": "mean",
            "carried": False, "breach": ""} | others  # fmt: skip


def said(values, updates=()):
    """The account of a generation 2 without a redesign."""
    decision = {"promise": "+0.1 %", "reason": "no gain beyond chance", "moved": True}
    redesign = {"accepted": False, "chosen": None, "decisions": {"redesign": decision}}
    deployed = {"delivery": values, "updates": [{"accepted": taken} for taken in updates],
                "deployed_return": {"mean": -51.0}}  # fmt: skip
    return account(2, deployed, redesign, "m = 1 kg")


def test_updates_of_the_former_generation_that_are_taken_back_are_what_changed():
    text = said(delivery(ServiceStatus.WORSE, carried=True))
    assert text.startswith(
        "generation 2 was worse than generation 1 (−2 % [−3, −1]), so that the updates accepted in generation 1, "
        "judged again by a whole deployment, were taken back: the best redesign found promised"
    )
    assert "nothing had changed" not in text
    assert "the policy in service is that of generation 1 before its updates" in text
    both = said(delivery(ServiceStatus.WORSE, carried=True), (True, False))
    assert "the updates accepted in generation 1 and its own, judged again" in both


def test_where_nothing_had_changed_that_is_said():
    assert "(−2 % [−3, −1]), though nothing had changed" in said(delivery(ServiceStatus.WORSE))
    lost = said(delivery(ServiceStatus.DIVERGED, carried=True))
    assert lost.startswith("generation 2 lost more runs than generation 1 (")


def test_a_change_names_the_risk_that_it_is_of():
    text = said(delivery(ServiceStatus.WORSE, carried=True, measure="mean of the worst 10 %"))
    assert "(−2 % [−3, −1] in the mean of the worst 10 %)" in text


def test_limits_that_were_broken_are_named():
    text = said(delivery(ServiceStatus.LIMITS, breach="it leaves the limits further (v > 1)"), (True,))
    assert "was further outside the limits than granted (it leaves the limits further (v > 1)) and its updates" in text


def test_the_headline_says_whose_updates_were_taken_back():
    generation = {"generation": 2, "redesign": {"accepted": False}, "online_updates": [],
                  "delivery": delivery(ServiceStatus.WORSE, carried=True)}  # fmt: skip
    assert _brought(generation)
    assert _phrase({}, generation, moved=False) == (
        "generation 2 took the updates of generation 1 back, which a whole deployment showed to be worse"
    )
    generation["delivery"] = delivery(ServiceStatus.WORSE)
    assert not _brought(generation)
    assert _phrase({}, generation, moved=False) == "generation 2 was taken back, because it was worse"
