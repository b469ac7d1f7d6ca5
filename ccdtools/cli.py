"""Command line of the package."""

from __future__ import annotations

import os
import shlex
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

import ccdtools
from ccdtools.co_design.method_names import as_method_names
from ccdtools.console import one_line_of, plain_where_needed, warnings_on_one_line
from ccdtools.exceptions import InputError
from ccdtools.jobs import as_jobs, held_back, insisting
from ccdtools.studies.command import INTERRUPTED, output_folder, program, resume_run, run_study, single_thread
from ccdtools.studies.options import Options, described_studies, known_studies, located, number, numbers, whole_number
from ccdtools.studies.run_folder import RunFolder
from ccdtools_ground.door import as_choice

if TYPE_CHECKING:
    from ccdtools.co_design.method_comparison import MethodComparison

app = typer.Typer(
    help="Control co-design: a plant's physical parameters and its controller, designed together.",
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
    context_settings={"help_option_names": ["-h", "--help"]},
)


def _print_version(asked: bool) -> None:
    """Print the version and stop, if asked."""
    if asked:
        typer.echo(f"ccdtools {ccdtools.__version__}")
        raise typer.Exit


@app.callback()
def everywhere(
    version: Annotated[
        bool, typer.Option("--version", callback=_print_version, is_eager=True, help="Print the version.")
    ] = False,
) -> None:
    """Control co-design: a plant's physical parameters and its controller, designed together."""


@app.command()
def run(
    study: Annotated[str, typer.Argument(help=f"Which study: {known_studies()} with one.")],
    output: Annotated[str | None, typer.Option(help="Folder of the run. Default: runs/STUDY-1, -2, …")] = None,
    seed: Annotated[str, typer.Option(metavar="INTEGER", help="Seed of every random number.")] = "0",
    generations: Annotated[str, typer.Option(metavar="INTEGER", help="Times to design, deploy and learn.")] = "2",
    quick: Annotated[bool, typer.Option("--quick", help="Same path, fewer samples; a few minutes.")] = False,
    preset: Annotated[str, typer.Option(help="default, or paper: its networks, loss, rates and epochs.")] = "default",
    expert: Annotated[
        str | None, typer.Option(help="Imitated first: auto, lqr (projected on X_fea), mpc, explicit, or a law.")
    ] = None,
    method: Annotated[str | None, typer.Option(help="Of the policy: pathwise, ppo, or pathwise+ppo.")] = None,
    design_gradient: Annotated[str | None, typer.Option(help="pathwise, or network_input (the paper's).")] = None,
    sets: Annotated[str | None, typer.Option(help="X_fea for the expert's data: auto, lqr or none.")] = None,
    sets_time_limit: Annotated[
        str | None, typer.Option(metavar="SECONDS", help="Budget of all sets of the initialisation, as work.")
    ] = None,
    x0: Annotated[str | None, typer.Option(help="Initial state, for example --x0=-3,0")] = None,
    p0: Annotated[str | None, typer.Option(help="Start design, for example --p0=0.8")] = None,
    disturbance: Annotated[
        str | None, typer.Option(help="CSV with the recorded disturbance of the real plant.")
    ] = None,
    column: Annotated[str | None, typer.Option(help="Its column, if it has several.")] = None,
    road: Annotated[str | None, typer.Option(help="CSV with distance [m] and elevation [m]; with --speed.")] = None,
    speed: Annotated[str | None, typer.Option(help="CSV with time [s] and speed [km/h]; with --road.")] = None,
    driver: Annotated[str | None, typer.Option(help="mild or aggressive, when the road is generated.")] = None,
    redesign_price: Annotated[
        str | None, typer.Option(help='Predicted gain that a redesign needs: "0.5 %" (of the return) or "12 return".')
    ] = None,
    redesign_cost: Annotated[
        str | None, typer.Option(help='Cost in its place: "500 EUR, serves 2000, worth 0.3" (EUR a unit of return).')
    ] = None,
    accept_loss: Annotated[
        str | None, typer.Option(help='Loss that a change may bring elsewhere: "0.5 %" (of the return there).')
    ] = None,
    limits: Annotated[
        str | None, typer.Option(help="How far X may be left: mpc (as MPC does), off, or fraction,depth as 0.01,0.05.")
    ] = None,
    filter: Annotated[str | None, typer.Option(help="Behind the deployed policy: none, or admissible.")] = None,
    drift: Annotated[
        str | None,
        typer.Option(
            metavar="SHARE", help="Tell whether the twin still describes the plant, with so many false alarms."
        ),
    ] = None,
    trial: Annotated[
        bool, typer.Option("--trial", help="Updates take turns with the deployed policy on the real plant first.")
    ] = False,
    jobs: Annotated[str, typer.Option(metavar="INTEGER", help="Processes, for comparisons beside the loop.")] = "1",
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace the run in the output folder.")] = False,
) -> None:
    """Run a study: initialise, co-design, deploy, learn, redesign; compare, report.

    Every finished stage is kept in the output folder. Ctrl-C loses only the stage it falls in, and comparisons beside
    it: the run goes on with `ccdtools resume FOLDER`, to the same results.
    """
    options = Options(
        located(study), whole_number("--generations", generations), whole_number("--seed", seed), quick, preset,
        expert, method=method, design_gradient=design_gradient, sets=sets,
        sets_time_limit=number("--sets-time-limit", sets_time_limit, "in seconds, such as 3600 for an hour"),
        x0=numbers("--x0", x0),
        p0=numbers("--p0", p0), disturbance=disturbance, column=column, road=road, speed=speed, driver=driver,
        redesign_price=redesign_price, limits=limits, filter=filter, accept_loss=accept_loss,
        drift=number("--drift", drift, "such as 0.05"), trial=trial, redesign_cost=redesign_cost,
    )  # fmt: skip
    processes = as_jobs(whole_number("--jobs", jobs), "--jobs")
    run_study(options, Path(study).stem, output, overwrite=overwrite, jobs=processes)


