"""The benchmark runs, and names the peers it did not find instead of failing."""

import subprocess
import sys
from pathlib import Path

import pytest

BENCHMARK = Path(__file__).resolve().parents[2] / "benchmarks" / "bench_mpc.py"


@pytest.mark.check
def test_benchmark_prints_its_table_and_names_missing_peers():
    hidden = "import sys; sys.modules.update(osqp=None, casadi=None, do_mpc=None)\n"
    run = f"import runpy; sys.argv = ['bench', 'online']; runpy.run_path({str(BENCHMARK)!r}, run_name='__main__')"
    command = [sys.executable, "-c", hidden + run]
    shown = subprocess.run(command, check=True, capture_output=True, text=True, timeout=120).stdout
    assert "| LinearMPC, u = controller(x) |" in shown
    assert "raw OSQP" not in shown
    assert "peers not installed: casadi, do_mpc, osqp" in shown
