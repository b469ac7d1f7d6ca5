"""The table of a gallery run, in Markdown, and the rows of what had to be reached."""

from __future__ import annotations

import json
from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING, Any

from gallery.measure import Measured, measured
from gallery.reference import LIMITED, reference

if TYPE_CHECKING:
    from gallery.run import Run

Row = tuple["Run", Measured, dict[str, Any]]  # with the note of how it ended

NEAR = 0.5  # % below the optimum that count as reached
WORTH = 2.0  # % that knowing the truth must bring before a generation has to be better


def markdown(runs: Iterable[Run]) -> str:
    """The table of all finished runs, a line for every one that is not, and the summary."""
    finished: list[Row] = []
    broken: list[str] = []
    for run in runs:
        note = run.folder.with_suffix(".json")
        if not note.is_file():
            continue
        ended = json.loads(note.read_text())
        if ended["exit"] == 0:
            finished.append((run, measured(run.study, run.folder), ended))
        else:
            broken.append(f"- {run.study}, seed {run.seed}, from the {run.start}: exit {ended['exit']}")
    return table_of(finished, broken)


def table_of(finished: Sequence[Row], broken: Sequence[str] = ()) -> str:
    """The table of runs that have been measured, those that broke, and the summary."""
    if not finished:
        return "\n".join(["Nothing has finished.", *broken])
    parts = [_rows(finished), "\n".join(broken), "\n".join(f"- {line}" for line in summary(finished))]
    return "\n\n".join(part for part in parts if part)


def _rows(finished: Sequence[Row]) -> str:
    """One line per run."""
    head = ["study", "start", "seed", "first design", "below the optimum", "status", "designed; deployed, generation "
            "after generation", "learned", "outside X, deepest (MPC)", "time", "memory"]  # fmt: skip
    lines = ["| " + " | ".join(head) + " |", "|" + "---|" * len(head)]
    for run, found, ended in sorted(finished, key=lambda row: (row[0].study, row[0].start != "study", row[0].seed)):
        design = ", ".join(f"{name} {value:.4g}" for name, value in found.design.items())
        valley = f" (valley {found.valley + 1})" if found.valley else ""
        mpc = f" ({found.mpc_depth:.3f})" if found.mpc_depth == found.mpc_depth else ""
        cells = [
            run.study, run.start, str(run.seed), design + valley,
            f"{found.shortfall:+.2f} ± {2 * found.shortfall_error:.2f} %", found.status, _deployed(found),
            _learned(found), f"{found.depth:.3f}{mpc}", f"{ended['seconds']:.0f} s", _memory(ended["peak_bytes"]),
        ]  # fmt: skip
        lines.append("| " + " | ".join(cells) + " |")
    return "\n".join(lines)


def _memory(peak: int) -> str:
    """Peak memory; a dash where the run was not a process of its own."""
    return f"{peak / 2**20:.0f} MiB" if peak else "–"


def _deployed(found: Measured) -> str:
    """The deployed returns, each with its verdict against the one before."""
    texts = [f"{value:.4g}" for value in found.deployed[:1]]
    for value, step in zip(found.deployed[1:], found.steps):
        mark = {"worse": " ▼", "better": " ▲", "equal": ""}[step.verdict]
        texts.append(f"{value:.4g}{mark}{'' if step.kept else ' (rolled back)'}")
    designed = f"{found.designed:.4g}; " if found.designed == found.designed else ""
    return designed + " → ".join(texts) or "–"


def _learned(found: Measured) -> str:
    """What was gained on the real plant since the first co-design as designed, with its verdict."""
    if found.learned is None:
        return "–"
    mark = {"worse": " ▼", "better": " ▲", "equal": ""}[found.learned.verdict]
    return f"{found.learned_percent:+.2f} %{mark}"


def summary(finished: Sequence[Row]) -> list[str]:
    """What had to be reached, and in how many runs it was."""
    near = [found.shortfall - 2 * found.shortfall_error <= NEAR for _, found, _ in finished]
    missed = [f"{run.study} from the {run.start}, seed {run.seed}: {found.shortfall:.2f} %, “{found.status}”"
              + (", the best valley is named" if found.names_best and found.valley else "")
              for (run, found, _), reached in zip(finished, near) if not reached]  # fmt: skip
    lines = [f"first co-design within {NEAR} % of the independent optimum: {sum(near)} of {len(near)}"]
    lines += [f"not: {text}" for text in missed]
    steps = [(run, number + 2, step) for run, found, _ in finished for number, step in enumerate(found.steps)]
    worse = [entry for entry in steps if entry[2].verdict == "worse"]
    lines.append(f"deployed and worse beyond the interval than what was deployed before: {len(worse)} of {len(steps)}")
    lines += [
        f"worse: {run.study} from the {run.start}, seed {run.seed}, generation {number}: {step.difference:+.3g} "
        f"[{step.low:.3g}, {step.high:.3g}]{'' if step.kept else ', rolled back'}"
        for run, number, step in worse
    ]
    ends = [(run, found.at_the_end) for run, found, _ in finished if found.steps and found.at_the_end is not None]
    lost = [entry for entry in ends if entry[1].verdict == "worse"]
    lines.append(f"deployed at the end and worse beyond the interval than generation 1: {len(lost)} of {len(ends)}")
    lines += [f"worse at the end: {run.study} from the {run.start}, seed {run.seed}: {step.difference:+.3g}"
              for run, step in lost]  # fmt: skip
    lines += _where_truth_pays(finished)
    limited = [(run, found) for run, found, _ in finished if run.study in LIMITED]
    lines += [
        f"{run.study} from the {run.start}, seed {run.seed}: deepest outside X {found.depth:.3f} half-widths, MPC "
        f"{found.mpc_depth:.3f}; return {found.beside_mpc:+.2f} % of MPC's"
        for run, found in limited
    ]
    return lines


def _where_truth_pays(finished: Sequence[Row]) -> list[str]:
    """How often what is deployed at the end is better than what was first designed, where knowing the truth pays."""
    lines = []
    for study in sorted({run.study for run, _, _ in finished}):
        worth = reference(study).get("truth", {}).get("worth_percent", 0.0)
        rows = [found for run, found, _ in finished if run.study == study and found.learned is not None]
        if worth < WORTH or not rows:
            continue
        gains = [found.learned_percent for found in rows]
        better = sum(found.learned is not None and found.learned.verdict == "better" for found in rows)
        lines.append(
            f"{study}, where knowing the real plant is worth {worth:.1f} %: better in {better} of {len(rows)} runs, "
            f"by {min(gains):.1f} to {max(gains):.1f} % from what was first designed to what is deployed at the end"
        )
    return lines
