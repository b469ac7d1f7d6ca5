"""The benchmark runs without peers, and the speeds that need no peer hold with room to spare."""

import importlib.util
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
from set_plants import ILLUSTRATIVE_U, ILLUSTRATIVE_X, SUSPENSION_U, SUSPENSION_X, illustrative, suspension

from invariant_sets import ParametricSet, maximal_control_invariant_set

SCRIPT = Path(__file__).parents[2] / "benchmarks" / "bench_sets.py"


def test_benchmark_names_the_missing_peers_and_prints_every_table():
    answer = subprocess.run([sys.executable, str(SCRIPT), "--quick"], capture_output=True, text=True, check=True)
    missing = [name for name in ("polytope", "pycvxset") if importlib.util.find_spec(name) is None]
    assert all(name in answer.stdout.splitlines()[0] for name in missing)
    for heading in ("maximal control invariant set", "sets as functions of the design", "1e6 states", "growth"):
        assert heading in answer.stdout


def test_300_designs_take_less_than_a_second(rng):
    family = ParametricSet(illustrative, ILLUSTRATIVE_X, ILLUSTRATIVE_U)
    start = time.process_time()  # of this process, whatever else runs
    family.contains(np.zeros((300, 2)), rng.uniform(0.5, 3, (300, 1)))
    assert time.process_time() - start < 1.0


def test_suspension_designs_are_quick_enough_for_3000_in_15_seconds(rng):
    family = ParametricSet(suspension, SUSPENSION_X, SUSPENSION_U)
    start = time.process_time()
    family.contains(np.zeros((200, 4)), rng.uniform([1e4, 500], [4e4, 3000], (200, 2)))
    assert (time.process_time() - start) * 3000 / 200 < 15.0


def test_membership_is_no_slower_than_the_product(rng):
    C = maximal_control_invariant_set(*suspension((27692.0, 1906.5)), SUSPENSION_X, SUSPENSION_U).set
    x = rng.uniform(-1, 1, (1_000_000, 4)) * [0.25, 2.5, 0.5, 2.5]
    times = {"contains": [], "product": []}
    for _ in range(5):
        for name, work in (("contains", lambda: C.contains(x)), ("product", lambda: x @ C.A.T)):
            start = time.perf_counter()
            work()
            times[name].append(time.perf_counter() - start)
    assert min(times["contains"]) <= min(times["product"])
    assert min(times["contains"]) < 0.2
    np.testing.assert_array_equal(C.contains(x[:1000], tol=0.0), (x[:1000] @ C.A.T <= C.b).all(axis=1))
