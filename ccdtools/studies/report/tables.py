"""Tables of a run: CSV files, and text for the console."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from ccdtools.evidence.percent import number, share
from ccdtools.studies.names import SOURCES
from ccdtools.studies.report.formatting import (
    active_bounds_text,
    design_text,
    generation_name,
    holding_text,
    limits_of,
    place,
)
from ccdtools.studies.report.gains import console_lines
from ccdtools.studies.report.verdicts import difference_text, limit_notes, on_same_runs, reference_of, saw_fewer_runs
from ccdtools.studies.run_folder import RunFolder
from ccdtools.table import Table, csv_text

Row = dict[str, Any]
OUTSIDE = "outside X"
HEADINGS = (
    "plant", "gen", "controller", "mean", "std", "n", "vs LQR", "95 % interval", "diverged", OUTSIDE, "depth",
    "µs/step",
)  # fmt: skip
NUMBERS = frozenset(range(len(HEADINGS))) - {0, 2}  # columns; the others hold words
LIMIT_COLUMNS = ("violations", "depth_mean", "depth_peak", "depth_worst", "exceeded")


def write_tables(results: Mapping[str, Any], folder: RunFolder) -> list[Path]:
    """Write the CSV tables of a run and return their paths."""
    tables = {
        "held_out.csv": comparison_rows(results, "held_out"),
        "gains.csv": source_rows(results),
        "comparison.csv": comparison_rows(results),
        "generations.csv": generation_rows(results),
        "learning_curves.csv": learning_rows(results, folder),
    }
    return [folder.write_text(name, csv_text(rows)) for name, rows in tables.items()]


def source_rows(results: Mapping[str, Any]) -> list[Row]:
    """Rows of the gains, one per place and source."""
    rows = []
    for where in results["gains"]:
        own = _run_columns(results) | {name: where[name] for name in ("place", "runs", "steps", "left_out")}
        for source in (*SOURCES[1:], "total"):
            low, high = where[source]["ci95"]
            gain = {"source": source, "gain": where[source]["mean"], "low95": low, "high95": high}
            rows.append(own | gain | {"lqr_at_start": where["start"]})
    return rows


def comparison_rows(results: Mapping[str, Any], table: str = "comparison") -> list[Row]:
    """Rows of the comparison; `table` is "comparison" or "held_out".

    Means of fewer runs than LQR's are left out: that of the return is `lqr_mean_on_these_runs` + `paired_to_lqr`.
    """
    rows = results[table]
    return [
        _run_columns(results)
        | {name: row[name] for name in ("plant", "model", "generation", "controller")}
        | _design_columns(results, row)
        | _summary_columns("", row)
        | {
            "median": row["median"],
            "paired_to_lqr": row["paired_to_lqr"]["mean"],
            "lqr_mean_on_these_runs": row["lqr_mean"],
        }
        | dict(zip(("paired_low95", "paired_high95"), row["paired_to_lqr"]["ci95"]))
        | {name: row[name] for name in ("diverged", *LIMIT_COLUMNS)}
        | {"further_outside_than": ", ".join(row["further_outside_than"]), "step_time_us": row["step_time_us"]}
        | dict(row.get("metrics", {}))
        for row in (on_same_runs(row, reference_of(rows, row)) for row in rows)
    ]


def generation_rows(results: Mapping[str, Any]) -> list[Row]:
    """Rows of the generations: design, returns, quantiles per state."""
    rows = []
    for generation in results["generations"]:
        row = _run_columns(results) | {"generation": generation["generation"]} | _design_columns(results, generation)
        row["model"] = generation["model"]
        for name in ("model_return", "nominal_return", "predicted_return", "deployed_return"):
            row |= _summary_columns(f"{name}_", generation[name])
        for noise, summary in generation["updated_model_return"].items():
            row[f"updated_model_return_{noise}_mean"] = summary["mean"]
        delivery = generation["delivery"]
        row |= {"verdict": delivery["status"], "agreement": delivery["agreement"], "account": generation["account"]}
        row |= {"change": delivery["change"]["mean"]}
        row |= dict(zip(("change_low95", "change_high95"), delivery["change"]["ci95"]))
        row |= {f"deployed_{name}": value for name, value in generation["deployed_design"].items()}
        updates = generation["online_updates"]
        row["deployed_diverged"] = generation["deployed_diverged"]
        row["online_updates"] = len(updates)
        row["online_updates_accepted"] = sum(update["accepted"] for update in updates)
        scores = generation["quantiles"]
        for name in ("rmse", "nominal_rmse", "pinball", "constant_pinball", "coverage"):
            row |= {f"{name}_{i + 1}": value for i, value in enumerate(scores[name])}
        row |= _free_running_columns(generation["free_running"])
        rows.append(row)
    return rows


def _free_running_columns(bands: Mapping[str, Any] | None) -> Row:
    return {
        f"free_running_{name}_{step}_{i + 1}": value
        for name in ("coverage", "spread") if bands is not None
        for step, values in zip(bands["steps"], bands[name])
        for i, value in enumerate(values)
    }  # fmt: skip


def learning_rows(results: Mapping[str, Any], folder: RunFolder) -> list[Row]:
    """Rows of the evaluations of every co-design."""
    rows = []
    names = results["design_space"]["names"]
    for generation in results["generations"]:
        g = generation["generation"]
        arrays = folder.read_stage(f"codesign-{g}").arrays
        for k in range(len(arrays["history_iteration"])):
            values = {name: arrays[f"history_{name}"][k] for name in ("model_return", "std", "diverged")}
            rows.append(
                _run_columns(results)
                | {"generation": g, "measured_on": place(generation)}
                | {name: int(arrays[f"history_{name}"][k]) for name in ("iteration", "env_steps")}
                | dict(zip(names, arrays["history_design"][k].tolist()))
                | {name: float(value) for name, value in values.items()}
            )
    return rows


def console_table(results: Mapping[str, Any]) -> str:
    """Comparison as aligned plain text, a block per generation."""
    rows = results["comparison"]
    headings = tuple(f"outside {limits_of(results)}" if name == OUTSIDE else name for name in HEADINGS)
    table = Table(headings, [_cells(row, rows) for row in rows], right=NUMBERS)
    head, *texts = table.aligned()
    quick = ["QUICK: fewer samples, not a result"] if results["quick"] else []
    rule = "-" * (sum(table.widths) + 2 * (len(headings) - 1))
    lines = [f"{results['title']}, seed {results['seed']}", *quick, head, rule]
    title = ""
    for row, text in zip(rows, texts):
        if _block_title(results, row) != title:
            title = _block_title(results, row)
            lines.append(title)
        lines.append(text)
    notes = [*fewer_runs_notes(rows), *limit_notes(rows, limits_of(results)), results.get("linearisation", "")]
    return "\n".join([*lines, *filter(None, notes), "", *console_lines(results)])


def fewer_runs_notes(rows: Sequence[Mapping[str, Any]]) -> list[str]:
    """Notes on controllers with fewer runs than LQR, or with remarks."""
    notes: dict[tuple[str, int], list[str]] = {}
    for row in rows:
        reference = reference_of(rows, row)
        if reference is not None and saw_fewer_runs(row, reference):
            runs = f"first {row['n']} of {reference['n']} runs"
            text = f"{place(row)}, {runs}, mean {number(row['mean'])}, of LQR on these {number(row['lqr_mean'])}"
            notes.setdefault((row["controller"], row["generation"]), []).append(text)
    remarks = dict.fromkeys(f"{row['controller']}: {row['remark']}" for row in rows if row.get("remark"))
    return [f"* {name}, {generation_name(g)}: {'; '.join(texts)}" for (name, g), texts in notes.items()] + [*remarks]


def metric_table(rows: Sequence[Mapping[str, Any]]) -> dict[str, Any] | None:
    """Metric names and values per controller of a block; None without metrics."""
    names = list(dict.fromkeys(name for row in rows for name in row.get("metrics", {})))
    if not names:
        return None
    reference = reference_of(rows, rows[0])
    lines = [
        {"controller": row["controller"], "star": saw_fewer_runs(row, reference),
         "values": [on_same_runs(row, reference).get("metrics", {}).get(name) for name in names]}
        for row in rows
    ]  # fmt: skip
    return {"names": names, "lines": lines}


def held_out_metrics(results: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Metric tables of every held-out disturbance and design, with titles."""
    blocks = dict.fromkeys((row["model"], row["generation"]) for row in results["held_out"])
    tables = []
    for model, generation in blocks:
        rows = [row for row in results["held_out"] if (row["model"], row["generation"]) == (model, generation)]
        table = metric_table(rows)
        if table is not None:
            tables.append({"title": f"{model}, {generation_name(generation)}", **table})
    return tables


