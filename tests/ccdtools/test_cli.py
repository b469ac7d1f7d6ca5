"""The command line as a stranger uses it, in processes of its own."""

import json
import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
import tiny_command

pytestmark = pytest.mark.check  # whole runs, in processes of their own

CCDTOOLS = [sys.executable, "-m", "ccdtools"]

TWO_MASSES = '''
"""Two masses and a spring between them: the spring is the design."""
import casadi as ca
import numpy as np

from ccdtools.plants.design_space import DesignSpace
from ccdtools.disturbances.disturbance import Gaussian
from ccdtools.co_design.objective import QuadraticObjective
from ccdtools.plants.plant import Plant
from ccdtools.studies import RealPlant, Study
from invariant_sets import Polytope


def plant(friction):
    x, u, w, k = ca.SX.sym("x", 4), ca.SX.sym("u"), ca.SX.sym("w"), ca.SX.sym("k")
    pull = k * (x[1] - x[0])
    dynamics = ca.vertcat(x[2], x[3], pull - 0.2 * x[2] + u, -pull - 0.2 * x[3] + w - friction * ca.tanh(x[3]))
    return Plant(x, u, w, k, dynamics, DesignSpace(["k"], [0.5], [4.0], ["N/m"]), dt=0.2)


box = np.array([4.0, 4.0, 4.0, 4.0])
study = Study(
    name="two masses", title="Two masses and a spring", plant=plant(0.0),
    X=Polytope.from_bounds(-box, box), U=Polytope.from_bounds([-1.0], [1.0]),
    objective=QuadraticObjective(np.diag([1.0, 1.0, 0.1, 0.1]), [[0.1]]), disturbance=Gaussian([0.1]),
    x0=[1.0, 1.0, 0.0, 0.0], p0=[1.0],
    real=RealPlant(plant(0.05), Gaussian([0.1]), x0=[1.0, 1.0, 0.0, 0.0], runs=40, steps=100),
)
'''


def ccdtools(*arguments: str, cwd: Path, program=CCDTOOLS, **options) -> subprocess.CompletedProcess:
    return subprocess.run([*program, *arguments], cwd=cwd, capture_output=True, text=True, timeout=500, **options)


@pytest.fixture(scope="module")
def quick_run(tmp_path_factory):
    """A quick run of the illustrative example, one generation."""
    cwd = tmp_path_factory.mktemp("quick")
    done = ccdtools("run", "illustrative", "--quick", "--generations", "1", "--output", "out", cwd=cwd)
    assert done.returncode == 0, done.stderr
    return cwd, done


def results_of(folder: Path) -> dict:
    return json.loads((folder / "results.json").read_text())


def test_run_folder_holds_everything_that_is_promised(quick_run):
    cwd, done = quick_run
    names = {p.name for p in (cwd / "out").iterdir()}
    assert {"results.json", "report.html", "policy.safetensors", "comparison.csv", "generations.csv",
            "learning_curves.csv", "figures"} <= names  # fmt: skip
    assert "QUICK" in done.stdout
    assert "learned" in done.stdout


def test_results_follow_the_schema(quick_run):
    results = results_of(quick_run[0] / "out")
    assert {"schema_version", "study", "seed", "wall_seconds", "generations", "comparison"} <= set(results)
    generation = results["generations"][0]
    assert {"generation", "design", "active_bounds", "model_return", "deployed_return", "quantiles"} <= set(generation)
    assert {"mean", "std", "n", "ci95"} <= set(generation["model_return"])
    assert {"rmse", "pinball", "coverage"} <= set(generation["quantiles"])
    row = results["comparison"][0]
    assert {"plant", "generation", "controller", "design", "mean", "std", "ci95", "paired_to_lqr", "diverged",
            "violations", "step_time_us"} <= set(row)  # fmt: skip
    controllers = {r["controller"] for r in results["comparison"] if r["plant"] == "real"}
    assert controllers == {"passive", "LQR", "PID", "MPC", "learned", "learned (sampled)"}
    assert {r["generation"] for r in results["comparison"]} == {0, 1}
    assert results["quick"] is True


def test_saved_policy_is_a_controller(quick_run):
    from ccdtools import load_policy

    policy = load_policy(quick_run[0] / "out" / "policy.safetensors")
    assert policy(np.zeros(2)).shape == (1,)
    assert np.all(np.abs(policy(np.full((5, 2), -50.0))) <= 1.0)


def test_report_needs_nothing_but_itself(quick_run):
    html = (quick_run[0] / "out" / "report.html").read_text()
    assert "data:image/png;base64," in html
    assert not re.search(r'(src|href)="(?!data:|#)', html)
    assert "QUICK" in html


