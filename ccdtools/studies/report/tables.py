"""The tables of a run: CSV files, and plain text for the console."""

from __future__ import annotations

import csv
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from ccdtools.studies.run_folder import RunFolder

Row = dict[str, Any]
NOT_WORSE = 0.005  # a controller is not worse than LQR if its interval lies above −0.5 % of |LQR|
NEGLIGIBLE = 1e-4  # per cent: below it, two returns are the same up to solver tolerances
HEADINGS = (
    "plant", "gen", "controller", "mean", "std", "n", "vs LQR", "95 % interval", "diverged", "outside X", "µs/step",
)  # fmt: skip


def write_tables(results: Mapping[str, Any], folder: RunFolder) -> list[Path]:
    """Write comparison.csv, generations.csv and learning_curves.csv; their paths."""
    tables = {
        "comparison.csv": comparison_rows(results),
        "generations.csv": generation_rows(results),
        "learning_curves.csv": learning_rows(results, folder),
    }
    return [_write(folder.path / name, rows) for name, rows in tables.items()]


def comparison_rows(results: Mapping[str, Any]) -> list[Row]:
    """One row per plant, generation and controller."""
    return [
        _run_columns(results)
        | {name: row[name] for name in ("plant", "model", "generation", "controller")}
        | _design_columns(results, row)
        | _summary_columns("", row)
        | {"median": row["median"], "paired_to_lqr": row["paired_to_lqr"]["mean"]}
        | dict(zip(("paired_low95", "paired_high95"), row["paired_to_lqr"]["ci95"]))
        | {name: row[name] for name in ("diverged", "violations", "step_time_us")}
        for row in results["comparison"]
    ]


def generation_rows(results: Mapping[str, Any]) -> list[Row]:
    """One row per generation: its design, its returns, its quantiles per state."""
    rows = []
    for generation in results["generations"]:
        row = _run_columns(results) | {"generation": generation["generation"]} | _design_columns(results, generation)
        row["model"] = generation["model"]
        for name in ("model_return", "nominal_return", "deployed_return"):
            row |= _summary_columns(f"{name}_", generation[name])
        for noise, summary in generation["updated_model_return"].items():
            row[f"updated_model_return_{noise}_mean"] = summary["mean"]
        updates = generation["online_updates"]
        row["deployed_diverged"] = generation["deployed_diverged"]
        row["online_updates"], row["online_updates_accepted"] = len(updates), sum(u["accepted"] for u in updates)
        scores = generation["quantiles"]
        for name in ("rmse", "nominal_rmse", "pinball", "constant_pinball", "coverage"):
            row |= {f"{name}_{i + 1}": value for i, value in enumerate(scores[name])}
        rows.append(row)
    return rows


def learning_rows(results: Mapping[str, Any], folder: RunFolder) -> list[Row]:
    """One row per evaluation of every co-design."""
    rows = []
    names = results["design_space"]["names"]
    for generation in results["generations"]:
        g = generation["generation"]
        arrays = folder.read_stage(f"codesign-{g}").arrays
        for k in range(len(arrays["history_iteration"])):
            values = {name: arrays[f"history_{name}"][k] for name in ("model_return", "std", "diverged")}
            rows.append(
                _run_columns(results)
                | {"generation": g, "measured_on": measured_on(generation)}
                | {name: int(arrays[f"history_{name}"][k]) for name in ("iteration", "env_steps")}
                | dict(zip(names, arrays["history_design"][k].tolist()))
                | {name: float(value) for name, value in values.items()}
            )
    return rows


def console_table(results: Mapping[str, Any]) -> str:
    """The comparison as aligned plain text, a block per generation and plant; the active bounds are named."""
    blocks: list[list[Sequence[str]]] = []
    titles: list[str] = []
    for generation, plant in dict.fromkeys((row["generation"], row["plant"]) for row in results["comparison"]):
        rows = [row for row in results["comparison"] if (row["generation"], row["plant"]) == (generation, plant)]
        titles.append(_block_title(results, rows[0]))
        blocks.append([_cells(row) for row in rows])
    everything = [HEADINGS, *(cells for block in blocks for cells in block)]
    widths = [max(len(cells[i]) for cells in everything) for i in range(len(HEADINGS))]
    quick = "QUICK: fewer samples, not a result\n" if results["quick"] else ""
    head = f"{results['title']}, seed {results['seed']}\n{quick}{_line(HEADINGS, widths)}\n{'-' * (sum(widths) + 18)}"
    last: Any = None
    lines = [head]
    for title, block in zip(titles, blocks):
        lines += [title] * (title != last) + [_line(cells, widths) for cells in block]
        last = title
    return "\n".join(lines)


