"""The command line: ``ccdtools run STUDY``, ``ccdtools resume FOLDER``, ``ccdtools studies``."""

from __future__ import annotations

import os
import re
import shlex
import shutil
import signal
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, NoReturn

import typer

from ccdtools.exceptions import CCDError, InputError

if TYPE_CHECKING:
    from ccdtools.studies import RunFolder, Study, StudyConfig

app = typer.Typer(
    help="Control co-design: a plant's physical parameters and its controller, designed together.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
)


_OPTION_NAMES = re.compile(r"^(x0|p0|driver|design_gradient|disturbance)(\b)")


@dataclass(frozen=True)
class Options:
    """What a run was asked for; kept in run.json, so that `resume` needs the folder alone."""

    study: str
    generations: int
    seed: int
    quick: bool
    preset: str
    expert: str
    design_gradient: str | None
    x0: list[float] | None
    p0: list[float] | None
    disturbance: str | None
    column: str | None
    road: str | None
    speed: str | None
    driver: str | None


@app.command()
def run(
    study: Annotated[str, typer.Argument(help="Name of a study (see `ccdtools studies`), or a Python file with one.")],
    output: Annotated[Path | None, typer.Option(help="Folder of the run. Default: runs/STUDY-1, -2, …")] = None,
    seed: Annotated[int, typer.Option(help="Seed of every random number.")] = 0,
    generations: Annotated[int, typer.Option(help="Times to design, deploy and learn.")] = 2,
    quick: Annotated[bool, typer.Option("--quick", help="Same path, fewer samples; under a minute.")] = False,
    preset: Annotated[str, typer.Option(help="default, or paper: its networks, loss, rates and epochs.")] = "default",
    expert: Annotated[str, typer.Option(help="Who is cloned: lqr (projected on X_fea), mpc, explicit.")] = "lqr",
    design_gradient: Annotated[str | None, typer.Option(help="pathwise, or network_input (the paper's).")] = None,
    x0: Annotated[str | None, typer.Option(help="Initial state, for example --x0=-3,0")] = None,
    p0: Annotated[str | None, typer.Option(help="Start design, for example --p0=0.8")] = None,
    disturbance: Annotated[
        str | None, typer.Option(help="CSV with the recorded disturbance of the real plant.")
    ] = None,
    column: Annotated[str | None, typer.Option(help="Its column, if it has several.")] = None,
    road: Annotated[str | None, typer.Option(help="CSV with distance [m] and elevation [m]; with --speed.")] = None,
    speed: Annotated[str | None, typer.Option(help="CSV with time [s] and speed [km/h]; with --road.")] = None,
    driver: Annotated[str | None, typer.Option(help="mild or aggressive, when the road is generated.")] = None,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace the run in the output folder.")] = False,
) -> None:
    """Run a study: initialise, co-design, deploy, learn, redesign; compare, report."""
    options = Options(
        _located(study), generations, seed, quick, preset, expert, design_gradient, _numbers(x0, "--x0"),
        _numbers(p0, "--p0"), disturbance, column, road, speed, driver,
    )  # fmt: skip
    folder = None
    try:
        with _undisturbed():
            declared = _with_disturbance(_study(options), options)
            _check(declared, options)
            folder = _new_folder(output, Path(study).stem, overwrite)
            folder.write_json("run.json", vars(options))
            _keep_recording(folder, declared)
        _complete(folder, declared, options)
    except KeyboardInterrupt:
        _stop(folder)


@app.command()
def resume(folder: Annotated[Path, typer.Argument(help="Folder of an interrupted run.")]) -> None:
    """Continue an interrupted run; what it had finished is read, not computed again."""
    kept = None
    try:
        with _undisturbed():
            from ccdtools.studies import RunFolder

            kept = RunFolder(folder)
            options = _kept_options(kept)
            study = _study(options)
            if options.driver is not None:
                study = _with_disturbance(study, options)
            study = _with_kept_recording(kept, study)
            _check(study, options)
        _complete(kept, study, options)
    except KeyboardInterrupt:
        _stop(kept)