def _block_title(results: Mapping[str, Any], row: Mapping[str, Any]) -> str:
    bounds = holding_text(row)
    return f"{generation_name(row['generation'])}: {design_text(results, row['design'])}; active bounds: {bounds}"


def _cells(row: Mapping[str, Any], rows: Sequence[Mapping[str, Any]]) -> tuple[str, ...]:
    """Cells of one row; a star marks fewer runs than LQR's."""
    mean, interval = difference_text(row)
    apart = row["controller"] == "LQR" or bool(row.get("remark"))
    reference = reference_of(rows, row)
    star = " *" if saw_fewer_runs(row, reference) else ""
    shown = on_same_runs(row, reference)
    return (
        place(row), str(row["generation"]), row["controller"] + star, number(shown["mean"]), number(shown["std"], 3),
        str(row["n"]), "-" if apart else mean, "-" if apart else interval, share(row["diverged"]),
        share(row["violations"]), number(row["depth_peak"], 2), number(row["step_time_us"], 3),
    )  # fmt: skip


def _run_columns(results: Mapping[str, Any]) -> Row:
    return {"study": results["study"], "seed": results["seed"], "mode": "QUICK" if results["quick"] else "full"}


def _design_columns(results: Mapping[str, Any], row: Mapping[str, Any]) -> Row:
    return {name: row["design"][name] for name in results["design_space"]["names"]} | {
        "active_bounds": active_bounds_text(row["active_bounds"])
    }


def _summary_columns(prefix: str, summary: Mapping[str, Any]) -> Row:
    low, high = summary["ci95"]
    values = {name: summary[name] for name in ("mean", "std", "n")}
    return {f"{prefix}{name}": value for name, value in (values | {"low95": low, "high95": high}).items()}
