"""A run's folder: whole stages, nothing overwritten, nothing damaged, plain JSON."""

import os
from pathlib import Path

import numpy as np
import pytest

from ccdtools import InputError
from ccdtools.cli import RunFolder


@pytest.fixture
def folder(tmp_path):
    return RunFolder.create(tmp_path / "run")


def test_a_new_folder_has_finished_nothing(folder):
    assert folder.finished() == []
    assert not folder.has("one")


# ── never overwritten silently ──


def test_an_existing_folder_is_refused(folder):
    with pytest.raises(InputError, match=r"path: got .*run, which exists, expected a new folder"):
        RunFolder.create(folder.path)
    with pytest.raises(InputError, match="elsewhere: got"):
        RunFolder.create(folder.path, argument="elsewhere")


def test_a_folder_whose_run_was_killed_before_it_began_is_used_again(folder):
    with folder.locked():
        (folder.path / "run.json.partial").write_text("{")
    assert os.listdir(RunFolder.create(folder.path).path) == []


def test_a_folder_that_holds_no_run_is_never_overwritten(tmp_path):
    (tmp_path / "thesis.txt").write_text("precious")
    with pytest.raises(InputError, match="which holds no run, expected a run's folder to overwrite"):
        RunFolder.create(tmp_path, overwrite=True)
    assert (tmp_path / "thesis.txt").read_text() == "precious"
    file = tmp_path / "thesis.txt"
    with pytest.raises(InputError, match="which holds no run"):
        RunFolder.create(file, overwrite=True)


def test_a_folder_that_cannot_be_made_is_refused(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(InputError, match=r"path: got .*, expected a folder that can be made \(Not a directory\)"):
        RunFolder.create(tmp_path / "file" / "run")


def test_parents_are_made(tmp_path):
    assert RunFolder.create(tmp_path / "a" / "b").path.is_dir()


# ── JSON ──


def test_json_goes_out_plain_and_comes_back(folder):
    folder.write_json("r.json", {"a": np.float32(1.5), "b": np.arange(2), "c": (np.bool_(True), None), 3: "ü"})
    assert folder.read_json("r.json") == {"a": 1.5, "b": [0, 1], "c": [True, None], "3": "ü"}
    assert "ü" in (folder.path / "r.json").read_text(encoding="utf-8")
    assert not list(Path(folder.path).glob("*.partial"))


def test_a_failed_write_leaves_the_old_file(folder):
    folder.write_json("r.json", {"a": 1})
    with pytest.raises(TypeError):
        folder.write_json("r.json", {"a": object()})
    assert folder.read_json("r.json") == {"a": 1}


@pytest.mark.parametrize("content", [None, "{", "\x00"])
def test_a_missing_or_broken_json_is_refused(folder, content):
    if content is not None:
        (folder.path / "run.json").write_text(content)
    with pytest.raises(InputError, match=r"folder: got .*run without a readable run.json, expected a run's folder"):
        folder.read_json("run.json")


@pytest.mark.parametrize("name", ["stages", "figures"])
def test_a_file_where_a_folder_belongs_is_refused(folder, name):
    folder.write_json("run.json", {})
    (folder.path / name).write_text("")
    with pytest.raises(InputError, match=f"folder: got .* with a file {name}, expected a folder {name}, or none"):
        folder.check_layout()


def test_a_folder_where_a_file_belongs_is_refused(folder):
    folder.write_json("run.json", {})
    (folder.path / "report.html").mkdir()
    with pytest.raises(InputError, match=r"with a folder report.html, expected a file report.html, or none"):
        folder.check_layout()


def test_two_at_once_are_one_too_many(folder):
    other = RunFolder(folder.path)
    with folder.locked(), pytest.raises(InputError, match="in which another process is running"), other.locked():
        pass
    with other.locked():
        pass


def test_a_folder_in_use_is_not_overwritten(folder):
    folder.write_json("run.json", {})
    with folder.locked(), pytest.raises(InputError, match="in which another process is running"):
        RunFolder.create(folder.path, overwrite=True)
    assert (folder.path / "run.json").is_file()