@app.command()
def resume(
    folder: Annotated[str, typer.Argument(help="Folder of an interrupted run.")],
    jobs: Annotated[str, typer.Option(metavar="INTEGER", help="Processes, for comparisons beside the loop.")] = "1",
) -> None:
    """Continue an interrupted run; what it had finished is read, not computed again."""
    resume_run(RunFolder(folder), as_jobs(whole_number("--jobs", jobs), "--jobs"))


@app.command()
def sweep(
    file: Annotated[str, typer.Argument(help="TOML file with options of `run`, of which lists are swept.")],
    output: Annotated[str | None, typer.Option(help="Folder of the runs. Default: runs/FILE; it goes on.")] = None,
) -> None:
    """Run a study with every combination of options that a TOML file states.

    Each is a run in a folder of its own; those that are finished are kept. Gains of all stand in sweep.csv.
    """
    from ccdtools.studies.sweep import read_sweep, tidy

    runs = read_sweep(file)
    within = output_folder(output).path if output is not None else Path("runs", Path(file).stem)
    folders = [one.folder(within) for one in runs]
    for place, (one, folder) in enumerate(zip(runs, folders), 1):
        typer.echo(f"\n{one.name}, {place} of {len(runs)}")
        if (folder.path / "report.html").is_file():
            typer.echo("finished before")
        elif (folder.path / "run.json").is_file():
            resume(str(folder.path))
        else:
            run_study(one.options, one.name, str(folder.path), overwrite=False)
    with RunFolder(within).writing("--output"):
        (within / "sweep.csv").write_text(tidy(runs, within), encoding="utf-8")
    typer.echo(f"\nGains of all runs: {within / 'sweep.csv'}")


@app.command()
def codesign(
    study: Annotated[str, typer.Argument(help=f"Which study: {known_studies()} with one.")],
    methods: Annotated[str, typer.Option(help='all, or names with commas: "nested LQR,simultaneous,CMA-ES".')] = "all",
    seed: Annotated[str, typer.Option(metavar="INTEGER", help="Seed of every method.")] = "0",
    x0: Annotated[str | None, typer.Option(help="Initial state, for example --x0=-3,0")] = None,
    p0: Annotated[str | None, typer.Option(help="Design to start from, for example --p0=0.8")] = None,
    jobs: Annotated[str, typer.Option(metavar="INTEGER", help="Processes; -1 for all cores.")] = "1",
    output: Annotated[
        str | None, typer.Option("--output", "--out", help="Folder for table and picture. Default: none is written.")
    ] = None,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace what is in the folder.")] = False,
) -> None:
    """Co-design the model of a study by every method, on common scenarios: one table, and what it says.

    With --output it is kept: methods.csv after every method, methods.png and methods.html at the end. Ctrl-C prints the
    table of the methods that have ended.
    """
    options = Options(located(study), seed=whole_number("--seed", seed), x0=numbers("--x0", x0), p0=numbers("--p0", p0))
    processes = as_jobs(whole_number("--jobs", jobs), "--jobs")
    asked = "all" if methods == "all" else as_method_names(methods.split(","), "--methods")
    folder = None if output is None else output_folder(output)
    if folder is not None:
        folder.check_new(overwrite=overwrite, argument="--output", mark="methods.csv")
    with held_back():
        from ccdtools.studies.asked_study import asked_study
        from ccdtools.studies.loading import blamed_on_source

        own = asked_study(options)[0]
        from ccdtools.co_design.compare_methods import compare_methods
        from ccdtools.studies.report.method_page import write_methods, write_table
    single_thread()
    ended: list[MethodComparison] = []

    def keep(found: MethodComparison) -> None:
        """Print the methods that ended last, and keep the methods compared so far."""
        known = {row.name for row in ended[0]} if ended else set()
        for row, line in zip(found, found.printed.lines):
            if row.name not in known:
                typer.echo("  ".join(line))
        ended[:] = [found]
        if folder is not None:
            write_table(found, folder)

    try:
        with blamed_on_source(options.study), insisting():
            found = compare_methods(
                own.problem(), asked, seed=options.seed, design=own.p0, jobs=processes, progress=True, each=keep
            )
            where = ", on the state of the model" if own.options_taken else ""
            typer.echo(f"{own.title}{where}, seed {options.seed}\n\n{found}")
            if folder is not None:
                typer.echo(f"\nTable and picture: {write_methods(own.title, found, folder)}")
    except KeyboardInterrupt:
        if not ended:
            typer.echo("\nInterrupted. No method has ended.")
        else:
            typer.echo(f"\nInterrupted. The methods that have ended:\n\n{ended[0]}")
        if ended and folder is not None:
            typer.echo(f"\nTheir table: {folder.path / 'methods.csv'}")
        raise


