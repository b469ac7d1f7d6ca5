"""A redesign is judged in the risk that the study asks for, by its limits, and by what control makes of the return."""

from dataclasses import replace

import numpy as np
import pytest

from ccdtools import CVaR, MeanSpread, OutputLimits, QuadraticObjective
from ccdtools.evidence.verdict import Status
from ccdtools.scenario import Scenario
from ccdtools.studies import configuration
from ccdtools.studies.evaluation import Evaluation
from ccdtools.studies.redesign import RedesignJudge
from ccdtools.trajectory import Trajectory
from ccdtools.twin.deployable import Deployable
from ccdtools.twin.judge import Judge
from ccdtools.twin.limits_kept import violation
from ccdtools.twin.residuals import Residuals
from ccdtools.twin.twin import DigitalTwin

RUNS, STEPS = 120, 40


def evaluation_of(study, **changes):
    """The study with other fields, and a mean cost that is the square of the first state."""
    objective = changes.pop("objective", QuadraticObjective(np.diag([1.0, 0.0]), np.zeros((1, 1)) + 1e-9))
    study = replace(study, objective=objective, steps=STEPS, **changes)
    return Evaluation(study, replace(configuration(study), model_runs=RUNS), 0)


def logs():
    """A log without errors."""
    zeros = np.zeros((RUNS, STEPS, 2))
    return [Residuals(e=zeros, x=zeros, u=zeros[..., :1], p=np.array([2.0]), e_next=zeros)]


def run_of(cost, *, design, outside=0.0):
    """Runs that cost so much a step (n,), and whose second state is at `outside` in every tenth step."""
    states = np.zeros((len(cost), STEPS + 1, 2))
    states[..., 0] = np.sqrt(cost)[:, None]
    states[:, 1::10, 1] = outside
    zeros = np.zeros((len(cost), STEPS, 1))
    return Trajectory(states, zeros, np.zeros((len(cost), STEPS, 2)), np.full(len(cost), -1), design, 0.1)


def half_width(X):
    """Of the second state, (limit above, half of the range)."""
    lower, upper = X.bounding_box()
    return upper[1], (upper[1] - lower[1]) / 2


def judged(monkeypatch, evaluation, candidate, current):
    """The decision between two deployables whose runs are given, by design: as plain values, and its status."""
    runs = {2.2: candidate, 2.0: current}
    monkeypatch.setattr(Judge, "run", lambda self, one, on: runs[float(one.design[0])])
    monkeypatch.setattr(RedesignJudge, "_others", [])
    after, before = (Deployable(None, np.array([p])) for p in (2.2, 2.0))
    twin = DigitalTwin(evaluation.study.model, logs=tuple(logs()), scale=evaluation.problem.state_scale)
    judge = RedesignJudge(evaluation, before, twin)
    verdict = judge.verdict(after)
    return judge.as_dict(after, verdict), verdict


def skewed(rng):
    """Costs of a step: of what is deployed, and of one that is less in the mean and more in a tenth of the runs."""
    before = 0.1 + 0.01 * rng.random(RUNS)
    after = 0.8 * before
    after[::8] = 1.5 * before[::8]
    return run_of(after, design=[2.2]), run_of(before, design=[2.0])


@pytest.mark.parametrize(
    ("risk", "status", "words"),
    [(None, Status.BETTER, ""), (CVaR(0.1), Status.WORSE, " in the mean of the worst 10 %"),
     (MeanSpread(3.0), Status.WORSE, " in the mean minus 3 times the spread")],
)  # fmt: skip
def test_what_is_better_in_the_mean_and_worse_in_the_risk_asked_for_is_not_taken(
    monkeypatch, illustrative, risk, status, words
):
    study = illustrative if risk is None else replace(illustrative, risk=risk)
    decision, verdict = judged(monkeypatch, evaluation_of(study), *skewed(np.random.default_rng(0)))
    assert verdict.status is status
    assert decision["predicted"].endswith("]" + words)
    assert decision["measure"] in ("mean", words.removeprefix(" in the "))
    assert (decision["gain"]["ci95"][1] < 0) == (risk is not None)


