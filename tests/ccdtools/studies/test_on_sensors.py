"""Studies whose loops see sensors alone: a mass on a spring whose real actuator is half as strong."""

import json
import re
import shutil
from dataclasses import replace

import numpy as np
import pytest
from typer.testing import CliRunner

from ccdtools import CVaR, Gaussian, InputError, RealPlant, Scenario
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


def cost_by(values, *place):
    """Printed cost of a sample, by drive, design and controller."""
    line = next(line for line in values.splitlines() if re.split(r" {2,}", line)[:3] == list(place))
    return float(re.split(r" {2,}", line)[3])


def fresh(study, use, runs, seed=0):
    """The drives that a run compares on: stated here a second time."""
    rng = np.random.default_rng([seed, 1, *use.encode()])
    w = study.real.fresh[use].sample(runs, 50, rng)
    return Scenario(study.real.plant, study.x0, w, output=study.sensed.measurement, seed=int(rng.integers(2**31)))


@pytest.mark.check
def test_what_a_weak_actuator_costs_is_told_by_its_log_and_won_back(spring):
    out = spring.with_name("out")
    said, told, changes, values = run("run", spring, "--output", out)
    assert re.search(r"as said: what is in service at the end costs −", said)
    gain, deviation = (float(word) for word in re.search(r"gain +([\d.]+) +([\d.]+)", told).groups())
    assert abs(gain - 0.5) < 4 * deviation < 0.2
    study = load_study(spring)
    first, second = (RunFolder(out).read_stage(f"generation-{i}") for i in (1, 2))
    assert second.values["by"] in ("redesign", "update")
    assert first.arrays["outputs"].shape == (40, 50, 1)
    assert [len(stage.arrays["known"]) for stage in (first, second)] == [0, 1]
    policy = load_policy(out / "policy.safetensors")  # with the filter that it was deployed behind
    run_again = fresh(study, "as said", 120).run(policy, design=policy.controller.design)
    cost = -run_again.returns(study.objective).mean() / 50
    assert cost_by(values, "as said", "generation 2", "learned") == pytest.approx(cost, rel=1e-3)
    lqg = cost_by(values, "as said", "start", "LQG")
    assert cost < 0.97 * lqg
    change = re.findall(r"as said +all up to generation 2: [a-z ]+?  +−([\d.]+) %", changes)[-1]
    assert float(change) == pytest.approx(100 * (1 - cost / lqg), abs=0.6)
    assert cost_by(values, "as said", "generation 2", "LQG, of the fit") < lqg
    page = (out / "report.html").read_text()
    assert page.count("data:image/png") == 1
    assert (out / "gains.csv").read_text().startswith("use,")


@pytest.mark.check
def test_a_redesign_is_told_from_the_filter_that_came_with_it(spring):
    """The redesign is in service, and the filter alone, which came with it, has a step of its own."""
    spring.write_text(SPRING.replace("plant(0.5), rough", "plant(0.3), rough"))
    out = spring.with_name("out")
    *_, changes, _ = run("run", spring, "--output", out)
    by = RunFolder(out).read_stage("generation-2").values["by"]
    steps = re.findall(r"as said +(generation 2: [a-z ]+?)  ", changes)
    expected = {
        "redesign": ["filter of the fit", r"redesign|policy that went on learning"],
        "update": ["filter of the fit"],
    }[by]
    assert len(steps) == len(expected)
    for step, words in zip(steps, expected):
        assert re.fullmatch(f"generation 2: ({words})", step)


@pytest.mark.check
def test_a_first_generation_that_loses_all_runs_is_told_in_a_report(spring):
    spring.write_text(SPRING.replace("- 0.3 * x[1] + gain", "- drag * x[1] + gain").replace(
        "def plant(gain=1.0, unknown=False):", "def plant(gain=1.0, unknown=False, drag=0.3):").replace(
        "plant(0.5), rough", "plant(0.5, drag=-4.0), rough"))  # fmt: skip
    said, *_, values = run("run", spring, "--quick", "--output", spring.with_name("out"))
    assert "as said: no run to compare" in said
    assert "lost 24 of 24 runs" in said
    assert "generation 2" not in values
    assert "Every run diverged" in said


@pytest.mark.check
def test_laws_and_designs_that_cannot_be_made_are_said(spring):
    spring.write_text(SPRING.replace("noise=[0.1],", "noise=[0.1], laws={'stiff only': stiff_only},").replace(
        "rough = Gau", """
from ccdtools.controllers import Passive
from mpc import NotStabilisableError

def stiff_only(problem, design):
    if design[0] < 1.5:
        raise NotStabilisableError("too soft")
    return Passive(1)

rough = Gau"""))  # fmt: skip
    out = spring.with_name("out")
    said = "\n".join(run("run", spring, "--quick", "--output", out))
    nested = float(RunFolder(out).read_stage("nested-lqr").arrays["design"][0])
    assert "At start there is no stiff only: " in said
    assert ("At nested LQR there is no stiff only: " in said) == (nested < 1.5)
    assert "no LQG" not in said


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
        ({"laws": {"LQG": lambda problem, design: None}}, "laws: got the name 'LQG'"),
        ({"filter": "admissible"}, "filter: got 'admissible'"),
        ({"risk": CVaR(0.1)}, "risk: got"),
        ({"accept_loss": "1 %"}, "accept_loss: got '1 %'"),
        ({"settings": {"drift": 0.05}}, r"settings\['drift'\]: got 0.05, expected None: a run whose generations go by"),
        ({"settings": {"real_runs": 1}}, r"settings\['real_runs'\]: got 1"),
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


def test_a_start_that_the_filter_would_take_for_another_is_refused(spring):
    study = load_study(spring)
    with pytest.raises(InputError, match=r"real\.x0"):
        replace(study, real=study.real.each(x0=[0.5, 0.0]))


def test_a_plant_that_wears_is_refused(spring):
    study = load_study(spring)
    with pytest.raises(InputError, match=r"real\.later"):
        replace(study, real=replace(study.real, later=[study.real]))


@pytest.mark.parametrize("option", [["--trial"], ["--drift", "0.05"], ["--preset", "paper"], ["--x0=0,0"]])
def test_options_that_such_a_run_does_not_use_are_refused(spring, option):
    done = CliRunner().invoke(app, ["run", str(spring), *option])
    assert isinstance(done.exception, InputError)
    assert "whose generations go by fits" in str(done.exception)
