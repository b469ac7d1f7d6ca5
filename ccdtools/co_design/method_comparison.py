"""Every way to co-design on one problem, in one table: what each found, what that brings in closed loop, and why."""

from __future__ import annotations

import csv
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from ccdtools.arrays import Array, Immutable
from ccdtools.checks import as_count, as_flag, as_instance, shown, writable_path
from ccdtools.co_design.agents import as_agent
from ccdtools.co_design.closed_loop import closed_loop_returns
from ccdtools.co_design.codesign import METHODS, Method, as_method, codesign
from ccdtools.co_design.configuration import METHODS as LEARNING
from ccdtools.co_design.design_controllers import saturated_lqr
from ccdtools.co_design.method_verdicts import method_verdicts, signed
from ccdtools.co_design.methods.learned import Learned
from ccdtools.co_design.methods.nested import NAMES as INNER
from ccdtools.co_design.methods.nested import Nested
from ccdtools.co_design.methods.search import LIBRARIES, Search
from ccdtools.co_design.methods.sequential import Sequential
from ccdtools.co_design.methods.simultaneous import UNKNOWNS, Simultaneous
from ccdtools.co_design.problem import CoDesignProblem
from ccdtools.co_design.result import ClosedLoopReturns, CoDesignResult
from ccdtools.co_design.status import CoDesignStatus
from ccdtools.exceptions import CCDError, InputError
from ccdtools.jobs import as_jobs, in_processes
from ccdtools.statistics import PairedDifference, paired_difference
from invariant_sets import InvariantSetsError
from learning.exceptions import LearningError
from learning.networks import ActorCritic
from mpc import MPCError

ALL = (
    "sequential", "nested Riccati", "nested LQR", "nested MPC", "nested trajectory", "simultaneous",
    "simultaneous gain", "CMA-ES", "Bayesian search", "pathwise",
)  # fmt: skip
REFERENCE = "nested LQR"
REFUSALS = (CCDError, MPCError, LearningError, InvariantSetsError)
UNSOUND = (CoDesignStatus.DIVERGING, CoDesignStatus.INFEASIBLE, CoDesignStatus.LIMITS_BROKEN)
HEAD = (
    "method", "design", "return", "95 % interval", "lost", "difference", "own objective", "evals", "time", "status",
    "held by",
)  # fmt: skip
MORE_LOST = 1e-3  # of the runs: a method that loses so many more than the one that loses fewest is not the best


@dataclass(frozen=True, eq=False, repr=False, kw_only=True)
class MethodRow(Immutable):
    """What one method came to.

    Attributes
    ----------
    name : str
    result : CoDesignResult or None
        None of a method that refused.
    refused : str
        Why; empty of one that did not.
    difference : PairedDifference or None
        Of its closed-loop return to that of the reference, on the scenarios that both were measured on and where
        neither run is lost.
    from_design, from_control : PairedDifference or None
        The parts of it that are made by its design, as saturated LQR has them at both, and by its controller, beside
        saturated LQR of the same design; None where there is no LQR.
    runs : int
        Scenarios of the differences.
    violation : float
        Of the constraints g(p) ≤ 0 at its design, as `DesignSpace.violation` has it; 0 where there are none.
    """

    name: str
    result: CoDesignResult | None = None
    refused: str = ""
    difference: PairedDifference | None = None
    from_design: PairedDifference | None = None
    from_control: PairedDifference | None = None
    runs: int = 0
    violation: float = 0.0

    def __repr__(self) -> str:
        return f"MethodRow({self.name}: {f'refused: {self.refused}' if self.refused else repr(self.result)})"

    @property
    def closed_loop(self) -> ClosedLoopReturns:
        """What was measured; only of a method that did not refuse."""
        assert self.result is not None
        assert self.result.closed_loop is not None
        return self.result.closed_loop

    @property
    def sound(self) -> bool:
        """Whether it found something, and its own account is not of lost runs, or of limits that are not kept."""
        return self.result is not None and self.result.status not in UNSOUND


