"""What test_run_folder.py claims, seen from inside."""

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


def test_nothing_in_the_folder_is_a_pickle(folder):
    folder.keep_stage("one", stage())
    assert {p.suffix for p in folder.path.rglob("*") if p.is_file()} == {".json", ".npz", ".safetensors"}


def test_a_run_is_overwritten_when_asked(folder):
    folder.write_json("run.json", {})
    folder.keep_stage("one", Stage())
    again = RunFolder.create(folder.path, overwrite=True)
    assert again.finished() == []


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf, np.float64("nan"), float("inf")])
def test_what_is_not_finite_becomes_null(value):
    assert json.dumps(jsonable({"x": [value, np.array([value, 1.0])]}), allow_nan=False) == '{"x": [null, [null, 1.0]]}'


def test_types_become_those_of_python():
    out = jsonable({"i": np.int64(3), "b": True, "f": np.float64(0.5), "t": (1, 2)})
    assert [type(v) for v in out.values()] == [int, bool, float, list]


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


@pytest.mark.parametrize("number", [errno.ENOSPC, errno.EROFS, errno.EACCES])
def test_a_disk_that_takes_no_more_is_one_clear_line(folder, monkeypatch, number):
    def full(self, *args, **kwargs):
        raise OSError(number, os.strerror(number), str(self))

    monkeypatch.setattr(Path, "write_text", full)
    monkeypatch.setattr(Path, "write_bytes", full)
    for write in (lambda: folder.keep_stage("one", stage()), lambda: folder.write_json("results.json", {})):
        with pytest.raises(InputError, match=re.escape(f"({os.strerror(number)}), expected a folder that can be")):
            write()
