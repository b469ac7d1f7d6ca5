"""A run's folder: whole stages, nothing overwritten, nothing damaged, plain JSON."""

import errno
import json
import os
import re
from pathlib import Path

import numpy as np
import pytest
import torch

from ccdtools import InputError
from ccdtools.cli import RunFolder
from ccdtools.studies.stage_storage import Stage, jsonable
from learning import ActorCritic, NetworkConfig


@pytest.fixture
def folder(tmp_path):
    return RunFolder.create(tmp_path / "run")


def stage(value=1.0):
    network = ActorCritic([-1], [1], [-1], [1], config=NetworkConfig((3,)), seed=2)
    return Stage({"value": value, "none": np.nan}, {"a": np.arange(6.0).reshape(2, 3)}, {"agent": network})


def test_a_stage_comes_back_as_it_was_written(folder):
    back = folder.keep_stage("one", stage())
    assert back.values == {"value": 1.0, "none": None}
    np.testing.assert_array_equal(back.arrays["a"], np.arange(6.0).reshape(2, 3))
    x = torch.randn(4, 1)
    torch.testing.assert_close(back.networks["agent"].latent(x), stage().networks["agent"].latent(x))


def test_a_stage_cut_off_while_it_was_written_is_not_finished(folder, monkeypatch):
    def cut(*args, **kwargs):
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr("learning.checkpoint.save", cut)
        with pytest.raises(KeyboardInterrupt):
            folder.keep_stage("one", stage())
    assert not folder.has("one")
    assert folder.finished() == []
    assert folder.keep_stage("one", stage(2.0)).values["value"] == 2.0
    assert [p.name for p in (folder.path / "stages").iterdir()] == ["one"]


def test_finished_stages_are_listed_oldest_first(folder):
    for name in ("zebra", "apple", "mango"):
        folder.keep_stage(name, Stage())
    assert folder.finished() == ["zebra", "apple", "mango"]


def test_a_new_folder_has_finished_nothing(folder):
    assert folder.finished() == []
    assert not folder.has("one")


def test_nothing_in_the_folder_is_a_pickle(folder):
    folder.keep_stage("one", stage())
    assert {p.suffix for p in folder.path.rglob("*") if p.is_file()} == {".json", ".npz", ".safetensors"}


# ── never overwritten silently ──


def test_an_existing_folder_is_refused(folder):
    with pytest.raises(InputError, match=r"path: got .*run, which exists, expected a new folder"):
        RunFolder.create(folder.path)
    with pytest.raises(InputError, match="elsewhere: got"):
        RunFolder.create(folder.path, argument="elsewhere")


def test_a_run_is_overwritten_when_asked(folder):
    folder.write_json("run.json", {})
    folder.keep_stage("one", Stage())
    again = RunFolder.create(folder.path, overwrite=True)
    assert again.finished() == []


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


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf, np.float64("nan"), float("inf")])
def test_what_is_not_finite_becomes_null(value):
    assert json.dumps(jsonable({"x": [value, np.array([value, 1.0])]}), allow_nan=False) == '{"x": [null, [null, 1.0]]}'


def test_types_become_those_of_python():
    out = jsonable({"i": np.int64(3), "b": True, "f": np.float64(0.5), "t": (1, 2)})
    assert [type(v) for v in out.values()] == [int, bool, float, list]


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


@pytest.mark.parametrize("damage", ["missing", "cut", "edited", "added", "renamed", "other run", "no manifest"])
def test_a_stage_that_is_not_as_this_run_wrote_it_is_refused(folder, damage):
    folder.write_json("run.json", {"seed": 0})
    folder.keep_stage("one", stage())
    place = folder.path / "stages" / "one"
    if damage == "missing":
        (place / "agent.safetensors").unlink()
    elif damage == "cut":
        (place / "arrays.npz").write_bytes((place / "arrays.npz").read_bytes()[:-20])
    elif damage == "edited":
        (place / "values.json").write_text("{}")
    elif damage == "added":
        (place / "spare.safetensors").write_bytes(b"")
    elif damage == "renamed":
        place = place.rename(place.with_name("two"))
    elif damage == "other run":
        folder.write_json("run.json", {"seed": 1})
    else:
        (place / "manifest.json").unlink()
    with pytest.raises(InputError, match=r"folder: got a damaged stage .*, expected it as written. Delete it, and"):
        folder.check_stages()


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


@pytest.mark.parametrize("number", [errno.ENOSPC, errno.EROFS, errno.EACCES])
def test_a_disk_that_takes_no_more_is_one_clear_line(folder, monkeypatch, number):
    def full(self, *args, **kwargs):
        raise OSError(number, os.strerror(number), str(self))

    monkeypatch.setattr(Path, "write_text", full)
    monkeypatch.setattr(Path, "write_bytes", full)
    for write in (lambda: folder.keep_stage("one", stage()), lambda: folder.write_json("results.json", {})):
        with pytest.raises(InputError, match=re.escape(f"({os.strerror(number)}), expected a folder that can be")):
            write()
