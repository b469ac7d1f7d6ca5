"""What a user installs, and what a packager unpacks."""

import shutil
import subprocess
import sys
import tarfile
import zipfile
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]


@pytest.mark.check
def test_wheel_holds_exactly_the_typed_packages_and_the_sdist_the_documents(tmp_path):
    source = tmp_path / "source"  # a copy: what an earlier build left behind must not enter the wheel
    left_out = shutil.ignore_patterns("__pycache__", ".*", "build", "dist", "runs", "*.egg-info")
    shutil.copytree(ROOT, source, ignore=left_out)
    build = [sys.executable, "-m", "build", "--no-isolation", "--outdir", str(tmp_path), str(source)]
    done = subprocess.run(build, capture_output=True, text=True, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    (archive,) = tmp_path.glob("*.tar.gz")
    with tarfile.open(archive) as sdist:
        unpacked = {name.partition("/")[2] for name in sdist.getnames()}
    documents = {"docs/conf.py", "docs/how_to/linear_mpc.md", "notebooks/02_invariant_sets.ipynb", "CHANGELOG.md"}
    assert documents | {"tests/conftest.py"} <= unpacked
    (wheel,) = tmp_path.glob("*.whl")
    names = zipfile.ZipFile(wheel).namelist()
    packages = {name.split("/")[0] for name in names if not name.split("/")[0].endswith(".dist-info")}
    assert packages == {"ccdtools", "ccdtools_ground", "mpc", "invariant_sets", "learning"}
    assert {f"{package}/py.typed" for package in packages} <= set(names)
    assert "ccdtools/studies/report/report.html" in names


@pytest.mark.long
def test_help_waits_for_no_heavy_import():
    code = "import sys, ccdtools.cli; print({'torch', 'casadi', 'matplotlib', 'scipy'} & set(sys.modules))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "set()"
