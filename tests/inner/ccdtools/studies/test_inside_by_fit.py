"""What is deployed after a trial, of runs that are given."""

from dataclasses import dataclass
from types import SimpleNamespace

import casadi as ca
import numpy as np
import pytest

from ccdtools import (
    CoDesignProblem,
    DesignSpace,
    FixedStart,
    Gaussian,
    Plant,
    QuadraticObjective,
    RealPlant,
    discretise,
)
from ccdtools.comparison.metrics import MetricChange
from ccdtools.statistics import PairedDifference
from ccdtools.studies import fitted_run
from ccdtools.studies.by_fit import FittedLoop
from ccdtools.studies.fitted_trial import DriveTrial
from ccdtools.studies.report.fitted_page import _headline
from ccdtools.trajectory import Trajectory
from mpc import NotStabilisableError

RUNS, STEPS = 40, 50


@dataclass(frozen=True)
class Given(FittedLoop):
    """Deployments whose runs are those of the law itself."""

    def run(self, one, scenario):
        return one


def runs(level, lost):
    """Runs that stay at a level, of which some are lost."""
    n = len(lost)
    states = np.full((n, STEPS + 1, 1), level) * np.linspace(0.99, 1.01, n)[:, None, None]
    none = np.zeros((n, STEPS, 1))
    return Trajectory(states, none, none, np.where(lost, 3, -1), np.array([1.0]), 0.1)


@pytest.mark.parametrize(
    ("level", "after", "before", "deployed"),
    [
        (1.0, [], [], True),
        (3.0, [], [], False),
        (3.0, range(20), range(19, 39), False),  # one run in common, and as many lost
        (1.0, range(20), range(20, 40), False),  # none in common
        (1.0, range(40), range(40), False),
        (1.0, [], range(40), True),  # saves all
        (1.0, [0], [], False),
    ],
)
@pytest.mark.parametrize("doubtful", [False, True])
def test_a_redesign_serves_where_common_runs_or_what_it_saves_show_it_no_worse(
    level, after, before, deployed, doubtful
):
    x, u, w, p = (ca.SX.sym(name) for name in "xuwp")
    plant = Plant(x, u, w, p, [-p * x + u + w], DesignSpace(["k"], [0.5], [4.0]), dt=0.1)
    problem = CoDesignProblem(
        discretise(plant), X=(-9, 9), U=(-3, 3), steps=STEPS, objective=QuadraticObjective([[1.0]], [[0.1]]),
        scenarios=FixedStart([1.0], Gaussian([0.3])), limit_tolerance="off",
    )  # fmt: skip
    real = RealPlant(plant, Gaussian([0.3]), [1.0], RUNS, STEPS)
    redesign, former = (runs(at, np.isin(np.arange(RUNS), list(lost))) for at, lost in ((level, after), (2.0, before)))
    served, measured = Given(problem, real).trial(former, None, redesign, 0, doubtful)
    assert (served is redesign) == deployed
    assert measured["lost"] == (len(after), len(before))


def test_a_last_generation_that_is_lost_is_not_told_by_the_step_before():
    one = MetricChange("cost of a sample", 2.0, 1.0, PairedDifference(-1.0, (-1.1, -0.9)), "better")
    changes = {"design": (one,), "policy": (one,), "generation 2: filter of the fit": (), "all up to policy": (one,),
               "all up to generation 2: filter of the fit": ()}  # fmt: skip
    y = np.zeros(3)
    trial = DriveTrial(({}, changes), {"LQG at the start": y, "in service at the end": y}, ("It lost 6 of 6 runs.",))
    assert _headline("road", trial) == "road: no run to compare. It lost 6 of 6 runs."


def test_a_baseline_that_no_design_has_leaves_a_run_alone(monkeypatch):
    def none(problem, **options):
        raise NotStabilisableError("by no design")

    monkeypatch.setattr(fitted_run, "codesign", none)
    stage = fitted_run._nested(SimpleNamespace(problem=lambda: None, p0=None), 0)
    assert stage.values["report"] == ["by no design"]
    assert "design" not in stage.arrays
