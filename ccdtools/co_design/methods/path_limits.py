"""Limits along a trajectory, as expressions ≤ 0 and in words."""

from __future__ import annotations

import re
from typing import Any

from ccdtools.co_design.problem import CoDesignProblem
from ccdtools.design_limits import DesignLimits
from ccdtools.output_limits import OutputLimits, limits_of

ROW = re.compile(r"path (\d+)")
PLACE = re.compile(r"( of phase \d+)|( at t = [^,]+)|(, by .*)")
MORE = re.compile(r"and \d+ more ")
GIVEN = ("dynamics", "start of")


def path_limits(problem: CoDesignProblem, *, fed_back: bool) -> tuple[OutputLimits, ...]:
    """Limits on states, inputs and outputs other than input bounds.

    Limits on inputs are left out if `fed_back`.
    """
    found = []
    if isinstance(problem.U, DesignLimits) and not fed_back:
        found.append(limits_of(problem.U, problem.input_names))
    if problem.limit_tolerance == "off":
        return tuple(found)
    found.append(problem.state_rows)
    if problem.output_limits is not None:
        found.append(problem.output_limits)
    return tuple(found)


def told(problem: CoDesignProblem, solution: Any, *, fed_back: bool = False) -> tuple[str, ...]:
    """Notes on a trajectory solution that is not optimal."""
    if solution.solved:
        return ()
    broken = in_words(problem, solution.conflicts, fed_back=fed_back)
    of_limits = (f"not kept together: {', '.join(broken)}",) if broken else ()
    return (*of_limits, *([] if solution.status.name == "INFEASIBLE" else [solution.status.advice]))


def in_words(problem: CoDesignProblem, conflicts: tuple[str, ...], *, fed_back: bool) -> tuple[str, ...]:
    """Contradictions in the problem's names, each limit once.

    Dynamics and starts are named where nothing else is: they are given.
    """
    sizes = (problem.model.nx, problem.model.nu, problem.design.dim)
    texts = [
        limit.row_text(row).replace(" > ", " ≤ ").replace(" < ", " ≥ ")
        for limit in path_limits(problem, fed_back=fed_back)
        for row in range(limit.scaled.function(*sizes).numel_out(0))
    ]
    words = [
        ROW.sub(lambda found: texts[int(found[1]) - 1], PLACE.sub("", text))
        for text in conflicts if not MORE.match(text)
    ]  # fmt: skip
    chosen = [word for word in words if not word.startswith(GIVEN)] or words
    return tuple(dict.fromkeys(chosen))
