"""Entry point of every co-design method."""

from __future__ import annotations

import sys
import time
from dataclasses import replace
from functools import partial
from importlib import import_module
from typing import Any, Protocol, overload

import numpy as np
from numpy.typing import ArrayLike

from ccdtools.arrays import Array
from ccdtools.co_design.closed_loop import behind_filter
from ccdtools.co_design.configuration import METHODS as LEARNED, CoDesignConfig
from ccdtools.co_design.learned_result import LearnedCoDesign
from ccdtools.co_design.limits import StateLimitPenalty
from ccdtools.co_design.problem import CoDesignProblem
from ccdtools.co_design.result import CoDesignResult
from ccdtools.co_design.settling import Settling
from ccdtools.exceptions import InputError
from ccdtools.progress import telling
from ccdtools_ground.door import as_choice, as_flag, as_generator, as_instance, shown
from learning.networks import ActorCritic

MODEL_BASED = ("sequential", "nested", "simultaneous", "search")  # each a class of its own file in `methods`
METHODS = (*MODEL_BASED, *LEARNED)


class Method(Protocol):
    """Way to co-design.

    One with a method `instead(result, problem)` is asked for another that goes on from a result, or None. One with
    `following(agent)` is asked for the same from the policy of a former generation.
    """

    @property
    def name(self) -> str:
        """Name of the method in tables."""
        ...

    def run(
        self, problem: CoDesignProblem, design: Array, rng: np.random.Generator, *, progress: bool = False
    ) -> CoDesignResult:
        """Best design and controller from a feasible design (np,)."""
        ...


@overload
def codesign(
    problem: CoDesignProblem, *, agent: ActorCritic, rng: np.random.Generator, design: ArrayLike | None = None,
    method: str | Method = "pathwise", config: CoDesignConfig | None = None, judge: CoDesignProblem | None = None,
    limits: StateLimitPenalty | None = None, progress: bool = False,
) -> LearnedCoDesign: ...  # fmt: skip


@overload
def codesign(
    problem: CoDesignProblem, *, agent: None = None, rng: np.random.Generator, design: ArrayLike | None = None,
    method: str | Method = "pathwise", config: CoDesignConfig | None = None, judge: CoDesignProblem | None = None,
    limits: StateLimitPenalty | None = None, progress: bool = False,
) -> CoDesignResult: ...  # fmt: skip


def codesign(
    problem: CoDesignProblem,
    *,
    rng: np.random.Generator,
    design: ArrayLike | None = None,
    method: str | Method = "pathwise",
    agent: ActorCritic | None = None,
    config: CoDesignConfig | None = None,
    judge: CoDesignProblem | None = None,
    limits: StateLimitPenalty | None = None,
    progress: bool = False,
) -> CoDesignResult:
    """Best design and controller found for `problem`.

    It can take minutes, and prints nothing meanwhile unless `progress` is set.

    Parameters
    ----------
    problem : CoDesignProblem
    rng : numpy.random.Generator
        Two methods with generators of the same seed are measured on the same scenarios.
    design : (np,) array_like, optional
        First design, in physical units; by default the feasible one nearest to the centre of the box.
    method : str or Method
        "sequential", "nested", "simultaneous", "search", or of those that learn "pathwise", "ppo", "pathwise+ppo"; or
        an object with settings of its own, such as ``Nested("mpc")``.
    agent, config, judge, limits
        Of the methods that learn, see `Learned`.
    progress : bool
        Show a progress bar; where there is no terminal, a line every ten seconds on the standard error output.

    Returns
    -------
    CoDesignResult
        Of the methods that learn a `LearnedCoDesign`.

    Raises
    ------
    InputError
        If an argument is of the wrong kind, `design` is not feasible, or the method cannot honour what the problem
        asks for, or designs the plant first and finds one that cannot be stabilised. Of learning: if `agent` does not
        observe (x, p) over the box of designs or acts within other bounds than U, or the objective does not take torch
        tensors.
    """
    as_instance("problem", problem, CoDesignProblem, "a CoDesignProblem")
    chosen = as_method(method, agent=agent, config=config, judge=judge, limits=limits)
    as_generator("rng", rng)
    as_flag("progress", progress)
    space = problem.design
    if not space.free.any() and getattr(chosen, "designs_only", False):
        raise InputError(
            "method", shown(method), f"one of {', '.join(LEARNED)}, as the problem has nothing to design",
            "LQR, MPC and other controllers take it as it is: saturated_lqr(problem, design).",
        )  # fmt: skip
    first = space.project(space.centre) if design is None else space.check_feasible(design)
    scenarios = _own_generator(rng)
    frozen = getattr(getattr(chosen, "config", None), "design_rate", None) == 0 or not space.free.any()
    elsewhere = callable(getattr(chosen, "of", None))  # designs are measured
    judge = getattr(chosen, "judge", None) or problem
    settling = Settling(judge, scenarios, designing=not (frozen or elsewhere), foreseen=not elsewhere)
    lines = progress and not (sys.stderr and sys.stderr.isatty())
    with telling(partial(print, file=sys.stderr, flush=True) if lines else None, "co-design"):
        began = time.perf_counter()
        result = chosen.run(problem, np.asarray(first), rng, progress=progress and not lines)
        seconds = time.perf_counter() - began
        result = settling.checked(result)
        other = chosen.instead(result, problem) if hasattr(chosen, "instead") else None
        if other is not None:
            began = time.perf_counter()
            further = other.run(problem, result.best_known_design, rng, progress=progress and not lines)
            seconds += time.perf_counter() - began
            result = settling.continued(result, settling.checked(further))
    return replace(
        result, seconds=seconds, controller=behind_filter(problem, result.controller, result.design),
        described=space.describe(result.design), active_bounds=space.active_bounds(result.design),
        active_constraints=space.active_constraints(result.design),
    )  # fmt: skip


def as_method(method: str | Method, **learning: Any) -> Method:
    """Method by its name, or as given.

    Raises
    ------
    InputError
        If there is none of that name, or what belongs to learning is given to another.
    """
    if isinstance(method, str) and method in LEARNED:
        from ccdtools.co_design.methods.learned import Learned

        return Learned(by=method, **learning)
    if isinstance(method, str):
        as_choice("method", method, METHODS)
    elif isinstance(method, type) or not callable(getattr(method, "run", None)):
        raise InputError("method", shown(method), f"one of {', '.join(METHODS)}, or a Method such as Nested('mpc')")
    given = [name for name, value in learning.items() if value is not None]
    if given:
        cure = "State them in the method: Learned(by=…, agent=…)." if hasattr(method, "judge") else ""
        raise InputError(given[0], shown(learning[given[0]]), f"nothing, of the method {method!r}", cure)
    if isinstance(method, str):
        made: Method = getattr(import_module(f"ccdtools.co_design.methods.{method}"), method.capitalize())()
        return made
    return method


def _own_generator(rng: np.random.Generator) -> np.random.Generator:
    """Generator of evaluation scenarios, independent of the stream of `rng`."""
    try:
        return rng.spawn(1)[0]
    except TypeError:  # a bit generator without a seed sequence
        return np.random.default_rng(rng.integers(2**63, size=4))
