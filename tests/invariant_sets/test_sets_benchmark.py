"""The benchmark runs without peers; what it times fast is also right. Speeds are printed there, never asserted here."""

import importlib.util
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from set_plants import SUSPENSION_U, SUSPENSION_X, suspension

from invariant_sets import maximal_control_invariant_set

SCRIPT = Path(__file__).parents[2] / "benchmarks" / "bench_sets.py"


@pytest.mark.check
def test_benchmark_names_the_missing_peers_and_prints_every_table():
    answer = subprocess.run([sys.executable, str(SCRIPT), "--quick"], capture_output=True, text=True, check=True)
    missing = [name for name in ("polytope", "pycvxset") if importlib.util.find_spec(name) is None]
    assert all(name in answer.stdout.splitlines()[0] for name in missing)
    for heading in ("maximal control invariant set", "sets as functions of the design", "1e6 states", "growth"):
        assert heading in answer.stdout


def test_membership_agrees_with_the_product_on_a_large_batch(rng):
    C = maximal_control_invariant_set(*suspension((27692.0, 1906.5)), SUSPENSION_X, SUSPENSION_U).set
    x = rng.uniform(-1, 1, (300_000, 4)) * [0.25, 2.5, 0.5, 2.5]
    np.testing.assert_array_equal(C.contains(x, tol=0.0), (x @ C.A.T <= C.b).all(axis=1))
