"""Updates are judged in the risk that was asked for, by the limits, and by what control makes of the return."""

from dataclasses import replace

import numpy as np
import pytest
from deployments import DESIGN, ONLINE, deployed, disturbances, start, training_gives, weakened

from ccdtools import CVaR, FixedStart, LearnedPolicy, OutputLimits, QuadraticObjective, deploy
from ccdtools.co_design.limit_tolerance import Pair
from ccdtools.statistics import PairedDifference
from ccdtools.twin.limits_kept import Breach
from ccdtools.twin.recombined_returns import NOT_ASKED
from ccdtools.twin.residuals import residuals
from ccdtools.twin.update_judge import UpdateJudge


@pytest.fixture(scope="module")
def logs(illustrative, clone):
    """Return the errors of 40 runs."""
    policy = LearnedPolicy(clone(illustrative), DESIGN)
    log = deploy(illustrative.real.plant, policy, DESIGN, disturbances(illustrative, 40, 30), x0=start(40))
    return [residuals(illustrative.model, log)]


def judge(problem, runs=40):
    """Return what compares policies on so many runs."""
    rng = np.random.default_rng(0)
    return UpdateJudge(problem, DESIGN, replace(ONLINE, judged=100), runs, rng.spawn(1)[0], rng, None)


def replayed(illustrative, agent, errors):
    """The runs of a policy on the nominal model with logged errors, by simulation."""
    A, B, _ = illustrative.model.matrices(DESIGN)
    policy = LearnedPolicy(agent, DESIGN)
    x, cost = errors.x[:, 0], 0.0
    Q, R = illustrative.objective.Q, illustrative.objective.R
    for k in range(errors.steps):
        u = np.asarray(policy(x)).reshape(len(x), -1)
        x = x @ A.T + u @ B.T + errors.e_next[:, k]
        cost = cost + np.einsum("ni,ij,nj->n", x, Q, x) + np.einsum("ni,ij,nj->n", u, R, u)
    return -cost


def test_the_gain_is_of_the_risk_of_the_problem(illustrative, clone, logs):
    good, weak = clone(illustrative), weakened(clone(illustrative))
    problem = replace(illustrative.problem(), risk=CVaR(0.1))
    found, _ = judge(problem).gain(good, weak, logs, logs, NOT_ASKED)
    after, before = (np.sort(replayed(illustrative, agent, logs[0]))[:4].mean() for agent in (good, weak))
    assert found.mean == pytest.approx(after - before, rel=1e-5)
    mean, _ = judge(illustrative.problem()).gain(good, weak, logs, logs, NOT_ASKED)
    assert mean.mean != pytest.approx(found.mean, rel=0.02)


@pytest.mark.parametrize("runs", [40, 1])
def test_the_size_is_of_what_control_makes_whatever_the_design_costs(illustrative, clone, logs, runs):
    good, weak = clone(illustrative), weakened(clone(illustrative))
    parts = logs if runs > 1 else [logs[0].part(slice(k, k + 1), slice(None)) for k in range(8)]
    sizes = []
    for constant in (0.0, 1e5):
        own = illustrative.objective
        objective = QuadraticObjective(own.Q, own.R, design_cost=lambda p, constant=constant: constant)
        problem = replace(illustrative.problem(), objective=objective)
        sizes.append(judge(problem, runs).gain(good, weak, parts, parts, NOT_ASKED)[1])
    assert sizes[1] == pytest.approx(sizes[0], rel=1e-6)


def test_a_candidate_that_breaks_the_limits_does_not_go_into_service_and_says_why(illustrative, clone, monkeypatch):
    broken = Breach(Pair(0.1, 0.2), Pair(0.0, 0.0), Pair(0.01, 0.05), "v > 1", False)
    training_gives(monkeypatch, clone(illustrative))
    monkeypatch.setattr(UpdateJudge, "gain", lambda *_: (PairedDifference(1.0, (0.9, 1.1)), 1.0))
    agent = weakened(clone(illustrative))
    assert deployed(illustrative, agent, runs=6, steps=40).updates[0].accepted
    monkeypatch.setattr("ccdtools.twin.update_judge.breach", lambda *_: broken)
    done = deployed(illustrative, agent, runs=6, steps=40)
    assert not done.changed
    assert done.agent is agent
    assert done.updates[0].breach == (
        "it leaves the limits further than granted (v > 1: 10.00% of the samples, 0.2 half-widths at the peak; "
        "granted 1.00% of the samples, 0.05 half-widths at the peak; in service 0.00% of the samples, 0 half-widths "
        "at the peak)"
    )


def test_limits_are_those_of_the_replayed_runs(illustrative, clone, logs):
    """Between what a weak and a good policy do on the same errors, either way round."""
    good, weak = clone(illustrative), weakened(clone(illustrative), 0.2)
    problem = replace(
        illustrative.problem(), limit_tolerance=(0.0, 0.0), scenarios=FixedStart([0.0, 0.0], illustrative.disturbance),
        output_limits=OutputLimits(lambda x, u, p: x, [-1.0, -1.0], [1.0, 1.0]),
    )  # fmt: skip
    own = judge(problem)
    assert own.breach(good, weak, logs, illustrative.plant) is None
    found = own.breach(weak, good, logs, illustrative.plant)
    assert found.achieved.fraction > found.before.fraction
    assert not found.by_mpc
    assert found.exceeded.startswith("y")
    free = judge(replace(problem, limit_tolerance="off"))
    assert free.breach(weak, good, logs, illustrative.plant) is None
