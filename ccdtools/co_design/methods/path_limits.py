"""Limits along a trajectory, as expressions ≤ 0 and in words."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np

from ccdtools.co_design.problem import CoDesignProblem
from ccdtools.design_limits import DesignLimits
from ccdtools.output_limits import OutputLimits

ROW = re.compile(r"path (\d+)")
PLACE = re.compile(r"( of phase \d+)|( at t = [^,]+)|(, by .*)")
MORE = re.compile(r"and \d+ more ")
GIVEN = ("dynamics", "start of")


@dataclass(frozen=True)
class PathLimit:
    """Limits along a trajectory."""

    values: Callable[[Any, Any, Any], Any]  # each to be ≤ 0
    texts: tuple[str, ...]  # each in words


def path_limits(problem: CoDesignProblem, *, fed_back: bool) -> tuple[PathLimit, ...]:
    """Limits on states, inputs and outputs other than input bounds.

    Limits on inputs are left out if `fed_back`.
    """
    size = problem.design.dim
    found = []
    if isinstance(problem.U, DesignLimits) and not fed_back:
        found.append(_beyond(problem.U, size, lambda x, u: u, input_names(problem)))
    if problem.limit_tolerance == "off":
        return tuple(found)
    names = state_names(problem)
    if isinstance(problem.X, DesignLimits):
        found.append(_beyond(problem.X, size, lambda x, u: x, names))
    else:
        limits = problem.state_rows
        F, g = ca.DM(limits.rows), ca.DM(limits.bounds)
        texts = tuple(_kept(limits.row_text(row, names)) for row in range(len(limits.bounds)))
        found.append(PathLimit(lambda x, u, p: F @ x - g, texts))
    if problem.output_limits is not None:
        found.append(_outputs(problem.output_limits, (problem.model.nx, problem.model.nu, size)))
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
    texts = [text for limit in path_limits(problem, fed_back=fed_back) for text in limit.texts]
    words = [
        ROW.sub(lambda found: texts[int(found[1]) - 1], PLACE.sub("", text))
        for text in conflicts if not MORE.match(text)
    ]  # fmt: skip
    chosen = [word for word in words if not word.startswith(GIVEN)] or words
    return tuple(dict.fromkeys(chosen))


def state_names(problem: CoDesignProblem) -> tuple[str, ...]:
    """Names of the plant's states, else x1, x2, …."""
    return _names(problem, "state_names", "x", problem.model.nx)


def input_names(problem: CoDesignProblem) -> tuple[str, ...]:
    """Names of the plant's inputs, else u1, u2, …."""
    return _names(problem, "input_names", "u", problem.model.nu)


def _names(problem: CoDesignProblem, which: str, letter: str, size: int) -> tuple[str, ...]:
    """Names of the plant, or a letter with numbers."""
    given = getattr(getattr(problem.model, "plant", None), which, None)
    return tuple(given) if given else tuple(f"{letter}{i + 1}" for i in range(size))


def _beyond(limits: DesignLimits, size: int, of: Any, names: tuple[str, ...]) -> PathLimit:
    """Excess over bounds that depend on the design."""
    both = limits.both.function(size)

    def beyond(x: Any, u: Any, p: Any) -> Any:
        """Rows, ≤ 0 where bounds are kept."""
        lower, upper = ca.vertsplit(both(p), limits.dim)
        return ca.vertcat(of(x, u) - upper, lower - of(x, u))

    letter = limits.argument
    texts = [f"{name} ≤ upper {letter}(p)" for name in names] + [f"{name} ≥ lower {letter}(p)" for name in names]
    return PathLimit(beyond, tuple(texts))


def _outputs(limits: OutputLimits, sizes: tuple[int, int, int]) -> PathLimit:
    """Excess over limits of outputs."""
    function = limits.outputs.function(*sizes)
    ny = function.numel_out(0)
    low, high = (np.broadcast_to(bound, (ny,)) for bound in (limits.lower, limits.upper))
    above, below = np.flatnonzero(np.isfinite(high)).tolist(), np.flatnonzero(np.isfinite(low)).tolist()

    def beyond(x: Any, u: Any, p: Any) -> Any:
        """Rows, ≤ 0 where limits are kept."""
        y = function(x, u, p)
        return ca.vertcat(y[above] - ca.DM(high[above]), ca.DM(low[below]) - y[below])

    return PathLimit(beyond, tuple(_kept(limits.row_text(row)) for row in range(len(above) + len(below))))


def _kept(exceeded: str) -> str:
    """Words for keeping a limit, from those for exceeding."""
    return exceeded.replace(" > ", " ≤ ").replace(" < ", " ≥ ")
