"""Resuming: a damaged folder, an edited study and a second process are refused; a killed run ends like a whole one."""

import json
import os
import shutil
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import small_runs
import tiny_command
from spring_run import ARGUMENTS, call, run_spring

from ccdtools.studies import RunFolder
from ccdtools.studies.preparation import differences

COMMAND = [sys.executable, tiny_command.__file__]


pytestmark = pytest.mark.check


@pytest.fixture(scope="module")
def whole(stored):
    """A folder with a study and its finished run, which all processes share."""
    return stored("spring", run_spring)


@pytest.fixture
def copy(whole, tmp_path):
    """A copy of the run, to be damaged, with its study in the old place."""
    shutil.copytree(whole / "run", tmp_path / "run")
    return tmp_path / "run"


def outcome(folder: Path) -> dict:
    """results.json without what is measured in seconds."""
    results = json.loads((folder / "results.json").read_text(encoding="utf-8"))
    del results["wall_seconds"], results["initialisation"]["seconds"]
    for row in [*results["comparison"], *results["held_out"]]:
        del row["step_time_us"]
    return results


def edit(name, **changes):
    """Return a damage: other values in a JSON file."""

    def damage(run):
        values = json.loads((run / name).read_text(encoding="utf-8"))
        (run / name).write_text(json.dumps(values | changes), encoding="utf-8")

    return damage


def edit_option(**changes):
    """Return a damage: other options in run.json."""

    def damage(run):
        values = json.loads((run / "run.json").read_text(encoding="utf-8"))
        values["options"] |= changes
        (run / "run.json").write_text(json.dumps(values), encoding="utf-8")

    return damage


def write(name, content):
    """Return a damage: another content of a file."""

    def damage(run):
        (run / name).write_bytes(content)

    return damage


def remove(name):
    """Return a damage: a file that is gone."""

    def damage(run):
        (run / name).unlink()

    return damage


def file_for_folder(name):
    """Return a damage: a file where a folder was."""

    def damage(run):
        shutil.rmtree(run / name)
        (run / name).write_text("")

    return damage


def folder_for_file(name):
    """Return a damage: a folder where a file was."""

    def damage(run):
        (run / name).unlink(missing_ok=True)
        (run / name).mkdir()

    return damage


def cut(name):
    """Return a damage: the end of a file is missing."""

    def damage(run):
        (run / name).write_bytes((run / name).read_bytes()[:-30])

    return damage


