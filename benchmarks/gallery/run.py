"""The whole loop over the gallery: ``python -m gallery.run`` from the folder ``benchmarks``.

Every run is ``ccdtools run`` on a study file in a process of its own, from the study's start or from the corner of the
box where LQR is worst. What is finished is kept: the same call goes on where it was interrupted.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from joblib import Parallel, delayed

from gallery.reference import STUDIES, reference
from gallery.table import markdown

HERE = Path(__file__).resolve().parent
STARTS = ("study", "corner")


@dataclass(frozen=True)
class Run:
    """One run: its study, start and seed, the generations asked for, and the folder of all runs."""

    study: str
    start: str
    seed: int
    generations: int
    quick: bool
    root: Path

    @property
    def folder(self) -> Path:
        """Where the run is kept."""
        quick = "-quick" if self.quick else ""
        return self.root / f"{self.study}-{self.start}-{self.seed}-{self.generations}{quick}"

    def command(self) -> list[str]:
        """The command line that begins the run, or goes on with it."""
        program = [sys.executable, "-m", "ccdtools"]
        if (self.folder / "run.json").is_file():
            return [*program, "resume", str(self.folder)]
        command = [*program, "run", str(HERE / "studies" / f"{self.study}.py"), "--output", str(self.folder)]
        command += ["--seed", str(self.seed), "--generations", str(self.generations)]
        if self.start == "corner":
            command.append("--p0=" + ",".join(repr(value) for value in reference(self.study)["worst_corner"]))
        return [*command, "--quick"] if self.quick else command


def carried_out(run: Run, limit: float) -> None:
    """Carry a run out, unless it is finished; what it took, and how it ended, stand in ``gallery.json`` beside it."""
    note = run.folder.with_suffix(".json")
    if note.is_file() and json.loads(note.read_text())["exit"] == 0:
        return
    environment = os.environ | {"OMP_NUM_THREADS": "1", "PYTHONPATH": os.pathsep.join(sys.path)}
    begun = time.perf_counter()
    print(f"{run.folder.name} …", flush=True)
    log = run.folder.with_suffix(".log")
    with log.open("a") as output:
        process = subprocess.Popen(run.command(), stdout=output, stderr=subprocess.STDOUT, env=environment)
        code, memory = _awaited(process, limit)
    seconds = time.perf_counter() - begun
    note.write_text(json.dumps({"exit": code, "seconds": seconds, "peak_bytes": memory, "log": log.name}))
    print(f"{run.folder.name}: exit {code}, {seconds:.0f} s, {memory / 2**20:.0f} MiB", flush=True)


def _awaited(process: subprocess.Popen, limit: float) -> tuple[int, int]:
    """Exit code and peak memory [bytes] of a process, which is killed after `limit` seconds."""
    end = time.monotonic() + limit
    while True:
        pid, status, usage = os.wait4(process.pid, os.WNOHANG)
        if pid:
            process.returncode = os.waitstatus_to_exitcode(status)
            return process.returncode, 1024 * usage.ru_maxrss
        if time.monotonic() > end:
            process.kill()
        time.sleep(0.2)


def main(arguments: Sequence[str] | None = None) -> None:
    """Carry out the runs asked for, and print and write their table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("studies", nargs="*", help=f"default: all of {', '.join(STUDIES)}")
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2])
    parser.add_argument("--starts", nargs="+", choices=STARTS, default=list(STARTS))
    parser.add_argument("--generations", type=int, default=3)
    parser.add_argument("--quick", action="store_true", help="as `ccdtools run --quick`")
    parser.add_argument("--jobs", type=int, default=1)
    parser.add_argument("--limit", type=float, default=3600.0, help="seconds a run may take")
    parser.add_argument("--output", type=Path, default=Path("runs/gallery"))
    parser.add_argument("--table-only", action="store_true", help="of what is finished")
    given = parser.parse_args(arguments)
    unknown = sorted(set(given.studies) - set(STUDIES))
    if unknown:
        parser.error(f"unknown studies: {', '.join(unknown)}")
    given.output.mkdir(parents=True, exist_ok=True)
    runs = [
        Run(study, start, seed, given.generations, given.quick, given.output)
        for seed in given.seeds for start in given.starts for study in given.studies or STUDIES
    ]  # fmt: skip
    if not given.table_only:
        Parallel(n_jobs=given.jobs, prefer="threads")(delayed(carried_out)(run, given.limit) for run in runs)
    text = markdown(runs)
    (given.output / "table.md").write_text(text)
    print(text)


if __name__ == "__main__":
    main()
