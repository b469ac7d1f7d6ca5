"""Reproduction in a folder, which goes on where it was stopped."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict
from importlib.metadata import version
from operator import methodcaller
from pathlib import Path

from ccdtools.exceptions import InputError
from ccdtools.jobs import as_they_end
from ccdtools.studies.reproduce.budget import Budget
from ccdtools.studies.reproduce.page import PRINTED, notes_of, table_of, written
from ccdtools.studies.reproduce.rows import filled_rows
from ccdtools.studies.reproduce.tasks import all_tasks
from ccdtools.studies.run_folder import RunFolder


def begun(path: Path, budget: Budget, *, overwrite: bool = False) -> RunFolder:
    """Folder of a reproduction: a new one, or that of the same budget, to go on.

    Raises
    ------
    InputError
        If the folder holds something else, or a reproduction with another budget.
    """
    contents = {"reproduce": asdict(budget), "ccdtools": version("ccdtools")}
    folder = RunFolder(path)
    if not overwrite and (path / "run.json").is_file():
        if folder.read_json("run.json") != contents:
            got = f"{path}, begun as something else"
            raise InputError("--output", got, "the folder of the same reproduction", "Choose another, or --overwrite.")
        return folder
    folder = RunFolder.create(path, overwrite=overwrite, argument="--output")
    folder.write_json("run.json", contents)
    return folder


def reproduced(folder: RunFolder, budget: Budget, *, jobs: int, echo: Callable[[str], None], progress: bool) -> str:
    """Table of a reproduction and the path of its page.

    What was not finished yet is computed first.
    """
    if not budget.road:
        echo("No recorded road in the folder that CCDTOOLS_DATA names: the suspension drives on a generated one")
    tasks = all_tasks(folder.path, budget)
    names = [task.name for task in tasks] if progress else ()
    for name in as_they_end(methodcaller("run"), tasks, jobs=jobs, label="tasks", names=names, progress=progress):
        echo(f"{name} is finished")
    rows = filled_rows(tasks, budget)
    path = written(rows, tasks, folder, budget)
    notes = "\n".join(notes_of(budget))
    return "\n".join([*table_of(rows, PRINTED).aligned(), "", notes, "", f"Page, rows.csv and figures: {path}"])
