"""Comparison of all co-design methods, by name, on one problem."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from types import NoneType
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from ccdtools.arrays import Array
from ccdtools.co_design.closed_loop import closed_loop_returns, scenarios_of
from ccdtools.co_design.codesign import Method, as_method, codesign
from ccdtools.co_design.configuration import METHODS as LEARNING
from ccdtools.co_design.method_comparison import MethodComparison
from ccdtools.co_design.method_names import ALL, as_method_names
from ccdtools.co_design.method_pairs import MethodRow, paired_row
from ccdtools.co_design.methods.learned import Learned
from ccdtools.co_design.methods.nested import NAMES as INNER, Nested
from ccdtools.co_design.methods.search import LIBRARIES, Search
from ccdtools.co_design.methods.sequential import Sequential
from ccdtools.co_design.methods.simultaneous import UNKNOWNS, Simultaneous
from ccdtools.co_design.problem import CoDesignProblem
from ccdtools.co_design.result import CoDesignResult
from ccdtools.exceptions import CCDError, InputError
from ccdtools.jobs import as_jobs, as_they_end, interrupted
from ccdtools_ground.door import as_count, as_flag, as_instance, shown
from learning.networks import ActorCritic

REFERENCE = "nested LQR"


def compare_methods(
    problem: CoDesignProblem,
    methods: str | Sequence[str] | Mapping[str, str | Method] = "all",
    *,
    seed: int = 0,
    design: ArrayLike | None = None,
    reference: str | None = None,
    agent: ActorCritic | None = None,
    jobs: int = 1,
    progress: bool | None = None,
    each: Callable[[MethodComparison], object] | None = None,
) -> MethodComparison:
    """Methods of `codesign` on one problem and the same scenarios.

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
    progress : bool, optional
        Show a progress bar, which names the method that runs, and with True the bars of the methods, too. By default
        it is shown unless `each` is given.
    each : callable of MethodComparison, optional
        Called after every method with what is there by then, to show or keep it. Until the reference is there,
        differences are to the first method that found something.

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
    shown_at_all = each is None if progress is None else as_flag("progress", progress)
    kinds = (ActorCritic, NoneType)
    as_instance("agent", agent, kinds, "an ActorCritic", "fit_actor_critic makes one.")
    chosen = named_methods(methods, agent)
    if reference is None:
        reference = REFERENCE if REFERENCE in chosen else next(iter(chosen))
    elif reference not in chosen:
        raise InputError("reference", shown(reference), f"one of {', '.join(chosen)}")
    first = None if design is None else problem.design.check_feasible(design)
    if each is not None and not callable(each):
        raise InputError("each", shown(each), "a function of a MethodComparison")
    run = partial(_run, problem, seed, first, bool(progress) and jobs == 1)
    ends: dict[str, CoDesignResult | str] = {}
    seen: dict[Any, Any] = {}
    found = as_they_end(
        run, list(chosen.values()), jobs=as_jobs(jobs), label="methods", names=list(chosen), progress=shown_at_all
    )
    for name, end in zip(chosen, found):
        ends[name] = end
        if each is not None and len(ends) < len(chosen):
            each(_compared(problem, seed, ends, reference, seen))
    comparison = _compared(problem, seed, ends, reference, seen)
    if each is not None:
        each(comparison)
    return comparison


def _compared(
    problem: CoDesignProblem, seed: int, ends: Mapping[str, CoDesignResult | str], reference: str, seen: dict[Any, Any]
) -> MethodComparison:
    """Comparison of the ended methods; `seen` keeps measurements of LQR."""
    results = {name: end for name, end in ends.items() if isinstance(end, CoDesignResult)}
    if reference not in results and results:
        reference = next(iter(results))
    rows = [
        MethodRow(name=name, refused=end) if isinstance(end, str)
        else paired_row(problem, seed, name, end, results[reference], seen)
        for name, end in ends.items()
    ]  # fmt: skip
    size = np.nan
    if results:
        found = results[reference]
        assert found.closed_loop is not None
        size = float(problem.made_by_control(found.closed_loop.summary.mean, found.design)) or 1.0
    return MethodComparison(rows=tuple(rows), reference=reference, size=size, problem=problem, seed=seed)


def _run(
    problem: CoDesignProblem, seed: int, design: Array | None, progress: bool, method: Method
) -> CoDesignResult | str:
    """Result of a method, or why it refuses."""
    try:
        found = codesign(problem, method=method, rng=np.random.default_rng(seed), design=design, progress=progress)
        if getattr(method, "judge", None) is None:
            return found
        loop = closed_loop_returns(problem, found.controller, found.design, scenarios_of(seed))
        return replace(found, closed_loop=loop)  # on the problem, as the others, and not on what judged it
    except CCDError as error:
        return " ".join(str(error).split()) or type(error).__name__
    except Exception as error:  # one method that fails must not lose what the others found
        if interrupted():
            raise KeyboardInterrupt from None
        return f"stopped with {type(error).__name__}: {' '.join(str(error).split())}"


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
        chosen = {
            name: known_methods(agent)[as_method_names([one])[0]] if isinstance(one, str) else as_method(one)
            for name, one in methods.items()
        }
    else:
        names = ALL if methods == "all" else (methods,) if isinstance(methods, str) else methods
        if not isinstance(names, list | tuple) or not all(isinstance(name, str) for name in names):
            raise InputError("methods", shown(methods), '"all", a list of names, or a mapping of names to methods')
        every = known_methods(agent)
        chosen = {name: every[name] for name in as_method_names(names)}
    if not chosen:
        raise InputError("methods", "none", "at least one method")
    return chosen


def known_methods(agent: ActorCritic | None = None) -> dict[str, Method]:
    """Every named method with its usual settings; those that learn start at `agent`."""
    every: list[Any] = [
        Sequential(), *(Nested(inner, agent=agent if inner == "rl" else None) for inner in INNER),
        *map(Simultaneous, UNKNOWNS), *map(Search, LIBRARIES), *(Learned(by=by, agent=agent) for by in LEARNING),
    ]  # fmt: skip
    return {method.name: method for method in every}
