"""Report of a finished run."""

from __future__ import annotations

import base64
import json
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np
from jinja2 import Environment, StrictUndefined

from ccdtools import figure_style as style
from ccdtools.arrays import Array
from ccdtools.co_design.risk import Mean, measure
from ccdtools.design_limits import DesignLimits, limits_at
from ccdtools.evidence.percent import number, share, with_minus
from ccdtools.plants.sampling_guard import sampling_note
from ccdtools.studies.budgets import SET_SECONDS
from ccdtools.studies.report.finished_run import FinishedRun, ReportFigure
from ccdtools.studies.report.formatting import (
    capitalised,
    design_text,
    duration,
    generation_name,
    holding_text,
    limits_of,
    place,
)
from ccdtools.studies.report.gains import gain_headings, gain_rows, held_out_rows, service_table
from ccdtools.studies.report.landscape import landscape
from ccdtools.studies.report.return_figures import changes, comparison, history
from ccdtools.studies.report.set_figure import feasible_set_figure
from ccdtools.studies.report.signal_figures import policy_surface, quantiles, trajectories
from ccdtools.studies.report.summary import decided, in_first_place, next_steps
from ccdtools.studies.report.tables import fewer_runs_notes, held_out_metrics, metric_table, write_tables
from ccdtools.studies.report.verdicts import (
    difference_text,
    limit_notes,
    on_same_runs,
    reference_of,
    saw_fewer_runs,
    verdict,
)
from ccdtools.studies.run_folder import RunFolder
from ccdtools.studies.study import Study

FIGURES = (changes, history, landscape, comparison, feasible_set_figure, policy_surface, trajectories, quantiles)


def write_report(study: Study, folder: RunFolder) -> Path:
    """Write the tables, figures and report.html; return the page's path.

    Parameters
    ----------
    study : Study
        The one that was run.
    folder : RunFolder
        With results.json and every stage.

    Raises
    ------
    InputError
        If the folder holds no results.
    """
    run = FinishedRun(study, folder, folder.read_json("results.json"))
    write_tables(run.results, folder)
    shown = []
    for make in FIGURES:
        with style.styled():
            made = make(run)
        shown += [_kept_figure(figure, folder) for figure in made]
    return folder.write_text("report.html", render(run, shown))


def _kept_figure(figure: ReportFigure, folder: RunFolder) -> dict[str, str]:
    image = style.png(figure.figure)
    folder.write_bytes(f"figures/{figure.name}.png", image)
    texts = {"name": figure.name, "title": figure.title, "caption": figure.caption}
    return texts | {"image": base64.b64encode(image).decode("ascii")}


def render(run: FinishedRun, shown: list[dict[str, str]]) -> str:
    """Page from results.json and the figures (name, title, caption, base64 image)."""
    environment = Environment(autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True)
    environment.filters |= {
        "number": lambda value, digits=4: with_minus(number(value, digits)), "minus": with_minus, "share": share,
        "duration": duration, "generation": generation_name,
        "design": lambda design: design_text(run.results, design),
        "capitalize_first": capitalised,
    }  # fmt: skip
    page = files("ccdtools.studies.report").joinpath("report.html").read_text(encoding="utf-8")
    results = run.results
    return environment.from_string(page).render(
        r=results, study=run.study, designs=_cards(run), gradients=_gradients(results), blocks=_blocks(results),
        figures={figure["name"]: figure for figure in shown}, signals=_signal_rows(run), kept=_kept_by_designs(run),
        weights=_weight_rows(run), configuration=json.dumps(results["configuration"], indent=2, ensure_ascii=False),
        gains={"headings": gain_headings(results), "rows": gain_rows(results), "service": service_table(results),
               "held_out": held_out_rows(results, run.study.steps), "metrics": held_out_metrics(results),
               "notes": fewer_runs_notes(results["held_out"])},
        glance=in_first_place(results), next_steps=next_steps(results), decided=list(decided(results)),
        sampling=sampling_note(run.study.plant), no_sets=_no_sets(run),
        limits=limits_of(results), single=run.study.real.runs == 1, real_is_model=run.study.real_is_model,
        risk="" if isinstance(run.problem.risk, Mean) else measure(run.problem.risk),
        measure=measure(run.study.judged_in),
        updates=[sum(u["accepted"] for u in g["online_updates"]) for g in results["generations"]],
    )  # fmt: skip


def _no_sets(run: FinishedRun) -> str:
    option = run.results["configuration"]["sets"]
    if option != "auto":
        return f'the run was asked for sets = "{option}"'
    return f"none was found within {SET_SECONDS:g} s a design"


def _cards(run: FinishedRun) -> list[dict[str, Any]]:
    results = run.results
    generations: list[dict[str, Any]] = [{"generation": 0, "design": results["start"]}, *results["generations"]]
    rows = []
    for generation in generations:
        g = generation["generation"]
        own = {(row["plant"], row["controller"]): row for row in results["comparison"] if row["generation"] == g}
        scores = {
            plant: {"learned": own[plant, "learned"], "lqr": own[plant, "LQR"],
                    "verdict": verdict(own[plant, "learned"], own[plant, "LQR"]),
                "place": place(own[plant, "learned"])}
            for plant in ("model", "real")
        }  # fmt: skip
        rows.append({
            "generation": g, "design": design_text(results, generation["design"]), "scores": scores,
            "bounds": holding_text(own["model", "learned"]),
            "nominal": generation.get("nominal_return"), "deployed": generation.get("deployed_return"),
            "updated": generation.get("updated_model_return"),
        })  # fmt: skip
    return rows