def active_bounds_text(active: Mapping[str, str]) -> str:
    """Active design bounds as a phrase: "k_s lower, c_s upper", or "none"."""
    return ", ".join(f"{name} {side}" for name, side in active.items()) or "none"


def place(row: Mapping[str, Any]) -> str:
    """Where a comparison row was measured."""
    return {"nominal": "nominal model", "real": "real plant"}.get(row["model"], row["model"])


def measured_on(generation: Mapping[str, Any]) -> str:
    """What the returns of a co-design's learning curve were measured on."""
    return "nominal model" if generation["model"] == "nominal" else "replayed errors"


def design_text(results: Mapping[str, Any], design: Mapping[str, float]) -> str:
    """A design with its units."""
    units = dict(zip(results["design_space"]["names"], results["design_space"]["units"]))
    return ", ".join(
        f"{name} = {value:.6g}{'' if units[name] == '-' else ' ' + units[name]}" for name, value in design.items()
    )


def difference_text(row: Mapping[str, Any]) -> tuple[str, str]:
    """The paired difference of a comparison row and its interval as text; rounding errors of equal runs are zero."""
    if any(value is None for value in (row["paired_to_lqr"]["mean"], *row["paired_to_lqr"]["ci95"])):
        return number(row["paired_to_lqr"]["mean"], 3), "n/a"
    size = NEGLIGIBLE / 100 * abs(row["mean"] or 0.0)
    mean, low, high = (
        number(value if abs(value) >= size else 0.0, 3)
        for value in (row["paired_to_lqr"]["mean"], *row["paired_to_lqr"]["ci95"])
    )
    return mean, f"[{low}, {high}]"


def percent_of_reference(row: Mapping[str, Any], reference: Mapping[str, Any] | None) -> tuple[float, ...] | None:
    """Paired difference of a comparison row and its interval in per cent of |LQR|; None where there is none."""
    paired = (row["paired_to_lqr"]["mean"], *row["paired_to_lqr"]["ci95"])
    if reference is None or not reference["mean"] or any(value is None for value in paired):
        return None
    return tuple(100 * value / abs(reference["mean"]) for value in paired)


def verdict(row: Mapping[str, Any], reference: Mapping[str, Any] | None) -> str:
    """Return "better", "not worse", "worse" or "open", as the interval of the paired difference to LQR says."""
    percent = percent_of_reference(row, reference)
    if percent is None:
        return "no pairs"
    _, low, high = percent
    if low > 0:
        return "better"
    if low > -100 * NOT_WORSE:
        return "not worse"
    return "worse" if high < 0 else "open"


def number(value: float | None, digits: int = 4) -> str:
    """A number to so many significant digits, without exponent where that can be read; "n/a" for nothing."""
    if value is None:
        return "n/a"
    if value != 0 and not 1e-3 <= abs(value) < 1e6:
        return f"{value:.{digits - 1}e}"
    shown = float(f"{value:.{digits}g}")
    if shown == 0:
        return "0"
    decimals = max(0, digits - 1 - _exponent(shown))
    return f"{shown:.{decimals}f}"


def percentage(fraction: float | None) -> str:
    """A fraction in per cent; "n/a" for nothing."""
    if fraction is None:
        return "n/a"
    return f"{100 * fraction:.3g} %"


def _exponent(value: float) -> int:
    return int(f"{value:e}".split("e")[1])


def _block_title(results: Mapping[str, Any], row: Mapping[str, Any]) -> str:
    stage = "start" if row["generation"] == 0 else f"generation {row['generation']}"
    bounds = active_bounds_text(row["active_bounds"])
    return f"{stage}: {design_text(results, row['design'])}; active bounds: {bounds}"


def _cells(row: Mapping[str, Any]) -> list[str]:
    mean, interval = difference_text(row)
    plant = place(row)
    reference = row["controller"] == "LQR"
    return [
        plant, str(row["generation"]), row["controller"], number(row["mean"]), number(row["std"], 3), str(row["n"]),
        "-" if reference else mean,
        "-" if reference else interval,
        percentage(row["diverged"]), percentage(row["violations"]), number(row["step_time_us"], 3),
    ]  # fmt: skip


def _line(cells: Sequence[str], widths: Sequence[int]) -> str:
    left = {0, 2}
    aligned = (c.ljust(w) if i in left else c.rjust(w) for i, (c, w) in enumerate(zip(cells, widths)))
    return "  ".join(aligned).rstrip()


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


def _write(path: Path, rows: Sequence[Row]) -> Path:
    names = list(dict.fromkeys(name for row in rows for name in row))
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, names)
        writer.writeheader()
        writer.writerows(rows)
    return path


def with_minus(text: str) -> str:
    """`text` with the minus sign of a printed page."""
    return text.replace("-", "−")