@dataclass(frozen=True, eq=False, repr=False, kw_only=True)
class MethodComparison(Immutable):
    """The methods on one problem: a table with one row per method, and what it says.

    It is iterated like a list of `MethodRow`, and indexed by number or by the name of a method.

    Attributes
    ----------
    rows : tuple of MethodRow
    reference : str
        The method that differences are to.
    size : float
        How large the reference's return is without the cost of its design: what per cent are of.
    problem : CoDesignProblem
    seed : int
    """

    rows: tuple[MethodRow, ...]
    reference: str
    size: float
    problem: CoDesignProblem
    seed: int

    def __iter__(self) -> Iterator[MethodRow]:
        return iter(self.rows)

    def __len__(self) -> int:
        return len(self.rows)

    def __getitem__(self, key: int | str) -> MethodRow:
        if isinstance(key, int):
            return self.rows[key]
        for row in self.rows:
            if row.name == key:
                return row
        raise KeyError(f"{key!r}; the methods are {', '.join(row.name for row in self.rows)}")

    def __repr__(self) -> str:
        return f"MethodComparison({', '.join(row.name for row in self.rows)}; reference {self.reference})"

    @property
    def best(self) -> MethodRow:
        """The method of the highest return on common scenarios, of those that keep the limits and lose no more runs."""
        found = [row for row in self.rows if row.result is not None]
        if not found:
            raise InputError("methods", "none that did not refuse", "a method that can treat this problem")
        sound = [row for row in found if row.sound] or found
        fewest = min(row.closed_loop.lost_share for row in sound)
        kept = [row for row in sound if row.closed_loop.lost_share <= fewest + MORE_LOST]
        return max(kept, key=lambda row: -np.inf if row.difference is None else row.difference.mean)

    @property
    def verdict(self) -> list[str]:
        """What the table says, one sentence or two a line: which methods are equal, which one wins, and why."""
        return method_verdicts(self)

    def percent(self, difference: float) -> float:
        """A difference in per cent of `size`."""
        return 100 * difference / self.size

    def table(self) -> list[dict[str, Any]]:
        """One dictionary of plain values per method, the same keys in each; NaN or "" where there is nothing."""
        return [self._cells(row) for row in self.rows]

    def to_csv(self, path: str | Path) -> Path:
        """Write the table as a CSV file; its path."""
        target = writable_path("path", path)
        rows = self.table()
        with target.open("w", newline="", encoding="utf-8") as file:
            writer = csv.DictWriter(file, list(rows[0]))
            writer.writeheader()
            writer.writerows(rows)
        return target

    def plot(self) -> Any:
        """A matplotlib figure: return against time, and the designs on the landscape of saturated LQR.

        Of more than two parameters the designs are shown in parts of their ranges.
        """
        from ccdtools.co_design.method_plots import plot_methods

        return plot_methods(self)

    def _cells(self, row: MethodRow) -> dict[str, Any]:
        """The values of a row."""
        space = self.problem.design
        found = row.result
        nothing = (np.nan, np.nan)
        loop = None if found is None else row.closed_loop
        mean, ends, runs = (np.nan, nothing, 0) if loop is None else _summary(loop)
        gap = row.difference
        low, high = nothing if gap is None else gap.ci95
        parts = [np.nan if part is None else self.percent(part.mean) for part in (row.from_design, row.from_control)]
        design = np.full(space.dim, np.nan) if found is None else found.design
        return {
            "method": row.name, **{name: float(value) for name, value in zip(space.names, design)},
            "return": mean, "return_low95": ends[0], "return_high95": ends[1], "runs": runs,
            "lost": np.nan if loop is None else loop.lost_share,
            "outside": np.nan if loop is None else loop.outside, "depth": np.nan if loop is None else loop.depth,
            "difference": np.nan if gap is None else gap.mean, "difference_low95": low, "difference_high95": high,
            "difference_percent": np.nan if gap is None else self.percent(gap.mean), "common_runs": row.runs,
            "from_design_percent": parts[0], "from_control_percent": parts[1],
            "objective": np.nan if found is None else found.objective,
            "criterion": "" if found is None else found.criterion,
            "evaluations": 0 if found is None else found.evaluations,
            "seconds": np.nan if found is None else found.seconds,
            "status": "refused" if found is None else found.status.name,
            "held_by": "" if found is None else held(found),
            "violation": np.nan if found is None else row.violation, "refused": row.refused,
        }  # fmt: skip

    def __str__(self) -> str:
        """The table in aligned columns, and below it what it says."""
        head = self._head
        lines = [head, *(self._texts(row) for row in self.rows)]
        widths = [max(len(line[i]) for line in lines if len(line) > 2) for i in range(len(head))]
        right = {2, 4, 6, 7, 8}
        text = []
        for line in lines:
            if len(line) == 2:
                text.append(f"{line[0]:<{widths[0]}}  {line[1]}")
                continue
            cells = (f"{cell:>{wide}}" if i in right else f"{cell:<{wide}}"
                     for i, (cell, wide) in enumerate(zip(line, widths)))  # fmt: skip
            text.append("  ".join(cells).rstrip())
        return "\n".join([*text, "", *self.verdict])

    def markdown(self) -> str:
        """The printed table for a page in Markdown."""
        head, *rows = self.cells()
        return "\n".join(f"| {' | '.join(line)} |" for line in [head, ("---",) * len(head), *rows])

    def cells(self) -> list[tuple[str, ...]]:
        """The cells of the printed table as text, its head first."""
        texts = [self._texts(row) for row in self.rows]
        blank = ("",) * (len(HEAD) - 2)
        return [self._head, *(line if len(line) == len(HEAD) else (*line, *blank) for line in texts)]

    @property
    def _head(self) -> tuple[str, ...]:
        """The head of the printed table."""
        return (*HEAD[:5], f"to {self.reference}", *HEAD[6:])

    def _texts(self, row: MethodRow) -> tuple[str, ...]:
        """The cells of a printed row; two of a method that refused."""
        if row.result is None:
            return row.name, f"refused: {row.refused}"
        found = row.result
        mean, (low, high), _ = _summary(row.closed_loop)
        lost = row.closed_loop.lost_share
        return (
            row.name, self.problem.design.describe(found.design), f"{mean:.5g}", f"[{low:.5g}, {high:.5g}]",
            f"{lost:.2%}" if lost else "0", self.difference_text(row), f"{found.objective:.5g}",
            str(found.evaluations), f"{found.seconds:.3g} s", found.status.name.lower().replace("_", " "),
            held(found) or "–",
        )  # fmt: skip

    def difference_text(self, row: MethodRow) -> str:
        """The difference of a row to the reference in per cent, with its interval."""
        if row.name == self.reference:
            return "reference"
        if row.difference is None:
            return "no pairs"
        mean, *ends = (self.percent(value) for value in (row.difference.mean, *row.difference.ci95))
        return f"{signed(mean)} % [{signed(ends[0])}, {signed(ends[1])}]"


