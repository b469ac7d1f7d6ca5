"""Tables of a study's metrics."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from ccdtools.studies.report.formatting import generation_name
from ccdtools.studies.report.verdicts import on_same_runs, reference_of, saw_fewer_runs

Values = Mapping[str, Any]


def metric_table(rows: Sequence[Values]) -> dict[str, Any] | None:
    """Metric names and values per controller of a block; None without metrics."""
    names = list(dict.fromkeys(name for row in rows for name in metrics_in(row)))
    if not names:
        return None
    reference = reference_of(rows, rows[0])
    lines = [
        {"controller": row["controller"], "star": saw_fewer_runs(row, reference),
         "values": [metrics_in(on_same_runs(row, reference)).get(name) for name in names]}
        for row in rows
    ]  # fmt: skip
    return {"names": names, "lines": lines}


def held_out_metrics(results: Values) -> list[dict[str, Any]]:
    """Metric tables of every held-out disturbance and design, with titles."""
    blocks = dict.fromkeys((row["model"], row["generation"]) for row in results["held_out"])
    tables = []
    for model, generation in blocks:
        rows = [row for row in results["held_out"] if (row["model"], row["generation"]) == (model, generation)]
        table = metric_table(rows)
        if table is not None:
            tables.append({"title": f"{model}, {generation_name(generation)}", **table})
    return tables


def metrics_in(row: Values) -> Values:
    """Metrics in a row; empty in runs of versions without metrics."""
    found: Values = row.get("metrics", {})
    return found
