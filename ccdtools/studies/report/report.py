"""The report of a finished run: tables, figures and one self-contained page."""

from __future__ import annotations

import base64
import json
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np
from jinja2 import Environment, StrictUndefined

from ccdtools.studies.report import plotting
from ccdtools.studies.report.figures import pictures
from ccdtools.studies.report.finished_run import FinishedRun
from ccdtools.studies.report.tables import (
    active_bounds_text,
    design_text,
    difference_text,
    number,
    percentage,
    place,
    verdict,
    with_minus,
    write_tables,
)
from ccdtools.studies.run_folder import RunFolder
from ccdtools.studies.study import Study


def write_report(study: Study, folder: RunFolder) -> Path:
    """Write the tables, the figures and report.html of a finished run; the path of the page.

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
    place = folder.path / "figures"
    place.mkdir(exist_ok=True)
    figures = []
    for picture in pictures(run):
        image = plotting.png(picture.figure)
        (place / f"{picture.name}.png").write_bytes(image)
        figures.append({"name": picture.name, "title": picture.title, "caption": picture.caption,
                        "image": base64.b64encode(image).decode("ascii")})  # fmt: skip
    page = folder.path / "report.html"
    page.write_text(render(run, figures), encoding="utf-8")
    return page


def render(run: FinishedRun, figures: list[dict[str, str]]) -> str:
    """The page, from results.json and the figures (name, title, caption, image in base64)."""
    environment = Environment(autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True)
    environment.filters |= {
        "number": lambda value, digits=4: with_minus(number(value, digits)), "minus": with_minus,
        "percentage": percentage, "duration": _duration,
    }  # fmt: skip
    page = files("ccdtools.studies.report").joinpath("report.html").read_text(encoding="utf-8")
    template = environment.from_string(page)
    results = run.results
    return template.render(
        r=results, study=run.study, designs=_headlines(run), gradients=_gradients(results), blocks=_blocks(results),
        figures={figure["name"]: figure for figure in figures}, signals=_signal_rows(run),
        configuration=json.dumps(results["configuration"], indent=2, ensure_ascii=False),
        single=run.study.real.runs == 1,
    )  # fmt: skip


def _headlines(run: FinishedRun) -> list[dict[str, Any]]:
    """The start and every generation: design, bounds and the returns of the learned policy beside LQR's."""
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
            "bounds": active_bounds_text(own["model", "learned"]["active_bounds"]),
            "nominal": generation.get("nominal_return"), "deployed": generation.get("deployed_return"),
            "updated": generation.get("updated_model_return"),
        })  # fmt: skip
    return rows


def _gradients(results: dict[str, Any]) -> list[dict[str, Any]]:
    """The design gradients of every co-design, with cosine and length beside the finite differences."""
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
            lengths = np.linalg.norm(values), np.linalg.norm(reference)
            product = float(lengths[0] * lengths[1])
            rows.append({
                "label": label, "values": check[name],
                "cosine": float(values @ reference) / product if product else None,
                "length": float(lengths[0] / lengths[1]) if lengths[1] else None,
            })  # fmt: skip
        tables.append({"generation": generation["generation"], "names": check["names"], "rows": rows})
    return tables


def _blocks(results: dict[str, Any]) -> list[dict[str, Any]]:
    """The comparison, a block per generation and plant."""
    blocks: list[dict[str, Any]] = []
    for g, plant in dict.fromkeys((row["generation"], row["plant"]) for row in results["comparison"]):
        rows = [row for row in results["comparison"] if (row["generation"], row["plant"]) == (g, plant)]
        reference = next((row for row in rows if row["controller"] == "LQR"), None)
        verdicts = ["reference" if row is reference else verdict(row, reference) for row in rows]
        blocks.append({
            "generation": g, "plant": place(rows[0]),
            "design": design_text(results, rows[0]["design"]), "bounds": active_bounds_text(rows[0]["active_bounds"]),
            "rows": list(zip(rows, verdicts, (difference_text(row) for row in rows))),
        })  # fmt: skip
    return blocks


def _signal_rows(run: FinishedRun) -> list[tuple[str, float, float]]:
    """States and inputs with their limits."""
    plant, rows = run.study.plant, []
    for names, limits in ((plant.state_names, run.study.X), (plant.input_names, run.study.U)):
        lower, upper = limits.bounding_box()
        rows += [(name, float(low), float(high)) for name, low, high in zip(names, lower, upper)]
    return rows


def _duration(seconds: float) -> str:
    minutes, rest = divmod(seconds, 60)
    return f"{int(minutes)} min {rest:.0f} s" if minutes else f"{rest:.1f} s"