def compare_methods(
    problem: CoDesignProblem,
    methods: str | Sequence[str] | Mapping[str, str | Method] = "all",
    *,
    seed: int = 0,
    design: ArrayLike | None = None,
    reference: str | None = None,
    agent: ActorCritic | None = None,
    jobs: int = 1,
    progress: bool = False,
) -> MethodComparison:
    """The methods of `codesign` on one problem, measured on the same scenarios.

    Parameters
    ----------
    problem : CoDesignProblem
    methods : "all", sequence of str, or mapping of str to str or Method
        Names of methods ("nested LQR", "simultaneous gain", "CMA-ES", "ppo", …); or methods with settings of their own
        by names of yours. "all": sequential; nested Riccati, LQR, MPC and trajectory; simultaneous and simultaneous
        gain; CMA-ES and Bayesian search; pathwise.
    seed : int
        Of every method: each has a generator of its own with this seed.
    design : (np,) array_like, optional
        First design of every method; by default the feasible one nearest to the centre of the box.
    reference : str, optional
        The method that differences are to: by default "nested LQR", or the first where it is not among them.
    agent : ActorCritic, optional
        Warm start of the methods that learn; by default each makes its own.
    jobs : int
        Processes; −1 for all cores. Times are longer where processes share a core.
    progress : bool
        Show a progress bar.

    Returns
    -------
    MethodComparison
        A method that refuses is a row that says why.

    Raises
    ------
    InputError
        If an argument is of the wrong kind, a method is unknown or `design` is not feasible.
    """
    as_instance("problem", problem, CoDesignProblem, "a CoDesignProblem")
    as_count("seed", seed, least=0)
    as_flag("progress", progress)
    chosen = named_methods(methods, as_agent(agent))
    if reference is None:
        reference = REFERENCE if REFERENCE in chosen else next(iter(chosen))
    elif reference not in chosen:
        raise InputError("reference", shown(reference), f"one of {', '.join(chosen)}")
    first = None if design is None else problem.design.check_feasible(design)
    run = partial(_run, problem, seed, first, progress and jobs == 1)
    ends = in_processes(run, list(chosen.values()), jobs=as_jobs(jobs), label="methods", progress=progress)
    results = {name: end for name, end in zip(chosen, ends) if isinstance(end, CoDesignResult)}
    if reference not in results and results:
        reference = next(iter(results))
    pairs = None if not results else _Pairs(problem, seed, results[reference])
    rows = []
    for name, end in zip(chosen, ends):
        if isinstance(end, str) or pairs is None:
            rows.append(MethodRow(name=name, refused=str(end)))
        else:
            rows.append(pairs.row(name, end))
    size = np.nan if pairs is None else pairs.size
    return MethodComparison(rows=tuple(rows), reference=reference, size=size, problem=problem, seed=seed)


