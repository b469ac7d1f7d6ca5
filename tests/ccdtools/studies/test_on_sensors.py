"""Studies whose loops see sensors alone: a mass on a spring whose real actuator is half as strong."""

import json
import re
import shutil
from dataclasses import replace

import numpy as np
import pytest
from typer.testing import CliRunner

from ccdtools import Gaussian, InputError, RealPlant, Scenario
from ccdtools.cli import app
from ccdtools.controllers import load_policy
from ccdtools.studies import RunFolder, load_study

SPRING = """
import casadi as ca
import numpy as np
from ccdtools import CoDesignConfig, DesignSpace, Gaussian, Plant, QuadraticObjective, RealPlant
from ccdtools.studies import OnSensors

def plant(gain=1.0, unknown=False):
    x, u, w, k = ca.SX.sym("x", 2), ca.SX.sym("u"), ca.SX.sym("w"), ca.SX.sym("k")
    box = DesignSpace(["k"], [0.5], [4.0], ["N/m"])
    p = k
    if unknown:
        gain = ca.SX.sym("gain")
        p, box = ca.vertcat(k, gain), DesignSpace(["k", "gain"], [0.5, 0.1], [4.0, 3.0], ["N/m", "-"])
    return Plant(x, u, w, p, [x[1], -k * x[0] - 0.3 * x[1] + gain * u + w], box, dt=0.33, outputs=[x[0]])

rough = Gaussian([0.3])
study = OnSensors(
    name="spring", title="A mass on a spring", plant=plant(), X=(-4, 4), U=(-3, 3), steps=50, x0=[1.0, 0.0], p0=[1.0],
    objective=QuadraticObjective(np.eye(2), [[0.1]], design_cost=lambda p: 2 * p[0]), disturbance=rough,
    real=RealPlant(plant(0.5), rough, [1.0, 0.0], 40, 50, held_out={"as said": rough, "calm": Gaussian([0.1])}),
    limit_tolerance="off", unknown=plant(unknown=True), noise=[0.1], samples=100, sets="lqr",
    metrics=lambda run: {"mean square input": float(np.mean(run.inputs**2))},
    settings={"codesign": CoDesignConfig(iterations=20, starts=1), "redesign": CoDesignConfig(iterations=20, starts=1)},
)
"""


@pytest.fixture
def spring(tmp_path):
    (tmp_path / "spring.py").write_text(SPRING)
    return tmp_path / "spring.py"


def run(*arguments):
    done = CliRunner().invoke(app, [str(one) for one in arguments])
    assert done.exit_code == 0, done.output
    return done.output.split("\n\n")[1:-1]  # without the time


@pytest.mark.check
def test_what_a_weak_actuator_costs_is_told_by_its_log_and_won_back(spring):
    out = spring.with_name("out")
    said, told, changes, values = run("run", spring, "--output", out)
    assert re.search(r"as said: what is in service at the end costs −", said)
    gain, deviation = (float(word) for word in re.search(r"gain +([\d.]+) +([\d.]+)", told).groups())
    assert abs(gain - 0.5) < 4 * deviation < 0.2
    study = load_study(spring)
    folder = RunFolder(out)
    first, second = (folder.read_stage(f"generation-{i}") for i in (1, 2))
    assert second.values["by"] in ("redesign", "update")
    policy = load_policy(out / "policy.safetensors")  # with the filter that it was deployed behind
    w = Gaussian([0.3]).sample(2000, 50, np.random.default_rng(77))
    scenario = Scenario(study.real.plant, [1.0, 0.0], w, output=study.sensed.measurement, seed=5)
    cost = -scenario.run(policy, design=policy.controller.design).returns(study.objective) / 50
    line = next(line for line in values.splitlines() if re.match(r"as said +generation 2 +learned", line))
    assert float(re.search(r"learned +([\d.]+)", line)[1]) == pytest.approx(cost.mean(), rel=0.15)
    lqg = next(line for line in values.splitlines() if re.match(r"as said +start +LQG", line))
    assert cost.mean() < 0.97 * float(re.search(r"LQG +([\d.]+)", lqg)[1])
    assert first.arrays["outputs"].shape == (40, 50, 1)
    assert [len(stage.arrays["known"]) for stage in (first, second)] == [0, 1]
    assert "all up to policy" in changes
    page = (out / "report.html").read_text()
    assert page.count("data:image/png") == 1
    assert (out / "gains.csv").read_text().startswith("use,")


@pytest.mark.check
def test_a_run_goes_on_where_it_stopped_and_in_two_processes_to_the_same_results(spring):
    out, other = spring.with_name("out"), spring.with_name("other")
    whole = run("run", spring, "--quick", "--output", out)
    assert run("run", spring, "--quick", "--output", other, "--jobs", "2") == whole
    for stage in ("generation-2", "nested-lqr"):
        shutil.rmtree(out / "stages" / stage)
    assert run("resume", out) == whole
    assert json.loads((out / "run.json").read_text())["options"]["generations"] == 2


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"noise": [0.1, 0.1]}, "noise: got shape"),
        ({"noise": [0.0]}, r"noise: got \[0.0\], expected standard deviations above 0"),
        ({"unknown": None}, "unknown: got nothing"),
        ({"real": "model"}, "real: got 'model'"),
    ],
)
def test_wrong_studies_are_named(spring, changes, words):
    with pytest.raises(InputError, match=words):
        replace(load_study(spring), **changes)


def test_a_real_plant_with_other_outputs_is_refused(spring):
    study = load_study(spring)
    bare = replace(study.real.plant, outputs=None, output_names=(), output_limits=(-np.inf, np.inf))
    with pytest.raises(InputError, match=r"real\.plant: got one with other outputs"):
        replace(study, real=RealPlant(bare, Gaussian([0.3]), [1.0, 0.0], 40, 50))


@pytest.mark.parametrize("option", [["--trial"], ["--drift", "0.05"], ["--preset", "paper"], ["--x0=0,0"]])
def test_options_that_such_a_run_does_not_use_are_refused(spring, option):
    done = CliRunner().invoke(app, ["run", str(spring), *option])
    assert isinstance(done.exception, InputError)
    assert "whose generations go by fits" in str(done.exception)