@app.command()
def studies() -> None:
    """List the studies that come with the package."""
    from ccdtools.studies import load_study, study_names

    for name in study_names():
        typer.echo(f"{name:<16}{load_study(name).title}")


def main() -> None:
    """Entry point: bad input is one line and exit code 2, an interruption is exit code 130."""
    os.environ.setdefault("OMP_NUM_THREADS", "1")  # small matrices: threads of BLAS would only wait for each other
    try:
        app()
    except Exception as error:
        if not isinstance(error, _errors_of_ours()):
            raise
        typer.echo(f"ccdtools: {_OPTION_NAMES.sub(_as_typed, str(error))}", err=True)
        sys.exit(2)


def _errors_of_ours() -> tuple[type[Exception], ...]:
    from invariant_sets import InvariantSetsError
    from learning import LearningError
    from mpc import MPCError

    return CCDError, LearningError, MPCError, InvariantSetsError


def _as_typed(found: re.Match[str]) -> str:
    return "--" + found.group(1).replace("_", "-") + found.group(2)


@contextmanager
def _undisturbed() -> Iterator[None]:
    """Hold Ctrl-C back: an import or a folder interrupted half-way could not be continued."""
    caught: list[int] = []
    before = signal.signal(signal.SIGINT, lambda number, frame: caught.append(number))
    try:
        import ccdtools.studies.report.report  # noqa: F401  (everything that is slow to import)

        yield
    finally:
        signal.signal(signal.SIGINT, before)
    if caught:
        raise KeyboardInterrupt


def _stop(folder: RunFolder | None) -> NoReturn:
    """Say what was kept and how to go on."""
    if folder is None:
        typer.echo("\nInterrupted before anything was begun.")
    else:
        typer.echo(f"\nInterrupted. Finished and kept: {', '.join(folder.finished()) or 'nothing yet'}.")
        typer.echo(f"Continue with: {shlex.join([*_program(), 'resume', str(folder.path)])}")
    sys.exit(130)


def _program() -> list[str]:
    """How this program was called, as a shell can call it again."""
    called = sys.argv[0]
    if called.endswith(".py"):
        return [sys.executable, "-m", "ccdtools.cli"]
    found = shutil.which(Path(called).name)
    return [Path(called).name] if found and Path(found).resolve() == Path(called).resolve() else [called]


def _complete(folder: RunFolder, study: Study, options: Options) -> None:
    """Run what is not finished yet, and report."""
    from ccdtools.studies import Generations
    from ccdtools.studies.report.report import write_report
    from ccdtools.studies.report.tables import console_table

    quick = " (QUICK: few samples, not for conclusions)" if options.quick else ""
    typer.echo(f"{study.title}, seed {options.seed}{quick} → {folder.path}")
    start = time.perf_counter()
    _single_thread()
    loop = Generations(
        study, _configuration(study, options), folder, generations=options.generations, seed=options.seed,
        say=typer.echo, progress=sys.stderr.isatty(),
    )  # fmt: skip
    results = loop.run()
    typer.echo("Figures and report")
    report = write_report(study, folder)
    typer.echo("\n" + console_table(results))
    typer.echo(f"\nReport, after {time.perf_counter() - start:.0f} s: {report}")


def _configuration(study: Study, options: Options) -> StudyConfig:
    from ccdtools.studies import configuration

    return configuration(
        study, preset=options.preset, quick=options.quick, expert=options.expert,
        design_gradient=options.design_gradient,
    )  # fmt: skip


def _kept_options(folder: RunFolder) -> Options:
    kept = folder.read_json("run.json")
    if not isinstance(kept, dict) or set(kept) != set(Options.__dataclass_fields__):
        raise InputError(f"folder: got {folder.path} with a run.json of another kind, expected one of this version.")
    return Options(**kept)


def _study(options: Options) -> Study:
    """The study as the options change it."""
    import numpy as np

    from ccdtools.studies import load_study

    study = load_study(options.study)
    x0, p0 = (None if v is None else np.array(v) for v in (options.x0, options.p0))
    return study.started(x0=x0, p0=p0)