def _gradients(results: dict[str, Any]) -> list[dict[str, Any]]:
    """Design gradients of every co-design, relative to finite differences."""
    labels = {
        "finite_difference": "finite differences", "pathwise": "pathwise", "network_input": "network input (paper)",
    }  # fmt: skip
    tables = []
    for generation in results["generations"]:
        check = generation["gradient_check"]
        if check is None:
            continue
        reference = np.array(check["finite_difference"], dtype=float)
        rows = []
        for name, label in labels.items():
            values = np.array(check[name], dtype=float)
            if np.isfinite(values).all():
                size, whole = np.linalg.norm(values), np.linalg.norm(reference)
                errors = check.get(f"{name}_error") or [None] * len(check["names"])
                rows.append({"label": label, "values": values.tolist(), "errors": errors,
                             "cosine": _ratio(values @ reference, size * whole),
                             "length": _ratio(size, whole)})  # fmt: skip
        tables.append({"generation": generation["generation"], "names": check["names"], "rows": rows})
    return tables


def _ratio(value: Any, size: Any) -> float | None:
    return float(value / size) if size > 0 and np.isfinite(value) else None


def _blocks(results: dict[str, Any]) -> list[dict[str, Any]]:
    blocks: list[dict[str, Any]] = []
    for g, plant in dict.fromkeys((row["generation"], row["plant"]) for row in results["comparison"]):
        rows = [row for row in results["comparison"] if (row["generation"], row["plant"]) == (g, plant)]
        reference = reference_of(rows, rows[0])
        shown = []
        for row in rows:
            gain, ends = difference_text(row)
            word = "reference" if row is reference else verdict(row, reference)
            shown.append({"row": on_same_runs(row, reference), "verdict": word, "gain": gain, "ends": ends,
                          "star": saw_fewer_runs(row, reference)})  # fmt: skip
        blocks.append({
            "generation": g, "plant": place(rows[0]), "design": design_text(results, rows[0]["design"]),
            "bounds": holding_text(rows[0]), "rows": shown,
            "metrics": metric_table(rows), "notes": fewer_runs_notes(rows) + limit_notes(rows, limits_of(results)),
        })  # fmt: skip
    return blocks


def _signal_rows(run: FinishedRun) -> list[tuple[str, float, float]]:
    """Limits of states, inputs, outputs and parameters at the final design; NaN if none."""
    plant = run.study.plant
    space = run.problem.design
    boxes = [(names, *limits_at(limits, run.designs[-1]).bounding_box())
             for names, limits in ((plant.state_names, run.study.X), (plant.input_names, run.study.U))]  # fmt: skip
    limited = run.problem.output_limits
    if limited is not None:
        lower, upper = (np.where(np.isfinite(bound), bound, np.nan) for bound in (limited.lower, limited.upper))
        boxes.append((limited.names, lower, upper))
    named = [f"design {name}" for name in space.labels]
    rows = [(name, float(low), float(high)) for box in (*boxes, (named, space.lower, space.upper))
            for name, low, high in zip(*box)]  # fmt: skip
    return [row for row in rows if np.isfinite(row[1:]).any()]


def _weight_rows(run: FinishedRun) -> list[tuple[str, str]]:
    plant = run.study.plant
    weights = run.study.weights
    described = run.study.objective.describe()
    rows = [(name, text) for name, text in described.items() if isinstance(text, str)]
    where = "" if "Q" in described else " of LQR and MPC at the first design"
    for symbol, weight, names in (("Q", weights.Q, plant.state_names), ("R", weights.R, plant.input_names)):
        diagonal = np.diag(weight)
        if np.array_equal(weight, np.diag(diagonal)):
            entries = ", ".join(f"{name}: {with_minus(number(value))}" for name, value in zip(names, diagonal))
            rows.append((f"{symbol}, diagonal{where}", entries))
        else:
            rows.append((f"{symbol}{where}", _matrix_text(weight)))
    if weights.S is not None:
        rows.append((f"S{where}", _matrix_text(weights.S)))
    return rows


def _matrix_text(matrix: Array) -> str:
    text = "; ".join(", ".join(with_minus(number(value)) for value in line) for line in matrix)
    return f"[{text}]"


def _kept_by_designs(run: FinishedRun) -> list[str]:
    """Phrases for what a design keeps besides its bounds, and for limits that depend on it."""
    space = run.problem.design
    kept = {"Constraints of the design, each to be ≤ 0": space.constraint_names, "Whole numbers": space.integer}
    said = [f"{what}: {', '.join(names)}" for what, names in kept.items() if names]
    named = [f"{limits.argument}(p) = {limits}" for limits in (run.study.X, run.study.U)
             if isinstance(limits, DesignLimits)]  # fmt: skip
    moving = f"Limits that depend on the design, those of the final one above: {'; '.join(named)}"
    return [*said, moving] if named else said
