"""Whole small runs: what falls short on the plant is rolled back, and the run goes on."""

from dataclasses import replace

import casadi as ca
import numpy as np
import pytest
from small_runs import tiny

from ccdtools import DesignSpace, Gaussian, InputError, Plant, QuadraticObjective, RealPlant, Study, load_policy
from ccdtools.evidence.evidence import Asked, Evidence
from ccdtools.evidence.verdict import decide
from ccdtools.statistics import PairedDifference
from ccdtools.studies import Generations, RunFolder, configuration, stages
from ccdtools.studies.redesign import RedesignJudge
from ccdtools.studies.report.report import write_report
from invariant_sets import Polytope


def damped() -> Study:
    """A mass whose damping is the design; really it has less of it, and is unstable where the design is below 0.7."""
    x, u, w, p = ca.SX.sym("x", 2), ca.SX.sym("u"), ca.SX.sym("w"), ca.SX.sym("p")
    space = DesignSpace(["c"], [0.1], [3.0])
    plant, real = (
        Plant(x, u, w, p, ca.vertcat(x[1], -x[0] - damping * x[1] + u + w), space, dt=0.3)
        for damping in (p, 4 * (p - 0.7))
    )
    noise = Gaussian([0.1])
    return Study(
        name="damped", title="Damped", plant=plant, X=Polytope.from_bounds([-1, -2], [1, 2]),
        U=Polytope.from_bounds([-0.2], [0.2]), objective=QuadraticObjective(np.eye(2), [[0.1]]), disturbance=noise,
        x0=[0.5, 0], p0=[1.5], real=RealPlant(real, noise, x0=[0.5, 0], runs=20, steps=40), steps=40, samples=20,
    )  # fmt: skip


def test_a_disturbance_that_enters_nowhere_and_a_price_without_a_unit_are_refused_before_anything_runs():
    study = damped()
    model = study.plant
    still = Plant(model.x, model.u, model.w, model.p, ca.substitute(model.dynamics, model.w, 0), model.design, dt=0.3)
    with pytest.raises(InputError, match=r"plant: got an E\(p\) of rank zero: the disturbance w enters nowhere"):
        replace(study, plant=still, real=None)
    with pytest.raises(InputError, match=r"redesign_price: got '0\.5'"):
        replace(study, redesign_price="0.5")


def run_with(monkeypatch, path, design, generations=2):
    """A run whose every redesign is one to that design, wrongly taken; the folder and the results."""
    study = damped()
    gain = PairedDifference(1.0, (0.5, 1.5))
    taken = decide([Evidence("B", "A", "the log", Asked.GAIN, gain, (-9.0, -10.0), 10.0, 20, "20 runs", needed=0.1)])
    monkeypatch.setattr(RedesignJudge, "verdict", lambda *_: taken)
    proposal = lambda self, redesign, current, history: {"redesign": replace(current, design=np.array([design]))}  # noqa: E731
    monkeypatch.setattr(stages.LoopStages, "_proposals", proposal)
    config = tiny(configuration(study, quick=True))
    config = replace(config, online=replace(config.online, updates=0))
    folder = RunFolder.create(path)
    lines = []
    results = Generations(
        study, config, folder, generations=generations, seed=1, echo=lines.append, progress=False
    ).run()
    return study, folder, results, lines


@pytest.mark.check
@pytest.mark.parametrize(("design", "status"), [(0.6, "worse"), (0.1, "more of its runs are lost")])
def test_a_redesign_that_fails_on_the_plant_is_rolled_back(monkeypatch, tmp_path, design, status):
    study, folder, results, lines = run_with(monkeypatch, tmp_path / "run", design)
    first, second = results["generations"]
    # Every second run met the same disturbances in both deployments, the others fresh ones.
    logs = [folder.read_stage(f"deployment-{g}").arrays["disturbances"] for g in (1, 2)]
    np.testing.assert_array_equal(logs[0][::2], logs[1][::2])
    assert (logs[0][1::2] != logs[1][1::2]).all()
    assert second["deployed_design"] == {"c": design}
    assert second["delivery"]["status"] == status
    assert second["design"] == first["design"] == first["deployed_design"]
    policy = load_policy(folder.path / "policy.safetensors")
    np.testing.assert_allclose(policy.design, first["design"]["c"])
    kept = folder.read_stage("deployment-1").networks["agent"]
    for name, weights in policy.agent.state_dict().items():
        np.testing.assert_array_equal(weights, kept.state_dict()[name])
    np.testing.assert_allclose(folder.read_stage("deployment-2").arrays["design"], [design])
    assert results["headline"].startswith("QUICK run, not a result. Real plant: cost ")
    assert "Generation 2 moved the design to c = " in results["headline"]
    assert "stay deployed" in results["headline"]
    assert any("stay deployed" in line for line in lines)
    assert any("redesign over the whole box: " in line or "redesign limited to ±25 %" in line for line in lines)
    rows = [row for row in results["comparison"] if row["generation"] == 2]
    assert all(row["design"] == first["design"] for row in rows)
    assert write_report(study, folder).is_file()


@pytest.mark.check
def test_the_next_generation_begins_from_what_is_deployed_and_trusts_less(monkeypatch, tmp_path):
    _, _, results, _ = run_with(monkeypatch, tmp_path / "run", 0.6, generations=3)
    second, third = results["generations"][1:]
    assert third["delivery"]["former"] == 1
    assert third["redesign"]["from"] == results["generations"][0]["design"]
    moved = {"within chance": 0.5, "more than predicted": 0.25}.get(second["delivery"]["agreement"], 0.125)
    assert second["trust"]["radius"] == moved
