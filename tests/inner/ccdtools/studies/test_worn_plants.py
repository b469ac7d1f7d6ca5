"""A real plant that wears between generations: the log says so, and the redesign follows it."""

from dataclasses import replace

import casadi as ca
import numpy as np
import pytest
from small_runs import tiny

from ccdtools import DesignSpace, Gaussian, InputError, Plant, QuadraticObjective, RealPlant, Study, saturated_lqr
from ccdtools.controllers import LearnedPolicy
from ccdtools.scenario import Scenario
from ccdtools.studies import Generations, RedesignCost, RunFolder, configuration
from invariant_sets import Polytope

NOISE = Gaussian([0.1])


def sprung(push=0.0, gain=1.0):
    """A mass on a spring that is pushed aside, and whose actuator is weaker."""
    x, u, w, p = ca.SX.sym("x", 2), ca.SX.sym("u"), ca.SX.sym("w"), ca.SX.sym("p")
    return Plant(x, u, w, p, ca.vertcat(x[1], -p * x[0] + gain * u + w + push), DesignSpace(["k"], [1], [4]), dt=0.1)


def worn(**changes):
    """Study whose second generation meets a plant that is pushed aside, the third one the same."""
    real = RealPlant(plant := sprung(), NOISE, x0=[0.5, 0], runs=40, steps=40, **changes)
    return Study(
        name="worn", title="Worn", plant=plant, X=Polytope.from_bounds([-2, -3], [2, 3]), disturbance=NOISE,
        U=Polytope.from_bounds([-3], [3]), objective=QuadraticObjective(np.eye(2), [[0.01]]), x0=[0.5, 0], p0=[2],
        steps=40, samples=200, real=replace(real, later=[replace(real, plant=sprung(push=1.0))]),
        settings={"drift": 0.05},
    )  # fmt: skip


def test_another_start_is_that_of_later_plants_too():
    study = worn().started(x0=[0.2, 0.1])
    assert [one.x0.tolist() for one in (study.real, *study.real.later)] == [[0.2, 0.1]] * 2
    with pytest.raises(InputError, match=r"real.later: got one with a `later`"):
        replace(study.real, later=[study.real])


@pytest.mark.check
def test_the_second_generation_meets_the_worn_plant_says_so_and_the_third_follows_it(tmp_path):
    study = worn()
    config = tiny(configuration(study, quick=True, sets="lqr"))
    learning = replace(config.codesign, iterations=20, evaluate_every=10, pathwise_runs=64, evaluation_runs=50)
    online = replace(config.online, updates=0, judged=300)
    config = replace(config, codesign=learning, redesign=learning, online=online)
    folder = RunFolder.create(tmp_path / "run")
    results = Generations(study, config, folder, generations=3, echo=lambda _: None, progress=False).run()
    first, second, third = results["generations"]
    assert "drift" not in first
    assert second["drift"]["status"] == "drift"
    assert "left out from here on" in second["notes"][-1]
    assert second["delivery"]["status"] == "not worse"  # the same policy: its plant is worse, and not the policy
    assert not any("left out" in note for note in third["notes"])  # a redesign may surprise the twin
    assert third["redesign"]["accepted"]
    assert third["delivery"]["replaces"]
    rng = np.random.default_rng(5)
    scenario = Scenario(sprung(push=1.0), np.tile([0.5, 0.0], (500, 1)), NOISE.sample(500, 40, rng))
    before, after = (
        scenario.run(LearnedPolicy(stage.networks["agent"], stage.arrays["design"]), design=stage.arrays["design"])
        for stage in map(folder.read_stage, ("codesign-1", "codesign-3"))
    )
    gain = after.returns(study.objective) - before.returns(study.objective)
    assert gain.mean() > 0.1 * np.abs(before.returns(study.objective).mean())
    assert results["in_service"][0]["means"][3] > results["in_service"][0]["means"][2]


@pytest.mark.check
@pytest.mark.parametrize("jobs", [1, 2])
def test_held_out_runs_of_the_start_are_on_the_worn_plant_as_gains_are(tmp_path, jobs):
    study = worn(held_out={"gusts": Gaussian([0.3])})
    config = tiny(configuration(study, quick=True, sets="lqr"))
    folder, quiet = RunFolder.create(tmp_path / "run"), {"echo": lambda _: None, "progress": False}
    results = Generations(study, config, folder, generations=2, jobs=jobs, **quiet).run()
    start = next(row for row in results["held_out"] if row["controller"] == "LQR")
    assert start["generation"] == 0
    assert start["mean"] == results["gains"][-1]["start"]
    assert results["gains"][-1]["place"] == "gusts"


@pytest.mark.check
def test_a_run_that_stops_is_told_on_the_plant_that_was_met_last(tmp_path):
    study = replace(worn(), redesign_cost=RedesignCost(cost=1e6, serves=10, unit="EUR", worth=1.0))
    config = tiny(configuration(study, quick=True, sets="lqr"))
    config = replace(config, redesign=replace(config.redesign, policy_rate=0.0))  # none is better by chance
    folder, quiet = RunFolder.create(tmp_path / "run"), {"echo": lambda _: None, "progress": False}
    run = Generations(study, config, folder, generations=2, **quiet)
    results = run.run()
    assert results["stopped"]["status"] == "stop"
    assert not results["real_plant_changes"]
    assert "as the last generation met it" not in results["headline"]
    w = NOISE.sample(500, 40, np.random.default_rng(5))
    by_lqr = Scenario(sprung(), np.tile([0.5, 0.0], (500, 1)), w).run(saturated_lqr(run.evaluation.problem, [2.0]),
                                                                     design=[2.0])  # fmt: skip
    assert results["gains"][0]["start"] == pytest.approx(by_lqr.returns(study.objective).mean(), rel=0.05)


def test_later_plants_are_of_the_same_kind_and_length():
    real = worn().real
    assert [real.met_by(generation) for generation in (1, 2, 3)] == [real, *2 * real.later]
    for later, got in (([real.plant], "Plant"), (real, "RealPlant"), ([replace(real, later=(), runs=50)], "50 runs")):
        with pytest.raises(InputError, match=f"real.later: .*{got}"):
            replace(real, later=later)
    x, u, w, p = ca.SX.sym("x", 3), ca.SX.sym("u"), ca.SX.sym("w"), ca.SX.sym("p")
    other = Plant(x, u, w, p, ca.vertcat(x[1], u + w, x[0]), DesignSpace(["k"], [1], [4]), dt=0.1)
    third = RealPlant(other, NOISE, x0=[0, 0, 0], runs=40, steps=40)
    with pytest.raises(InputError, match=r"real\.plant: got 3 states"):
        replace(worn(), real=replace(real, later=[third]))
