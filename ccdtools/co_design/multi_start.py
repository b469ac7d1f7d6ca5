"""Co-design from many first designs, and their agreement."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from ccdtools.arrays import Array, Immutable
from ccdtools.co_design.codesign import Method, as_method, codesign
from ccdtools.co_design.problem import CoDesignProblem
from ccdtools.co_design.result import CoDesignResult, CoDesignStatus
from ccdtools.exceptions import InputError
from ccdtools.jobs import as_jobs, in_processes
from ccdtools.plants.design_space import DesignSpace
from ccdtools.table import Table
from ccdtools_ground.door import as_count, as_flag, as_floats, as_instance


@dataclass(frozen=True, eq=False, repr=False, kw_only=True)
class MultiStart(Immutable):
    """Results of a method from several first designs, with one seed.

    Attributes
    ----------
    starts : (n, np) array
    results : tuple of CoDesignResult
        In the order of the starts.
    space : DesignSpace
    """

    starts: Array
    results: tuple[CoDesignResult, ...]
    space: DesignSpace

    def __iter__(self) -> Iterator[CoDesignResult]:
        return iter(self.results)

    def __len__(self) -> int:
        return len(self.results)

    def __repr__(self) -> str:
        return f"MultiStart({len(self)} starts, best {self.best!r}, spread {self.spread:.2g} of the box)"

    @property
    def best(self) -> CoDesignResult:
        """Result with the highest closed-loop return on the common scenarios.

        Of those that keep the limits, as far as methods say so; and of these, of those that lose fewest runs.
        """
        return min(self.results, key=_rank)

    @property
    def designs(self) -> Array:
        """Designs found (n, np), one per start."""
        return np.array([result.design for result in self.results])

    @property
    def spread(self) -> float:
        """Largest distance of designs from the best, in parts of ranges."""
        return float(np.abs(self.space.to_unit(self.designs) - self.space.to_unit(self.best.design)).max())

    def table(self) -> list[dict[str, Any]]:
        """Plain values, one dictionary per start."""
        return [
            {
                **{f"{name} at first": value for name, value in self.space.as_dict(start).items()},
                **self.space.as_dict(result.design), "return": _value(result), "seconds": result.seconds,
                "evaluations": result.evaluations, "status": result.status.name,
            }
            for start, result in zip(self.starts, self.results)
        ]  # fmt: skip

    def __str__(self) -> str:
        """Table in aligned columns."""
        lines = [
            (self.space.describe(start), self.space.describe(result.design), f"{_value(result):.5g}",
             f"{result.seconds:.3g} s", result.status.name.lower().replace("_", " "))
            for start, result in zip(self.starts, self.results)
        ]  # fmt: skip
        return str(Table(("first design", "design", "return", "time", "status"), lines))


def multi_start(
    problem: CoDesignProblem, starts: int | ArrayLike = 10, *, method: str | Method = "nested", seed: int = 0,
    jobs: int = 1, progress: bool = False,
) -> MultiStart:  # fmt: skip
    """Run the same co-design from several first designs.

    Parameters
    ----------
    problem : CoDesignProblem
    starts : int or (n, np) array_like
        So many feasible designs of a Latin hypercube; or these.
    method
        As `codesign` takes it.
    seed : int
        Of the starts and of every run of the method: scenarios are common.
    jobs : int
        Processes; −1 for all cores.
    progress : bool

    Returns
    -------
    MultiStart

    Raises
    ------
    InputError
        If an argument is of the wrong kind, a start is not feasible, or the method refuses.
    """
    as_instance("problem", problem, CoDesignProblem, "a CoDesignProblem")
    as_count("seed", seed, least=0)
    as_flag("progress", progress)
    chosen = as_method(method)
    space = problem.design
    if np.ndim(starts) == 0:
        drawn = space.latin_hypercube(as_count("starts", starts), np.random.default_rng(seed))
        points = [space.project(p) for p in drawn]
    else:
        rows = as_floats("starts", starts)
        if rows.ndim != 2 or not len(rows):
            raise InputError("starts", f"shape {rows.shape}", f"a number, or designs (n, {space.dim})")
        points = [space.check_feasible(row, argument=f"starts[{i}]") for i, row in enumerate(rows)]
    results = in_processes(
        partial(_from, problem, chosen, seed), points, jobs=as_jobs(jobs), label="starts", progress=progress
    )
    return MultiStart(starts=np.array(points), results=tuple(results), space=space)


def _from(problem: CoDesignProblem, method: Method, seed: int, design: Array) -> CoDesignResult:
    """Result of one start."""
    return codesign(problem, method=method, rng=np.random.default_rng(seed), design=design)


def _value(result: CoDesignResult) -> float:
    """Closed-loop return of the runs that are not lost."""
    assert result.closed_loop is not None
    return result.closed_loop.summary.mean


def _rank(result: CoDesignResult) -> tuple[float, float, float]:
    """Sort key: the best result has the least."""
    assert result.closed_loop is not None
    broken = result.status in (CoDesignStatus.INFEASIBLE, CoDesignStatus.LIMITS_BROKEN)
    value = _value(result)
    return broken, result.closed_loop.lost_share, np.inf if np.isnan(value) else -value