@app.command()
def reproduce(
    output: Annotated[str, typer.Option(help="Folder; one that was begun so goes on.")] = "runs/paper",
    quick: Annotated[bool, typer.Option("--quick", help="Every row with few samples and two seeds.")] = False,
    paper_budgets: Annotated[
        bool, typer.Option("--paper-budgets", help="All 10 000 epochs for the preset paper; hours.")
    ] = False,
    jobs: Annotated[str, typer.Option(metavar="INTEGER", help="Processes; -1 for all cores.")] = "1",
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace what is in the folder.")] = False,
) -> None:
    """Both case studies beside the paper, row by row: a table, a page and figures.

    Every finished stage is kept: after Ctrl-C the same command goes on. The recorded road is taken from the folder
    that CCDTOOLS_DATA names.
    """
    processes = as_jobs(whole_number("--jobs", jobs), "--jobs")
    path = output_folder(output).path
    if quick and paper_budgets:
        raise InputError("--paper-budgets", "it together with --quick", "one of them")
    with held_back():
        from ccdtools.studies.reproduce.budget import Budget, recorded_road
        from ccdtools.studies.reproduce.command import begun, reproduced

        budget = Budget(quick, paper_budgets, recorded_road())
        folder = begun(path, budget, overwrite=overwrite)
    single_thread()
    try:
        with folder.locked("--output"), insisting():
            typer.echo(reproduced(folder, budget, jobs=processes, echo=typer.echo, progress=sys.stderr.isatty()))
    except KeyboardInterrupt:
        typer.echo("\nInterrupted. What was finished is kept: the same command goes on.")
        raise


@app.command()
def export(
    folder: Annotated[str, typer.Argument(help="Folder of a run, or a saved policy.")],
    to: Annotated[str, typer.Option(help="c (C99, header and source) or onnx.")] = "c",
    output: Annotated[str | None, typer.Option(help="Folder for the files. Default: that of the policy.")] = None,
    scalar: Annotated[str, typer.Option(help="Numbers in C: double or float.")] = "double",
) -> None:
    """Write the policy of a run for use outside Python."""
    as_choice("--to", to, ("c", "onnx"))
    path = Path(folder, "policy.safetensors") if Path(folder).is_dir() else Path(folder)
    if not path.is_file():
        raise InputError("folder", folder, "the folder of a run with a policy, or a saved policy")
    from ccdtools.controllers.history import load_policy

    policy = load_policy(path)
    where = path.parent if output is None else Path(output)
    if to == "c":
        report = policy.to_c(where, scalar=scalar)
        typer.echo(f"{' and '.join(map(str, report.files))}\n{report}")
    else:
        try:
            where.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            got = f"{str(where)!r} ({error.strerror})"
            raise InputError("--output", got, "a folder that can be written to") from None
        typer.echo(policy.to_onnx(where / "policy.onnx"))


@app.command()
def new(name: Annotated[str, typer.Argument(help="Name of the study; the file is NAME.py.")]) -> None:
    """Write a commented study file of your own, which runs as it is."""
    from ccdtools.studies.template import write_template

    path = write_template(name)
    typer.echo(f"Wrote {path}. Try it with: {shlex.join([*program(), 'run', str(path), '--quick'])}")


@app.command()
def studies() -> None:
    """List the studies that come with the package."""
    described = described_studies()
    width = max(map(len, described))
    for name, text in described.items():
        typer.echo(f"{name:<{width}}  {text}")


def main() -> None:
    """Entry point; misuse exits with code 2, an interruption with 130."""
    os.environ.setdefault("OMP_NUM_THREADS", "1")  # small matrices: threads of BLAS would only wait for each other
    plain_where_needed()
    code = _run(sys.argv[1:] or ["--help"])
    try:
        sys.stdout.flush()
    except OSError:  # nobody reads the output any more, or its disk is full
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        code = code or 1
    sys.exit(code)


def _run(arguments: list[str]) -> int:
    """Run the command and return the exit code."""
    try:
        with warnings_on_one_line():
            return app(arguments, standalone_mode=False) or 0
    except (KeyboardInterrupt, typer.Abort):
        return INTERRUPTED
    except BrokenPipeError:
        return 1
    except Exception as error:
        line = one_line_of(error)
        if line is None:
            raise
        typer.echo(f"ccdtools: {line}", err=True)
        return 2  # This exit code tells misuse.


if __name__ == "__main__":
    main()
