"""Runs that commands begin."""

from __future__ import annotations

import os
import shlex
import shutil
import sys
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any, NoReturn

import typer

from ccdtools.exceptions import InputError
from ccdtools.jobs import held_back, insisting
from ccdtools.studies.options import Options
from ccdtools.studies.run_folder import RunFolder

if TYPE_CHECKING:
    from ccdtools.studies.preparation import PreparedRun

INTERRUPTED = 130  # This exit code tells an interruption.


def run_study(options: Options, name: str, output: str | None, *, overwrite: bool, jobs: int = 1) -> None:
    """Run a study in a new folder; tell how to resume if interrupted."""
    if output is not None:
        output_folder(output).check_new(overwrite=overwrite, argument="--output")
    folder = None
    try:
        with held_back():
            from ccdtools.studies.asked_study import asked_study

            asked = asked_study(options)  # first: what is wrong is said before the slow imports
            import ccdtools.studies.report.report  # noqa: F401
            from ccdtools.studies.preparation import prepare

            prepared = prepare(options, asked)
            _check_jobs(prepared, jobs)
            folder = _new_folder(output, name, overwrite)
        with folder.locked():
            with held_back():
                prepared.begin(folder)
            with insisting():
                _complete(folder, prepared, jobs)
    except KeyboardInterrupt:
        _stop(folder, jobs)


def resume_run(folder: RunFolder, jobs: int = 1) -> None:
    """Continue an interrupted run; tell how to resume if interrupted again."""
    try:
        folder.check_layout()
        with folder.locked():
            with held_back():
                import ccdtools.studies.report.report  # noqa: F401  (all that is slow to import)
                from ccdtools.studies.preparation import prepare_again

                prepared = prepare_again(folder)
                folder.check_stages()
                _check_jobs(prepared, jobs)
            with insisting():
                _complete(folder, prepared, jobs)
    except KeyboardInterrupt:
        _stop(folder, jobs)


def _complete(folder: RunFolder, prepared: PreparedRun, jobs: int) -> None:
    """Run what is not finished yet, and report."""
    from ccdtools.studies.fitted_run import FittedRun
    from ccdtools.studies.generations import Generations
    from ccdtools.studies.loading import blamed_on_source
    from ccdtools.studies.on_sensors import OnSensors
    from ccdtools.studies.report.fitted_page import write_fitted
    from ccdtools.studies.report.report import write_report
    from ccdtools.studies.report.side_by_side_page import write_side_by_side
    from ccdtools.studies.report.tables import console_table
    from ccdtools.studies.side_by_side import SideBySide
    from ccdtools.studies.side_by_side_run import SideBySideRun

    options = prepared.options
    study = prepared.study
    quick = " (QUICK: few samples, not for conclusions)" if options.quick else ""
    typer.echo(f"{study.title}, seed {options.seed}{quick} → {folder.path}")
    start = time.perf_counter()
    single_thread()
    asked: dict[str, Any] = {"seed": options.seed, "echo": typer.echo, "progress": sys.stderr.isatty()}
    with blamed_on_source(options.study):
        if isinstance(study, SideBySide):
            found = SideBySideRun(study, prepared.config, folder, **asked).run()
            text, report = write_side_by_side(study, *found, folder, quick=options.quick)
        elif isinstance(study, OnSensors):
            asked |= {"generations": options.generations, "jobs": jobs}
            kept = FittedRun(study, prepared.config, folder, **asked).run()
            text, report = write_fitted(study, *kept, folder, quick=options.quick)
        else:
            asked |= {"generations": options.generations, "jobs": jobs}
            results = Generations(study, prepared.config, folder, **asked).run()
            typer.echo("Figures and report")
            report = write_report(study, folder)
            text = f"{results['headline']}\n\n{console_table(results)}"
    typer.echo(f"\n{text}")
    typer.echo(f"\nReport, after {time.perf_counter() - start:.0f} s: {report}")


def _check_jobs(prepared: PreparedRun, jobs: int) -> None:
    """Raise where there is nothing for other processes."""
    from ccdtools.studies.side_by_side import SideBySide

    if jobs != 1 and isinstance(prepared.study, SideBySide):
        raise InputError("--jobs", jobs, "1 for a study with its uses side by side")


def _new_folder(output: str | None, name: str, overwrite: bool) -> RunFolder:
    """The folder asked for, or the first free one of runs/NAME-1, -2, …"""
    if output is not None:
        return RunFolder.create(output_folder(output).path, overwrite=overwrite, argument="--output")
    number = 1
    while os.path.lexists(Path("runs", f"{name}-{number}")):
        number += 1
    return RunFolder.create(Path("runs", f"{name}-{number}"), argument="runs")


def output_folder(path: str) -> RunFolder:
    """Output folder, not made yet."""
    if not path.strip():
        raise InputError("--output", repr(path), "the path of a new folder")
    return RunFolder(path)


def single_thread() -> None:
    """Limit torch to OMP_NUM_THREADS threads, or one."""
    import torch

    asked = os.environ.get("OMP_NUM_THREADS", "")
    torch.set_num_threads(int(asked) if asked.isdecimal() and int(asked) > 0 else 1)


def _stop(folder: RunFolder | None, jobs: int) -> NoReturn:
    """Say what was kept and how to go on."""
    if folder is None or not (folder.path / "run.json").is_file():
        typer.echo("\nInterrupted before anything was begun.")
    else:
        typer.echo(f"\nInterrupted. Finished and kept: {', '.join(folder.finished()) or 'nothing yet'}.")
        asked = [] if jobs == 1 else ["--jobs", str(jobs)]
        typer.echo(f"Continue with: {shlex.join([*program(), 'resume', str(folder.path), *asked])}")
    raise typer.Exit(INTERRUPTED)


def program() -> list[str]:
    """Command of this program, as a shell can call it again."""
    called = sys.argv[0]
    if called.endswith(".py"):
        return [sys.executable, "-m", "ccdtools"]
    found = shutil.which(Path(called).name)
    return [Path(called).name] if found and Path(found).resolve() == Path(called).resolve() else [called]