def flip(name):
    """Return a damage: one bit in the middle of a file."""

    def damage(run):
        content = bytearray((run / name).read_bytes())
        content[len(content) // 2] ^= 1
        (run / name).write_bytes(bytes(content))

    return damage


def take_for(name, other):
    """Return a damage: a stage in the place of another."""

    def damage(run):
        shutil.rmtree(run / "stages" / other)
        (run / "stages" / name).rename(run / "stages" / other)

    return damage


DAMAGES = {
    "no run.json": (remove("run.json"), "without a readable run.json"),
    "empty run.json": (write("run.json", b""), "without a readable run.json"),
    "run.json is a list": (write("run.json", b"[]"), "without a readable run.json"),
    "run.json is no JSON": (write("run.json", b"{'a': 1}"), "without a readable run.json"),
    "run.json is binary": (write("run.json", bytes(range(256))), "without a readable run.json"),
    "run.json is {}": (write("run.json", b"{}"), "a run.json of another kind"),
    "run.json of another format": (edit("run.json", format=1), "a run.json of another kind"),
    "options are missing": (edit("run.json", options={}), "a run.json of another kind"),
    "options are a list": (edit("run.json", options=[1]), "a run.json of another kind"),
    "seed is text": (edit_option(seed="0"), "run.json, seed: got '0', expected a whole number"),
    "seed is negative": (edit_option(seed=-1), "run.json, seed: got -1"),
    "seed is another": (edit_option(seed=1), "belongs to another run, or run.json was changed since"),
    "generations are a fraction": (edit_option(generations=1.5), "run.json, generations: got 1.5"),
    "quick is text": (edit_option(quick="yes"), "run.json, quick: got 'yes'"),
    "x0 is text": (edit_option(x0="1,2"), "run.json, x0: got '1,2'"),
    "x0 is too long": (edit_option(x0=[0.1, 0.1, 0.1]), "--x0: got shape (3,)"),
    "study is a number": (edit_option(study=3), "run.json, study: got 3"),
    "study is gone": (edit_option(study="/nowhere/spring.py"), "/nowhere/spring.py, which is not a file"),
    "study is another": (edit_option(study="illustrative"), "begun with another study: study.name was"),
    "recording is gone": (edit_option(disturbance="w.csv"), "without disturbance.npy"),
    "recording is rubbish": (write("disturbance.npy", b"rubbish"), "with a damaged disturbance.npy"),
    "recording is added": (lambda run: np.save(run / "disturbance.npy", np.zeros((600, 1))), "real.disturbance"),
    "stages is a file": (file_for_folder("stages"), "with a file stages, expected a folder stages, or none"),
    "figures is a file": (file_for_folder("figures"), "with a file figures, expected a folder figures, or none"),
    "results.json is a folder": (folder_for_file("results.json"), "with a folder results.json"),
    "report.html is a folder": (folder_for_file("report.html"), "with a folder report.html"),
    "policy is a folder": (folder_for_file("policy.safetensors"), "with a folder policy.safetensors"),
    "agent is gone": (remove("stages/codesign-1/agent.safetensors"), "agent.safetensors is missing"),
    "agent is cut": (cut("stages/codesign-1/agent.safetensors"), "agent.safetensors is not as it was written"),
    "agent is flipped": (flip("stages/deployment-1/agent.safetensors"), "agent.safetensors is not as it was written"),
    "values are {}": (write("stages/comparison-0/values.json", b"{}"), "values.json is not as it was written"),
    "values are gone": (remove("stages/comparison-0/values.json"), "values.json is missing"),
    "arrays are cut": (cut("stages/deployment-1/arrays.npz"), "arrays.npz is not as it was written"),
    "arrays are gone": (remove("stages/deployment-1/arrays.npz"), "arrays.npz is missing"),
    "manifest is gone": (remove("stages/twin-1/manifest.json"), "manifest.json"),
    "manifest is rubbish": (write("stages/twin-1/manifest.json", b"[]"), "manifest.json is not of this stage"),
    "a stage in the place of another": (take_for("twin-2", "twin-1"), "manifest.json is not of this stage"),
}  # fmt: skip


@pytest.mark.parametrize("name", DAMAGES)
def test_a_damaged_run_is_refused_in_one_line(copy, capsys, name):
    damage, message = DAMAGES[name]
    damage(copy)
    capsys.readouterr()
    code = call("resume", str(copy))
    error = capsys.readouterr().err
    assert code == 2, error
    assert message in error
    assert len(error.strip().splitlines()) == 1


def test_there_are_at_least_22_of_them():
    assert len(DAMAGES) >= 22


@pytest.mark.check
def test_a_stage_that_was_deleted_is_computed_again_as_it_was(whole, copy):
    for name in ("codesign-2", "comparison-2"):
        shutil.rmtree(copy / "stages" / name)
    (copy / "results.json").unlink()
    assert call("resume", str(copy)) == 0
    assert outcome(copy) == outcome(whole / "run")


EDITS = {
    "a weight": ("Q = np.eye(2)", "Q = 2 * np.eye(2)", "study.objective.Q was [[1.0, 0.0], [0.0, 1.0]], is"),
    "the start": ("x0=[0.5, 0]", "x0=[0.4, 0]", "study.x0 was [0.5, 0.0], is [0.4, 0.0]"),
    "the dynamics": ("-p * x[0] + u + w", "-p * x[0] - 0.1 * x[1] + u + w", "study.plant.dynamics differs"),
    "a bound of the design": ("[1], [4]", "[1], [5]", "study.plant.design.upper was [4.0], is [5.0]"),
    "a limit": ("[-1, -2], [1, 2]", "[-1, -2], [1, 3]", "study.X.b was"),
    "the noise": ("Gaussian([0.1])", "Gaussian([0.2])", "study.disturbance.std was [0.1], is [0.2]"),
    "the number of runs": ("runs=30", "runs=40", "study.real.runs was 30, is 40"),
    "a comment": ('"""A mass', '"""One mass', "the source spring.py was edited"),
}


@pytest.mark.parametrize("name", EDITS)
def test_a_run_of_a_study_that_was_edited_since_is_refused_with_the_difference(copy, tmp_path, capsys, name):
    before, after, message = EDITS[name]
    (tmp_path / "spring.py").write_text(small_runs.SPRING.replace(before, after))
    options = json.loads((copy / "run.json").read_text(encoding="utf-8"))["options"]
    edit("run.json", options=options | {"study": str(tmp_path / "spring.py")})(copy)
    assert call("resume", str(copy)) == 2
    error = capsys.readouterr().err
    assert "begun with another study: " in error
    assert message in error
    assert "Undo the change, or begin a new run." in error


@pytest.mark.parametrize(
    ("name", "value", "message"), [("model_runs", 31, "was 30, is 31"), ("mpc_runs", 3, "was 2, is 3")]
)
def test_a_run_with_another_configuration_is_refused(copy, capsys, monkeypatch, name, value, message):
    tiny = small_runs.tiny
    monkeypatch.setattr(small_runs, "tiny", lambda config: replace(tiny(config), **{name: value}))
    assert call("resume", str(copy)) == 2
    assert f"configuration.{name} {message}" in capsys.readouterr().err


def test_a_folder_that_was_begun_before_losses_were_accepted_or_not_is_another(copy):
    """Its stages say nothing of it."""
    kept = json.loads((copy / "run.json").read_text())
    now = kept["begun_with"]
    before = {name: value for name, value in now.items() if "accept_loss" not in name}
    assert set(differences(before, now)) == {
        "configuration.online.accept_loss was null, is 0.005", 'study.accept_loss was null, is "0.5 %"'
    }  # fmt: skip


@pytest.mark.check
def test_a_second_process_in_the_folder_is_refused(copy, capsys):
    with RunFolder(copy).locked():
        assert call("resume", str(copy)) == 2
    assert "in which another process is running" in capsys.readouterr().err
    assert call("resume", str(copy)) == 0


@pytest.mark.check
def test_a_recording_is_kept_with_the_run(whole, tmp_path):
    shutil.copy(whole / "w.csv", tmp_path / "w.csv")
    run = tmp_path / "run"
    arguments = ["run", str(whole / "spring.py"), "--disturbance", str(tmp_path / "w.csv"), "--generations", "1"]
    assert call(*arguments, "--output", str(run)) == 0
    before = outcome(run)
    (tmp_path / "w.csv").unlink()
    shutil.rmtree(run / "stages" / "deployment-1")
    assert call("resume", str(run)) == 0
    assert outcome(run) == before


@pytest.mark.check
def test_a_run_that_is_killed_again_and_again_ends_like_one_that_is_not(whole, tmp_path):
    run = tmp_path / "run"
    begin, resume = ["run", str(whole / "spring.py"), "--output", str(run), *ARGUMENTS], ["resume", str(run)]
    for arguments, stage in ((begin, "initialisation"), (resume, "deployment-1"), (resume, "comparison-2")):
        process = subprocess.Popen(
            [*COMMAND, *arguments], stdout=subprocess.DEVNULL, stderr=subprocess.PIPE,
            env=os.environ | {"OMP_NUM_THREADS": "1", "PYTHONPATH": os.pathsep.join(sys.path)},
        )  # fmt: skip
        deadline = time.monotonic() + 200
        while not (run / "stages" / stage).is_dir() and process.poll() is None and time.monotonic() < deadline:
            time.sleep(0.002)
        process.send_signal(signal.SIGKILL)
        process.communicate()
        assert process.returncode == -signal.SIGKILL
    assert call("resume", str(run)) == 0
    assert outcome(run) == outcome(whole / "run")


@pytest.mark.check
def test_two_processes_run_to_the_same_results(whole, tmp_path):
    run = tmp_path / "run"
    arguments = ["run", str(whole / "spring.py"), "--output", str(run), *ARGUMENTS, "--jobs", "2"]
    assert call(*arguments) == 0
    assert outcome(run) == outcome(whole / "run")
    shutil.rmtree(run / "stages" / "comparison-1")
    assert call("resume", str(run), "--jobs", "2") == 0
    assert outcome(run) == outcome(whole / "run")


def test_held_out_runs_are_compared_at_the_first_and_the_last_design_alone(whole):
    folder = RunFolder(whole / "run")
    compared = ["held_out" in folder.read_stage(f"comparison-{g}").values for g in range(3)]
    assert compared == [True, False, True]
    assert {row["generation"] for row in folder.read_json("results.json")["held_out"]} == {0, 2}
