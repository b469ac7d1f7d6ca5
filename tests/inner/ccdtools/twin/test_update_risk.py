"""Updates are judged in the risk that was asked for, by the limits, and by what control makes of the return."""

from dataclasses import replace

import numpy as np
import pytest
from deployments import DESIGN, ONLINE, deployed, disturbances, start, training_gives, weakened

from ccdtools import CVaR, FixedStart, LearnedPolicy, OutputLimits, QuadraticObjective, deploy
from ccdtools.evidence.evidence import Violation
from ccdtools.evidence.verdict import Status
from ccdtools.twin.deployable import Deployable
from ccdtools.twin.distributions import logged
from ccdtools.twin.judge import Judge
from ccdtools.twin.limits_kept import violation
from ccdtools.twin.residuals import residuals
from ccdtools.twin.transport import ErrorSplit


@pytest.fixture(scope="module")
def logs(illustrative, clone):
    """Return the errors of 40 runs."""
    policy = LearnedPolicy(clone(illustrative), DESIGN)
    log = deploy(illustrative.real.plant, policy, DESIGN, disturbances(illustrative, 40, 30), x0=start(40))
    return [residuals(illustrative.model, log)]


def compared(problem, candidate, current, logs, *, series=False):
    """The runs and the evidence of two policies on logged errors."""
    split = ErrorSplit(problem.model, problem.state_scale)
    on = logged(split, logs, series=series, most=100, rng=np.random.default_rng(0), held_out=0.3 if series else None)
    judge = Judge(problem, None, lambda _: None, 20)
    return on, judge._compared(Deployable(candidate, DESIGN), Deployable(current, DESIGN), on)


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
    found = compared(problem, good, weak, logs)[1][0].gain
    after, before = (np.sort(replayed(illustrative, agent, logs[0]))[:4].mean() for agent in (good, weak))
    assert found.mean == pytest.approx(after - before, rel=1e-5)
    mean = compared(illustrative.problem(), good, weak, logs)[1][0].gain
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
        sizes.append(compared(problem, good, weak, parts, series=runs == 1)[1][0].size)
    assert sizes[1] == pytest.approx(sizes[0], rel=1e-6)


def test_a_candidate_that_breaks_the_limits_is_not_deployed_and_says_why(illustrative, clone, monkeypatch):
    broken = Violation((0.1, 0.2), (0.0, 0.0), (0.01, 0.05), "v > 1", False)
    training_gives(monkeypatch, clone(illustrative))
    agent = weakened(clone(illustrative))
    config = replace(ONLINE, updates=1, judged=100, accept_loss=1.0)
    found = deployed(illustrative, agent, runs=60, steps=40, config=config)
    assert found.updates[0].accepted
    assert found.updates[0].agent is found.agent
    monkeypatch.setattr("ccdtools.twin.judge.violation", lambda *_: broken)
    done = deployed(illustrative, agent, runs=60, steps=40, config=config)
    assert not done.changes
    assert done.agent is agent
    verdict = done.updates[0].verdict
    assert verdict.status is Status.LIMITS
    assert verdict.reason == (
        "it leaves the limits further than the tolerance (v > 1: 10.00% of the samples, 0.2 half-widths at the peak; "
        "tolerance 1.00% of the samples, 0.05 half-widths at the peak; before 0.00% of the samples, 0 half-widths "
        "at the peak) on the replayed log"
    )


def test_limits_are_those_of_the_replayed_runs(illustrative, clone, logs):
    """Between what a weak and a good policy do on the same errors, either way round."""
    good, weak = clone(illustrative), weakened(clone(illustrative), 0.2)
    problem = replace(
        illustrative.problem(), limit_tolerance=(0.0, 0.0), scenarios=FixedStart([0.0, 0.0], illustrative.disturbance),
        output_limits=OutputLimits(lambda x, u, p: x, [-1.0, -1.0], [1.0, 1.0]),
    )  # fmt: skip

    def left(problem, candidate, current):
        """What the candidate breaks."""
        on, (_, after, before) = compared(problem, candidate, current, logs)
        return violation(problem, on.scenario, after, before, illustrative.plant)

    assert left(problem, good, weak) is None
    found = left(problem, weak, good)
    assert found.achieved[0] > found.before[0]
    assert not found.by_mpc
    assert found.exceeded.startswith("y")
    assert left(replace(problem, limit_tolerance="off"), weak, good) is None
