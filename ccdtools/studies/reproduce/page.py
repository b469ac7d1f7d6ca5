"""Page, table and figures of a reproduction."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ccdtools import figure_style as style
from ccdtools.pages import page_of, paragraphs, picture_of
from ccdtools.studies.report.finished_run import ReportFigure
from ccdtools.studies.reproduce.budget import CASES, EPOCHS, Budget
from ccdtools.studies.reproduce.figures import drawn_figures
from ccdtools.studies.reproduce.places import SIGMA_WINDOW
from ccdtools.studies.run_folder import RunFolder
from ccdtools.table import Table, csv_text

if TYPE_CHECKING:
    from ccdtools.studies.reproduce.tasks import Task

COLUMNS = {
    "row": "row of the paper", "paper": "paper", "place": "its place", "LQR": "LQR at the paper's design",
    "our policy there": "our policy there", "ours": "ours", "optimum": "optimum", "verdict": "verdict",
    "figure": "figure",
}  # fmt: skip
PRINTED = ("row", "paper", "ours", "optimum", "verdict")


def table_of(rows: Sequence[Mapping[str, Any]], columns: Sequence[str] = tuple(COLUMNS)) -> Table:
    """Table of the rows, all columns or some."""
    return Table(tuple(COLUMNS[name] for name in columns), [tuple(row[name] for name in columns) for row in rows])


def written(rows: Sequence[Mapping[str, Any]], tasks: Sequence[Task], folder: RunFolder, budget: Budget) -> Path:
    """Path of the page, written with rows.csv and its figures."""
    loops, presets = (
        {case: [t for t in tasks if (t.case, t.kind) == (case, kind)] for case in CASES} for kind in ("loop", "paper")
    )
    figures = drawn_figures(loops, presets, quick=budget.quick)
    folder.write_text("rows.csv", csv_text(rows))
    return folder.write_text("paper.html", page(rows, [(one, _kept(one, folder)) for one in figures], budget))


def _kept(figure: ReportFigure, folder: RunFolder) -> bytes:
    image = style.png(figure.figure)
    folder.write_bytes(f"figures/{figure.name}.png", image)
    return image


def page(rows: Sequence[Mapping[str, Any]], figures: Sequence[tuple[ReportFigure, bytes]], budget: Budget) -> str:
    """HTML of the tables and figures."""
    tables = "".join(
        f"<h2>{escape(case.capitalize())}</h2><div>{table_of([r for r in rows if r['case'] == case]).html}</div>"
        for case in CASES
    )
    images = "".join(
        f"<h3 id='{one.name}'>{one.title}</h3><p>{escape(one.caption)}</p>{picture_of(image, one.caption)}"
        for one, image in figures
    )
    return page_of(
        "Both case studies beside the paper", f"{paragraphs(notes_of(budget))}{tables}<h2>Figures</h2>{images}"
    )


def notes_of(budget: Budget) -> list[str]:
    """What a reader of the table has to know."""
    epochs = "all 10 000 epochs" if budget.paper else f"{8 if budget.quick else EPOCHS} of its 10 000 epochs"
    window = f"samples {SIGMA_WINDOW.start} to {SIGMA_WINDOW.stop}"
    road = "the recorded road" if budget.road else "a generated road, as the recorded one is not at hand"
    return [
        *(["QUICK: few samples, not for conclusions."] if budget.quick else []),
        f"{budget.seeds} seeds, {budget.runs} rollouts; in brackets 95 % intervals over seeds and runs. The preset "
        f"paper has {epochs}. The suspension is deployed on {road}. σ_ss is of {window}.",
        "Generation 2 is what the rule of decision deploys; on the updated model stands what the second co-design "
        "proposes. The optimum is that of a dynamic program, or the best saturated LQR of a grid of designs; of RMSE "
        "and pinball loss it is the floor, or of the suspension what linear prediction of the road leaves.",
    ]