def named_methods(methods: Any, agent: ActorCritic | None = None) -> dict[str, Method]:
    """Methods by name, as `compare_methods` takes them.

    Raises
    ------
    InputError
        If there is none of a name, none at all, or one twice.
    """
    if isinstance(methods, Mapping):
        if not all(isinstance(name, str) and name for name in methods):
            raise InputError("methods", shown(methods), "a mapping of names to methods")
        chosen = {name: _named(one, agent) if isinstance(one, str) else as_method(one) for name, one in methods.items()}
    else:
        names = ALL if methods == "all" else (methods,) if isinstance(methods, str) else methods
        if not isinstance(names, list | tuple) or not all(isinstance(name, str) for name in names):
            raise InputError("methods", shown(methods), '"all", a list of names, or a mapping of names to methods')
        found = [_named(name, agent) for name in names]
        chosen = {method.name: method for method in found}
        if len(chosen) < len(found):
            raise InputError("methods", shown(list(names)), "every method once", "Name them in a mapping.")
    if not chosen:
        raise InputError("methods", "none", "at least one method")
    return chosen


def known_methods() -> dict[str, Method]:
    """Every method that has a name, with its usual settings."""
    searches = [Search(library) for library in LIBRARIES]
    programs = [Simultaneous(unknowns) for unknowns in UNKNOWNS]
    learners = [Learned(by=by) for by in LEARNING]
    every: list[Any] = [Sequential(), *(Nested(inner) for inner in INNER), *programs, *searches, *learners]
    return {method.name: method for method in every}


def _named(name: str, agent: ActorCritic | None) -> Method:
    """The method of a name, whatever its capitals and hyphens."""
    known = {_key(one): method for one, method in known_methods().items()}
    if _key(name) in known:
        found = known[_key(name)]
        learns = isinstance(found, Learned) or (isinstance(found, Nested) and found.inner == "rl")
        return replace(found, agent=agent) if learns else found  # type: ignore[type-var]
    if name in METHODS:
        return as_method(name)
    raise InputError("methods", shown(name), f"one of {', '.join(known_methods())}")


