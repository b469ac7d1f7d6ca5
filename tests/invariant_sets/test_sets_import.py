"""The package is light: what it imports, and when."""

import subprocess
import sys

CODE = """
import sys, time
start = time.perf_counter()
import invariant_sets
print(time.perf_counter() - start)
P = invariant_sets.Polytope.from_bounds([0, 0], [1, 1])
P.volume, P.minimal()
heavy = ("matplotlib", "joblib", "cvxpy", "torch", "casadi", "control", "numba")
print(*[name for name in heavy if name in sys.modules])
"""


def test_import_is_quick_and_loads_no_heavy_package():
    runs = [subprocess.run([sys.executable, "-c", CODE], capture_output=True, text=True, check=True).stdout.split("\n")
            for _ in range(3)]
    assert all(run[1] == "" for run in runs)
    assert min(float(run[0]) for run in runs) < 0.5
