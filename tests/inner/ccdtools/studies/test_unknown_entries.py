"""A study whose plant has entries that are unknown: from each deployment on its model is what the logs tell."""

import shutil
from dataclasses import replace

import casadi as ca
import numpy as np
import pytest
from small_runs import tiny

from ccdtools import DesignSpace, Gaussian, InputError, Plant, QuadraticObjective, RealPlant, Study
from ccdtools.studies import Generations, RunFolder, configuration
from ccdtools.studies.evaluation import Evaluation
from ccdtools.trajectory import Trajectory
from ccdtools.twin import fit_plant

BOX = DesignSpace(["k"], [0.5], [4.0])


def spring(gain=None):
    """Mass on a spring, with an actuator of a gain, or of one that is unknown."""
    names = ["k", "gain"] if gain is None else ["k"]
    x, u, w, p = ca.SX.sym("x", 2), ca.SX.sym("u"), ca.SX.sym("w"), ca.SX.sym("p", len(names))
    box = DesignSpace(names, [0.5, 0.2][: len(names)], [4.0, 2.0][: len(names)])
    force = (p[1] if gain is None else gain) * u
    return Plant(x, u, w, p, [x[1], -p[0] * x[0] - 0.3 * x[1] + force + w], box, dt=0.33)


def weak(**changes):
    """The real actuator gives half of what its data sheet says."""
    given = {
        "plant": spring(1.0), "X": (-4, 4), "U": (-3, 3), "disturbance": Gaussian([0.3]), "x0": [1.0, 0.0],
        "objective": QuadraticObjective(np.eye(2), [[0.1]], design_cost=lambda p: 2 * p[0]), "p0": [2.0], "steps": 50,
        "real": RealPlant(spring(0.5), Gaussian([0.3]), [1.0, 0.0], 20, 50), "unknown": spring(), "samples": 20,
    }  # fmt: skip
    return Study("weak", "A weak actuator", **(given | changes))


def means(results):
    """Means of all comparisons by place and controller."""
    return [(row["generation"], row["plant"], row["controller"], row["mean"]) for row in results["comparison"]]


@pytest.mark.check
def test_the_model_of_all_later_stages_is_what_the_logs_tell_also_when_a_run_is_resumed(tmp_path):
    study = weak()
    config = tiny(configuration(study, quick=True))

    def begun():
        return Generations(study, config, folder, seed=1, echo=lambda line: None, progress=False)

    folder = RunFolder.create(tmp_path / "run")
    first = begun()
    results = first.run()
    stage = folder.read_stage("identification-1")
    deployed = folder.read_stage("deployment-1")
    log = Trajectory(**deployed.arrays, dt=0.33)
    np.testing.assert_allclose(stage.arrays["values"], fit_plant(study.problem(), log, plant=spring()).values[:1])
    assert stage.values["status"] == "SOLVED"
    assert stage.arrays["values"][0] == pytest.approx(0.5, abs=0.1)
    assert results["generations"][0]["identified"].startswith("the logs tell gain 0.")
    model, told = first.evaluation.study.model, folder.read_stage("identification-2").arrays["values"]
    B = study.model.matrices([2.0])[1]
    np.testing.assert_allclose(model.matrices([2.0])[1], told[0] * B, rtol=1e-9)
    places = {row["place"]: row for row in results["in_service"]}
    assert list(places)[:2] == ["as deployed, real plant", "as deployed, model"]
    real = places["as deployed, real plant"]
    gained = real["means"][-1] - real["means"][0]
    assert sum(change["mean"] for change in real["changes"]) == pytest.approx(gained)
    assert gained == pytest.approx(
        results["gains"][0]["total"]["mean"] + results["gains"][0]["start"] - real["means"][0]
    )
    shutil.rmtree(next(folder.path.rglob("comparison-2")))
    again = begun()
    assert means(again.run()) == means(results)
    np.testing.assert_array_equal(again.evaluation.study.model.matrices([2.0])[1], model.matrices([2.0])[1])


def test_the_limits_of_the_outputs_and_the_names_are_those_of_the_study():
    own = spring(1.0)
    named = replace(own, outputs=[own.x[0]], output_limits=([-1.5], [1.5]), state_names=["place", "speed"])
    study = weak(plant=named)
    after = Evaluation(study, configuration(study, quick=True), 0).of_plant(np.array([0.5])).study
    for one in (study, after):
        assert one.plant.state_names == ("place", "speed")
        assert one.problem().output_limits is not None
        np.testing.assert_allclose(one.plant.output_limits[1], [1.5])
    B = [one.model.matrices([2.0])[1] for one in (study, after)]
    np.testing.assert_allclose(B[1], 0.5 * B[0], rtol=1e-9)


def test_a_plant_without_the_design_of_the_study_is_named():
    with pytest.raises(InputError, match="what is unknown besides"):
        weak(unknown=spring(1.0))
    with pytest.raises(InputError, match=r"unknown: got continuous, dt = 0\.1 s, expected continuous, dt = 0\.33 s"):
        weak(unknown=replace(spring(), dt=0.1))
    with pytest.raises(InputError, match="unknown entries in its design"):
        weak(unknown=0.5)
