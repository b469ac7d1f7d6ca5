"""Kill a run at random moments with SIGKILL, resume it, and compare with a run that nobody disturbed.

``python benchmarks/kill_and_resume.py [RUNS] [STUDY]`` prints one row per run; 20 runs of the illustrative example with
``--quick`` by default.
"""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np

MEASURED_IN_SECONDS = ("wall_seconds", "seconds", "step_time_us")


def ccdtools(*arguments: str) -> subprocess.Popen[str]:
    """The command line in a process of its own."""
    return subprocess.Popen(
        [sys.executable, "-m", "ccdtools", *arguments], stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True,
        env=os.environ | {"OMP_NUM_THREADS": "1"},
    )  # fmt: skip


def without_times(value: Any) -> Any:
    """`value` without the entries that are measured in seconds."""
    if isinstance(value, dict):
        return {key: without_times(item) for key, item in value.items() if key not in MEASURED_IN_SECONDS}
    return [without_times(item) for item in value] if isinstance(value, list) else value


def outcome(folder: Path) -> tuple[Any, bytes]:
    """results.json without times, and the policy."""
    results = json.loads((folder / "results.json").read_text(encoding="utf-8"))
    return without_times(results), (folder / "policy.safetensors").read_bytes()


def main(runs: int, study: str) -> int:
    """Print the table; the number of runs that differ."""
    rng = np.random.default_rng(0)
    with tempfile.TemporaryDirectory() as temporary:
        place = Path(temporary)
        start = time.monotonic()
        whole = ccdtools("run", study, "--quick", "--output", str(place / "whole"))
        if whole.wait() != 0:
            raise SystemExit(whole.stderr.read() if whole.stderr else "the undisturbed run failed")
        duration = time.monotonic() - start
        expected = outcome(place / "whole")
        print(f"{study} --quick, undisturbed: {duration:.0f} s\n")
        print("| run | killed after | stages kept | resumed |\n|---|---|---|---|")
        wrong = 0
        for number in range(1, runs + 1):
            folder = place / str(number)
            process = ccdtools("run", study, "--quick", "--output", str(folder))
            after = float(rng.uniform(0.05, 0.98)) * duration
            time.sleep(after)
            process.send_signal(signal.SIGKILL)
            process.wait()
            kept = len([p for p in (folder / "stages").glob("*") if not p.name.endswith(".partial")])
            if not (folder / "run.json").is_file():
                print(f"| {number} | {after:.1f} s | before the folder was made | - |", flush=True)
                continue
            again = ccdtools("resume", str(folder))
            _, error = again.communicate()
            same = again.returncode == 0 and outcome(folder) == expected
            wrong += not same
            word = "identical" if same else f"DIFFERENT {error}"
            print(f"| {number} | {after:.1f} s | {kept} | {word} |", flush=True)
    print(f"\n{wrong} of {runs} differ")
    return wrong


if __name__ == "__main__":
    count = int(sys.argv[1]) if len(sys.argv) > 1 else 20
    sys.exit(main(count, sys.argv[2] if len(sys.argv) > 2 else "illustrative") > 0)
