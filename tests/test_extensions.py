"""A new plant, method, controller and disturbance is one short file, and nothing else is touched."""

from pathlib import Path

import numpy as np
import pytest
from extensions.hanging_mass import hanging_mass
from extensions.random_designs import RandomDesigns
from extensions.two_levels import SquareWave, TwoLevels

import ccdtools as cc

MOST_LINES = 120


@pytest.fixture(scope="module")
def problem():
    return cc.CoDesignProblem(
        cc.discretise(hanging_mass()), X=([-2, -2], [2, 2]), U=(-1, 1), steps=30,
        objective=cc.QuadraticObjective(np.eye(2), [[0.1]]),
        scenarios=cc.FixedStart([1.0, 0.0], SquareWave(0.1, 8)),
    )  # fmt: skip


def test_every_extension_is_one_short_file():
    for file in Path(__file__).with_name("extensions").glob("*.py"):
        assert len(file.read_text(encoding="utf-8").splitlines()) <= MOST_LINES


@pytest.mark.long
def test_a_method_of_ones_own_is_judged_and_compared_like_the_others(problem):
    mine = cc.codesign(problem, method=RandomDesigns(), rng=np.random.default_rng(0))
    theirs = cc.codesign(problem, method="nested", rng=np.random.default_rng(0))
    assert mine.method == "random designs"
    assert mine.status.name == "BUDGET_SPENT"
    assert mine.closed_loop.summary.mean <= theirs.closed_loop.summary.mean + 1e-9
    table = cc.compare_methods(problem, {"mine": RandomDesigns(4), "LQR": cc.Nested(starts=1)}, seed=0)
    assert "mine" in str(table)


def test_a_controller_and_a_disturbance_of_ones_own_close_the_loop(problem):
    p = problem.design.centre
    laws = {"two levels": TwoLevels((1.0, 1.0), 0.5), "LQR": cc.saturated_lqr(problem, p)}
    x0, w = problem.scenarios.sample(20, problem.steps, np.random.default_rng(0))
    assert sorted({*np.abs(w).ravel().tolist()}) == [pytest.approx(0.1)]
    table = cc.compare(laws, cc.Scenario(hanging_mass(), x0, w), design=p, objective=problem.objective, X=problem.X)
    assert table["LQR"].summary.mean > table["two levels"].summary.mean