def _key(name: str) -> str:
    """A name as it is looked up."""
    return " ".join(name.lower().replace("-", " ").replace("_", " ").split())


def held(result: CoDesignResult) -> str:
    """What holds a design, in words; empty if nothing does."""
    bounds = [f"{name} {side}" for name, side in result.active_bounds.items()]
    return ", ".join([*bounds, *result.active_constraints])


def _run(
    problem: CoDesignProblem, seed: int, design: Array | None, progress: bool, method: Method
) -> CoDesignResult | str:
    """What a method finds, or why it refuses."""
    try:
        return codesign(problem, method=method, rng=np.random.default_rng(seed), design=design, progress=progress)
    except REFUSALS as error:
        return " ".join(str(error).split()) or type(error).__name__
    except Exception as error:  # one method that fails must not lose what the others found
        return f"stopped with {type(error).__name__}: {' '.join(str(error).split())}"


def _summary(loop: ClosedLoopReturns) -> tuple[float, tuple[float, float], int]:
    """Mean, interval and number of the runs that are not lost."""
    summary = loop.summary
    return summary.mean, summary.ci95, summary.n


class _Pairs:
    """Differences of results to that of the reference, on the scenarios that both are measured on."""

    def __init__(self, problem: CoDesignProblem, seed: int, reference: CoDesignResult) -> None:
        self.problem = problem
        self.seed = seed
        self.reference = reference
        assert reference.closed_loop is not None
        mean = reference.closed_loop.summary.mean
        self.size = float(problem.made_by_control(mean, reference.design)) or 1.0
        self._seen: dict[Any, ClosedLoopReturns | None] = {}

    def row(self, name: str, result: CoDesignResult) -> MethodRow:
        """The row of a result."""
        assert result.closed_loop is not None
        assert self.reference.closed_loop is not None
        runs = min(len(result.closed_loop.values), len(self.reference.closed_loop.values))
        own = self._first(result, runs)
        other = self._first(self.reference, runs)
        here, there = self._lqr(result.design, runs), self._lqr(self.reference.design, runs)
        loops = [own, other, *(loop for loop in (here, there) if loop is not None)]
        kept = ~np.logical_or.reduce([loop.lost for loop in loops])
        pairs = ~(own.lost | other.lost)
        by_design = by_control = None
        if here is not None and there is not None:
            by_design = _difference(here.values[kept], there.values[kept])
            control = (own.values - here.values)[kept]
            by_control = _difference(control, (other.values - there.values)[kept])
        return MethodRow(
            name=name, result=result, difference=_difference(own.values[pairs], other.values[pairs]),
            from_design=by_design, from_control=by_control, runs=int(pairs.sum()),
            violation=float(self.problem.design.violation(result.design)),
        )  # fmt: skip

    def _first(self, result: CoDesignResult, runs: int) -> ClosedLoopReturns:
        """A result on the first so many of its scenarios."""
        assert result.closed_loop is not None
        if len(result.closed_loop.values) == runs:
            return result.closed_loop
        return self._measured((id(result), runs), result.controller, result.design, runs)

    def _lqr(self, design: Array, runs: int) -> ClosedLoopReturns | None:
        """Saturated LQR of a design on them; None where there is none."""
        try:
            controller = saturated_lqr(self.problem, design)
        except (MPCError, InputError):
            return None
        return self._measured((tuple(design), runs), controller, design, runs)

    def _measured(self, key: Any, controller: Any, design: Array, runs: int) -> ClosedLoopReturns:
        """Returns on the scenarios that `codesign` measures on, once each."""
        if key not in self._seen:
            scenarios = np.random.default_rng(self.seed).spawn(1)[0]  # as `codesign` draws them
            self._seen[key] = closed_loop_returns(self.problem, controller, design, scenarios, runs=runs)
        found = self._seen[key]
        assert found is not None
        return found


def _difference(a: Array, b: Array) -> PairedDifference | None:
    """The paired difference; None of no pairs."""
    return paired_difference(a, b) if len(a) else None