def test_what_is_worse_in_the_mean_and_better_in_the_risk_asked_for_is_taken(monkeypatch, illustrative):
    before, after = skewed(np.random.default_rng(0))
    swapped = [replace(one, design=[p]) for one, p in ((after, 2.2), (before, 2.0))]
    assert not judged(monkeypatch, evaluation_of(illustrative), *swapped)[1].replaces
    risky = evaluation_of(replace(illustrative, risk=CVaR(0.1)))
    assert judged(monkeypatch, risky, *swapped)[1].replaces


@pytest.mark.parametrize("tolerance", [(0.0, 0.0), (0.05, 10.0), (1.0, 0.01), (1.0, 10.0), "off", "mpc"])
def test_a_redesign_that_leaves_the_limits_further_than_the_tolerance_is_not_taken_and_says_which(
    monkeypatch, illustrative, tolerance
):
    """It is outside in a tenth of the samples, by a fifth of the limit."""
    evaluation = evaluation_of(illustrative, limit_tolerance=tolerance)
    limit, half = half_width(evaluation.study.X)
    cost = 0.1 + 0.01 * np.random.default_rng(0).random(RUNS)
    pair = (run_of(0.8 * cost, design=[2.2], outside=1.2 * limit), run_of(cost, design=[2.0], outside=0.9 * limit))
    decision, verdict = judged(monkeypatch, evaluation, *pair)
    if tolerance in ((1.0, 10.0), "off"):
        assert verdict.replaces
        return
    assert verdict.status is Status.LIMITS
    assert verdict.status.advice
    depth = f"{0.2 * limit / half:.3g}"
    assert f"(x2 > {limit:g}: 10.00% of the samples, {depth} half-widths at the peak" in decision["reason"]
    assert "it leaves the limits further than the tolerance" in decision["reason"]


def test_a_redesign_that_leaves_them_no_further_than_what_is_deployed_is_taken(monkeypatch, illustrative):
    evaluation = evaluation_of(illustrative, limit_tolerance=(0.0, 0.0))
    limit, _ = half_width(evaluation.study.X)
    cost = 0.1 + 0.01 * np.random.default_rng(0).random(RUNS)
    pair = (run_of(0.8 * cost, design=[2.2], outside=1.2 * limit), run_of(cost, design=[2.0], outside=1.3 * limit))
    assert judged(monkeypatch, evaluation, *pair)[1].replaces


def test_of_one_long_run_the_peaks_of_its_stretches_are_compared(illustrative):
    """Half of the stretches of 10 samples have one outside."""
    problem = replace(illustrative.problem(), limit_tolerance=(1.0, 0.1))
    limit, half = half_width(problem.X)
    states = np.zeros((1, 401, 2))
    plain = Trajectory(states, np.zeros((1, 400, 1)), np.zeros((1, 400, 2)), np.array([-1]), [2.0], 0.1)
    left = states.copy()
    left[0, 5::20, 1] = 1.2 * limit
    left = replace(plain, states=left)
    assert violation(problem, None, left, plain, None) is None
    found = violation(replace(problem, limit_tolerance=(1.0, 0.05)), None, left, plain, None)
    assert found.achieved[1] == pytest.approx(0.1 * limit / half, rel=0.1)


def test_what_is_deployed_and_leaves_X_does_not_hide_that_a_redesign_leaves_limits_of_outputs(illustrative):
    limits = OutputLimits(lambda x, u, p: u, -1.0, 1.0)
    problem = replace(illustrative.problem(), limit_tolerance=(0.0, 0.0), output_limits=limits)
    before = run_of(np.full(RUNS, 0.1), design=[2.0], outside=2.0 * half_width(problem.X)[0])
    inputs = before.inputs.copy()
    inputs[:, 1::10] = 1.2  # less beyond these limits, in half-widths, than before beyond X, and in the same samples
    after = replace(before, inputs=inputs, design=np.array([2.2]))
    found = violation(problem, None, after, before, None)
    assert found.exceeded == "y1 > 1"
    assert found.achieved == pytest.approx((0.1, 0.2))
    assert found.before == (0.0, 0.0)
    assert violation(problem, None, before, before, None) is None


