"""The package is light: what it imports, and when."""

import subprocess
import sys

import pytest

CODE = """
import sys
import invariant_sets
print(*[name for name in ("scipy.spatial", "scipy.optimize") if name in sys.modules])
P = invariant_sets.Polytope.from_bounds([0, 0], [1, 1])
P.volume, P.minimal()
heavy = ("matplotlib", "joblib", "cvxpy", "torch", "casadi", "control", "numba")
print(*[name for name in heavy if name in sys.modules])
"""


@pytest.mark.long
def test_import_loads_no_heavy_package_and_scipy_only_when_needed():
    run = subprocess.run([sys.executable, "-c", CODE], capture_output=True, text=True, check=True).stdout.split("\n")
    assert run[:2] == ["", ""]