def test_existing_folder_is_never_overwritten_silently(quick_run):
    cwd, _ = quick_run
    before = (cwd / "out" / "results.json").stat().st_mtime_ns
    refused = ccdtools("run", "illustrative", "--quick", "--output", "out", cwd=cwd)
    assert refused.returncode == 2
    assert len(refused.stderr.strip().splitlines()) == 1
    assert "--output: got out, which exists" in refused.stderr
    assert (cwd / "out" / "results.json").stat().st_mtime_ns == before


def test_resume_of_a_finished_run_computes_nothing_again(quick_run):
    cwd, _ = quick_run
    before = results_of(cwd / "out")
    again = ccdtools("resume", "out", cwd=cwd)
    assert again.returncode == 0, again.stderr
    assert results_of(cwd / "out") == before


def test_interrupted_run_keeps_what_it_finished_and_its_command_continues_it(tmp_path, quick_run):
    arguments = ["run", "illustrative", "--quick", "--generations", "1", "--output", "my run"]
    process = subprocess.Popen(
        [*CCDTOOLS, *arguments], cwd=tmp_path, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
        env=os.environ | {"PYTHONUNBUFFERED": "1"},
    )  # fmt: skip
    deadline = time.monotonic() + 300
    while not (tmp_path / "my run" / "stages" / "codesign-1").is_dir() and time.monotonic() < deadline:
        time.sleep(0.05)
    process.send_signal(signal.SIGINT)
    out, err = process.communicate(timeout=120)
    assert process.returncode == 130, err
    assert "Traceback" not in err
    command = re.search(r"Continue with: (.*)", out).group(1)
    kept = tmp_path / "my run" / "stages" / "codesign-1" / "arrays.npz"
    before = kept.stat().st_mtime_ns
    continued = subprocess.run(command, shell=True, cwd=tmp_path, capture_output=True, text=True, timeout=500)
    assert continued.returncode == 0, continued.stderr
    assert kept.stat().st_mtime_ns == before
    # The same seed gives the same run, interrupted or not; only times differ.
    whole, resumed = (results_of(f) for f in (quick_run[0] / "out", tmp_path / "my run"))
    assert resumed["generations"] == whole["generations"]


def test_the_template_runs_as_it_is_written(tmp_path):
    written = ccdtools("new", "spring_cart", cwd=tmp_path)
    assert written.returncode == 0, written.stderr
    source = (tmp_path / "spring_cart.py").read_text()
    assert 'name="spring_cart"' in source
    assert 'title="Spring cart"' in source
    done = ccdtools("run", "spring_cart.py", "--quick", "--generations", "1", "--output", "out", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    results = results_of(tmp_path / "out")
    assert results["headline"] in done.stdout
    assert results["headline"] in (tmp_path / "out" / "report.html").read_text(encoding="utf-8")


def test_third_study_is_one_file(tmp_path):
    (tmp_path / "two_masses.py").write_text(TWO_MASSES)
    done = ccdtools("run", "two_masses.py", "--quick", "--generations", "2", "--output", "out", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    rows = [r for r in results_of(tmp_path / "out")["comparison"] if r["plant"] == "model" and r["model"] == "nominal"]
    learned = {r["generation"]: r for r in rows if r["controller"] == "learned"}
    assert learned[1]["mean"] > learned[0]["mean"]
    assert learned[1]["paired_to_lqr"]["mean"] > -0.02 * abs(learned[1]["mean"])


def test_recorded_disturbance_drives_the_real_plant(tmp_path):
    rng = np.random.default_rng(0)
    signal_ = np.convolve(rng.standard_normal(500), np.ones(3) / 6, mode="same")
    (tmp_path / "z.csv").write_text("dz_dt\n" + "\n".join(map(str, signal_)) + "\n")
    given = ["run", "suspension", "--generations", "1", "--disturbance", "z.csv", "--sets", "lqr", "--output", "out"]
    program, paths = [sys.executable, tiny_command.__file__], {"PYTHONPATH": os.pathsep.join(sys.path)}
    done = ccdtools(*given, cwd=tmp_path, program=program, env=os.environ | paths)
    assert done.returncode == 0, done.stderr
    with np.load(tmp_path / "out" / "stages" / "deployment-1" / "arrays.npz") as log:
        np.testing.assert_allclose(log["disturbances"][0, :, 0], signal_)
    assert results_of(tmp_path / "out")["deployment_steps"] == 500