def _with_disturbance(study: Study, options: Options) -> Study:
    from dataclasses import replace

    from ccdtools.disturbances.disturbance import Recorded
    from ccdtools.disturbances.recordings import read_disturbance, read_road, read_speed
    from ccdtools.disturbances.roads import GeneratedRoad, road_disturbance

    given = [name for name in ("disturbance", "road", "driver") if getattr(options, name) is not None]
    if len(given) > 1:
        raise InputError(f"--{given[1]}: got it together with --{given[0]}, expected one source of the disturbance.")
    if (options.road is None) != (options.speed is None):
        alone, missing = ("--road", "--speed") if options.speed is None else ("--speed", "--road")
        raise InputError(f"{alone}: got it without {missing}, expected both: elevation over distance, speed over time.")
    if options.column is not None and options.disturbance is None:
        raise InputError("--column: got it without --disturbance, expected the file it is a column of.")
    source: Any = None
    dt = study.plant.dt
    if options.disturbance is not None:
        source = Recorded(read_disturbance(options.disturbance, dt=dt, column=options.column, argument="--disturbance"))
    elif options.road is not None and options.speed is not None:
        source = Recorded(
            road_disturbance(
                *read_road(options.road, argument="--road"), *read_speed(options.speed, argument="--speed"), dt=dt
            )
        )
    elif options.driver is not None:
        source = GeneratedRoad(options.driver, dt)  # type: ignore[arg-type]
    if source is None:
        return study
    if study.real.plant.nw != 1:
        raise InputError(
            f"--{given[0]}: got one disturbance, expected {study.real.plant.nw}, which {study.name} has; "
            "it can be given only to a study with one."
        )
    return replace(study, real=replace(study.real, disturbance=source))


def _check(study: Study, options: Options) -> None:
    """All that can be told of the input without running it, before a folder is made."""
    from ccdtools.studies.evaluation import Evaluation
    from ccdtools.studies.generations import check_counts

    check_counts(options.generations, options.seed)
    evaluation = Evaluation(study, _configuration(study, options), options.seed)
    evaluation.check_recording()


def _new_folder(output: Path | None, name: str, overwrite: bool) -> RunFolder:
    from ccdtools.studies import RunFolder

    if output is not None:
        return RunFolder.create(output, overwrite=overwrite)
    number = 1
    while Path("runs", f"{name}-{number}").exists():
        number += 1
    return RunFolder.create(Path("runs", f"{name}-{number}"))


def _keep_recording(folder: RunFolder, study: Study) -> None:
    """Keep a recorded disturbance with the run: its file may be gone when the run is resumed."""
    import numpy as np

    from ccdtools.disturbances.disturbance import Recorded

    if isinstance(study.real.disturbance, Recorded):
        np.save(folder.path / "disturbance.npy", study.real.disturbance.signal)


def _with_kept_recording(folder: RunFolder, study: Study) -> Study:
    from dataclasses import replace

    import numpy as np

    from ccdtools.disturbances.disturbance import Recorded

    kept = folder.path / "disturbance.npy"
    if not kept.is_file():
        return study
    return replace(study, real=replace(study.real, disturbance=Recorded(np.load(kept, allow_pickle=False))))


def _located(study: str) -> str:
    """The study's name, or the absolute path of its file: a run may be resumed from elsewhere."""
    return str(Path(study).resolve()) if study.endswith(".py") else study


def _numbers(text: str | None, argument: str) -> list[float] | None:
    if text is None:
        return None
    try:
        return [float(part) for part in text.split(",")]
    except ValueError:
        raise InputError(f"{argument}: got {text!r}, expected numbers separated by commas.") from None


def _single_thread() -> None:
    """The same for torch."""
    import torch

    asked = os.environ.get("OMP_NUM_THREADS", "")
    torch.set_num_threads(int(asked) if asked.isdecimal() and int(asked) > 0 else 1)


if __name__ == "__main__":
    main()