def test_a_run_that_the_redesign_alone_saves_is_none_to_compare(illustrative):
    problem = replace(illustrative.problem(), limit_tolerance=(0.0, 0.0))
    limit, _ = half_width(problem.X)
    before = replace(run_of(np.full(RUNS, 0.1), design=[2.0]), diverged_at=np.where(np.arange(RUNS) == 0, 3, -1))
    states = before.states.copy()
    states[0, 1::2, 1] = 3 * limit
    after = replace(before, states=states, diverged_at=np.full(RUNS, -1))
    assert violation(problem, None, after, before, None) is None
    states = states.copy()
    states[1:, 5::10, 1] = 1.2 * limit
    assert violation(problem, None, replace(after, states=states), before, None).achieved[0] == pytest.approx(0.1)


@pytest.mark.parametrize("constant", [0.0, 1e5])
def test_a_price_in_per_cent_is_of_what_control_makes_whatever_the_design_costs(monkeypatch, illustrative, constant):
    objective = QuadraticObjective(np.diag([1.0, 0.0]), np.zeros((1, 1)) + 1e-9, design_cost=lambda p: constant)
    evaluation = evaluation_of(illustrative, objective=objective, redesign_price="10 %")
    cost = 0.1 + 0.01 * np.random.default_rng(0).random(RUNS)
    decisions = [judged(monkeypatch, evaluation, run_of(part * cost, design=[2.2]), run_of(cost, design=[2.0]))
                 for part in (0.85, 0.95)]  # fmt: skip
    assert [verdict.status for _, verdict in decisions] == [Status.BETTER, Status.BELOW_PRICE]
    assert decisions[0][0]["needed"] == pytest.approx(0.1 * cost.mean() * STEPS, rel=1e-4)
    assert decisions[0][0]["predicted"].startswith("+15 %")


@pytest.mark.long
def test_what_mpc_may_do_is_told_by_runs_that_nothing_lost(illustrative):
    """Kicked runs, in which MPC leaves X far, and which both laws lose."""
    problem = evaluation_of(illustrative).problem
    lost = np.where(np.arange(RUNS) % 4 == 0, 5, -1)
    limit, _ = half_width(problem.X)
    after, before = (
        replace(run_of(np.full(RUNS, 0.01), design=[2.2], outside=outside), diverged_at=lost)
        for outside in (1.3 * limit, 0.0)
    )
    tolerances = []
    for kick in (0.0, 3.0):
        w = np.zeros((RUNS, STEPS, problem.model.nw))
        w[lost >= 0, 3:6] = kick
        scenario = Scenario(problem.model, np.zeros((RUNS, problem.model.nx)), w)
        tolerances.append(violation(problem, scenario, after, before, None).tolerance)
    assert tolerances[0] == tolerances[1]


def test_what_mpc_may_do_is_the_same_whichever_way_the_limits_are_stated(illustrative):
    """Disturbed beyond what its input can hold, MPC leaves X as far with U(p) and X(p) as with the same numbers."""
    problem = evaluation_of(illustrative).problem
    (low, high), (least, largest) = problem.U.bounding_box(), problem.X.bounding_box()
    of_design = replace(
        problem, U=lambda p: (low + 0 * p[0], high * p[0] / 2.2), X=lambda p: (least + 0 * p[0], largest * p[0] / 2.2)
    )
    w = np.random.default_rng(0).normal(size=(RUNS, STEPS, problem.model.nw))
    scenario = Scenario(problem.model, np.zeros((RUNS, problem.model.nx)), w)
    limit, _ = half_width(problem.X)
    pair = (run_of(np.full(RUNS, 0.1), design=[2.2], outside=5 * limit), run_of(np.full(RUNS, 0.1), design=[2.2]))
    fixed, stated = (violation(one, scenario, *pair, None).tolerance for one in (problem, of_design))
    assert fixed[1] > 0.1
    assert stated == pytest.approx(fixed)
