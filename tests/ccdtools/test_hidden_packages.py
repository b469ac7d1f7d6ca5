"""A user's own file that has the name of one of the packages is named, with the cure."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from ccdtools import InputError, load_study

ROOT = Path(__file__).parents[2]


LAST = """
import importlib.machinery, sys
paths = importlib.machinery.PathFinder
class Last:
    def find_spec(name, path=None, target=None):
        return None if path else paths.find_spec(name, [ROOT])
sys.meta_path.insert(sys.meta_path.index(paths) + 1, Last)
"""  # an editable install: this tree is looked at after every folder of the path
DOORS = ["mpc.py", "learning.py", "learning/__init__.py", "invariant_sets.py", "mpc/data.txt", "invariant_sets/own.py"]


@pytest.mark.parametrize("hiding", DOORS)
def test_a_file_or_folder_beside_a_script_that_hides_a_package_is_named(tmp_path, hiding):
    file = tmp_path / hiding
    file.parent.mkdir(exist_ok=True)
    file.write_text("import ccdtools\n")
    (tmp_path / "script.py").write_text(LAST.replace("ROOT", repr(str(ROOT))) + "import ccdtools\n")
    done = subprocess.run(
        [sys.executable, "script.py"], cwd=tmp_path, capture_output=True, text=True, timeout=60,
        env={name: value for name, value in os.environ.items() if name != "PYTHONPATH"},
    )  # fmt: skip
    last = done.stderr.strip().splitlines()[-1]
    name = hiding.split("/")[0]
    assert last.startswith(f"ImportError: {tmp_path / name} hides the package `{name.removesuffix('.py')}`")
    assert "Rename it" in last


def test_a_file_beside_a_study_that_hides_a_package_is_named(tmp_path, monkeypatch):
    for name in [name for name in sys.modules if name.split(".")[0] == "learning"]:
        monkeypatch.delitem(sys.modules, name)
    (tmp_path / "learning.py").write_text("")
    (tmp_path / "mine.py").write_text("from learning.networks import NetworkConfig\n")
    with pytest.raises(InputError, match=r"mine.py:1, which stops with .*learning.py hides the package `learning`"):
        load_study(str(tmp_path / "mine.py"))
