"""Expert inputs over all states and designs.

References
----------
Chen et al., "Approximating explicit model predictive control using constrained neural networks", ACC 2018
(projection on the control invariant set); the design joins the state as in Tsai et al., section "Initialization".
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from ccdtools.arrays import Array, Immutable
from ccdtools.co_design.budgets import SET_SECONDS
from ccdtools.co_design.candidates import SETS, SetBudget, SetCounts, Starts, limited, starts
from ccdtools.co_design.expert_loops import DesignLaw, expert_law, follow, stated_error
from ccdtools.co_design.method_names import EXPERTS
from ccdtools.co_design.problem import CoDesignProblem
from ccdtools.co_design.tolerances import EDGE_OF_SET, IMITATED
from ccdtools.design_limits import DesignLimits
from ccdtools.exceptions import InputError
from ccdtools.plants.linear_model import LinearModel
from ccdtools.plants.models import Model
from ccdtools.progress import Echo, telling
from ccdtools_ground.door import as_choice, as_count, as_generator, as_instance, as_positive, as_share, shown
from invariant_sets import AdmissibleInputs, ParametricSet, Polytope, maximal_control_invariant_set


@dataclass(frozen=True, eq=False, repr=False)
class ExpertData(Immutable):
    """Samples (x, p) → (u, V) of an expert.

    Attributes
    ----------
    inputs : (n, nx + np) array
        States and designs.
    actions : (n, nu) array
    values : (n,) array
        Discounted returns of that same controller; NaN where its run diverged.
    acceptance : float
        Fraction of the Latin hypercube samples that lay in the set of their design.
    diverged : float
        Fraction of the closed loops from accepted samples that diverged under the disturbance.
    sets : SetCounts or None
        How many designs had X_fea(p), and what the others had.
    """

    inputs: Array
    actions: Array
    values: Array
    acceptance: float
    diverged: float
    sets: SetCounts | None = None

    def __repr__(self) -> str:
        return f"ExpertData({len(self.inputs)} samples, {self.acceptance:.0%} feasible, {self.diverged:.1%} diverged)"


def feasible_sets(
    problem: CoDesignProblem, *, W: Polytope | Callable[[Array], Polytope] | None = None
) -> ParametricSet:
    """Maximal control invariant sets X_fea(p), computed when asked for.

    With a set W of errors x⁺ − Ax − Bu (nx,), or W(p), they are robust: some input keeps the state in them whatever
    the error is. By default that error is the stated mean of the disturbance, if there is one.
    """
    as_instance("problem", problem, CoDesignProblem, "a CoDesignProblem")
    matrices = partial(_state_and_input_matrices, problem.model)
    X, U = (limits.at if isinstance(limits, DesignLimits) else limits for limits in (problem.X, problem.U))
    return ParametricSet(matrices, X, U, W=stated_error(problem) if W is None else W)


def admissible_inputs(
    problem: CoDesignProblem, design: ArrayLike, *, into: Polytope | None = None, W: Polytope | None = None
) -> AdmissibleInputs:
    """Inputs that keep the next nominal state in X_fea(p).

    Parameters
    ----------
    problem : CoDesignProblem
    design : (np,) array_like
    into : Polytope, optional
        Another set for the next state; by default X_fea(p), the maximal control invariant set of the design, or as
        much of it as is certified within a minute.
    W : Polytope, optional
        Errors x⁺ − Ax − Bu (nx,), such as `ccdtools.twin.disturbance_set` finds in a log. X_fea(p) is then the robust
        one, and the next state is kept in it whatever the error is. By default the stated mean of the disturbance.

    Raises
    ------
    InputError
        If the design lies outside its box, or no control invariant set in X is found there.
    """
    as_instance("problem", problem, CoDesignProblem, "a CoDesignProblem")
    p = problem.design.check_one(design)
    A, B, _ = problem.model.matrices(p)
    U = problem.input_limits(p)
    stated = stated_error(problem)
    error: Any = stated(p) if W is None and stated is not None else W
    if into is None:
        found = maximal_control_invariant_set(A, B, problem.state_limits(p), U, W=error, time_limit=SET_SECONDS)
        into = found.set
        if into.is_empty:
            got = f"{problem.design.describe(p)}, where no control invariant set in X was found ({found.status.name})"
            raise InputError("design", got, "a design at which some states can be kept within X", found.status.advice)
    as_instance("into", into, Polytope, "a Polytope or None")
    return AdmissibleInputs(A, B, into, U, W=error)


def _leaving(problem: CoDesignProblem, begin: Starts, x: Array, u: Array) -> float:
    """Fraction of states (n, nx) in known sets that a step leads outside."""
    after = np.asarray(problem.model.advance(x, u, problem.mean_disturbance, begin.p))
    kept = [S.contains(after[i], EDGE_OF_SET) for i, S in enumerate(begin.sets) if S is not None and S.contains(x[i])]
    return 1.0 - float(np.mean(kept)) if kept else 0.0


def _state_and_input_matrices(model: Model, design: Array) -> tuple[Array, Array]:
    """A(p) and B(p), by a module-level function that can be pickled."""
    A, B, _ = model.matrices(design)
    return A, B


def expert_dataset(
    problem: CoDesignProblem,
    *,
    samples: int,
    rng: np.random.Generator,
    expert: str | DesignLaw = "lqr",
    gamma: float = 0.99,
    horizon: int = 10,
    designs: int | None = None,
    sets: ParametricSet | str = "auto",
    time_limit: float | None = 20.0,
    progress: bool = False,
    echo: Echo | None = None,
) -> ExpertData:
    """States and designs with expert inputs and values.

    Candidates (x, p) fill X × design box by Latin hypercube sampling; those with x in the set of their own design are
    accepted, and where these are few the others are moved into it. From each, and from the starts of the problem's
    scenarios, the expert's noisy closed loop is followed: the states it visits join the data, because a uniform sample
    hardly ever meets the neighbourhood of the origin, where the loop spends its time.

    Parameters
    ----------
    problem : CoDesignProblem
        Its own model is stepped, with its discrepancy if it has one, under what drives its episodes: beyond their
        length one episode follows another. Sets and LQR are those of the nominal model.
    samples : int
        Candidates.
    rng : numpy.random.Generator
    expert : {"lqr", "mpc", "explicit"} or function of (problem, design)
        Saturated LQR, projected on the inputs that keep the next state in X_fea(p) where that set is known; online
        MPC; the explicit MPC of every design, as in Chen et al.; or a law of one's own, such as
        `ccdtools.vehicles.skyhook`: the function returns a controller for a design, asked at single states (nx,).
    gamma : float
        Discount of the values: the training convention.
    horizon : int
        Of the MPC experts.
    designs : int, optional
        Distinct designs among the candidates. By default every candidate has its own, unless X_fea(p) takes so long
        that fewer must do.
    sets : {"auto", "lqr", "none"} or ParametricSet
        "auto": X_fea(p) as far as the budget goes, elsewhere the region in which saturated LQR keeps the state
        within X for ever; "lqr": that region everywhere; "none": X itself. Or X_fea, if already at hand, with a
        time limit of its own for each set.
    time_limit : float, optional
        Budget of all sets [s]: the work of a usual processor, counted in facets and steps, so that every machine takes
        the same sets; None for no limit.
    progress : bool
        Show progress bars.
    echo : callable, optional
        Takes a line of text every ten seconds.

    Raises
    ------
    InputError
        If an argument is of the wrong kind or out of range, or no candidate is feasible.
    """
    as_instance("problem", problem, CoDesignProblem, "a CoDesignProblem")
    samples = as_count("samples", samples)
    as_generator("rng", rng)
    if not callable(expert):
        as_choice("expert", expert, EXPERTS)
    gamma = as_share("gamma", gamma)
    horizon = as_count("horizon", horizon)
    designs = None if designs is None else min(samples, as_count("designs", designs))
    limit = np.inf if time_limit is None else as_positive("time_limit", time_limit, unit="s")
    if echo is not None and not callable(echo):
        raise InputError("echo", shown(echo), "a function that takes a line of text, or None")
    option = "auto" if isinstance(sets, ParametricSet) else as_choice("sets", sets, SETS)
    budget = SetBudget(option, limit, progress)
    with telling(echo, "the expert's data"):
        family = sets if isinstance(sets, ParametricSet) else limited(feasible_sets(problem), budget)
        begin = starts(problem, family, samples, designs, budget, rng)
        law = expert_law(problem, begin, expert, horizon, progress=progress)
        states, actions, values = follow(problem, begin, law, gamma, rng, progress=progress)
    known = (np.abs(states) <= IMITATED * problem.state_scale).all(axis=2)  # NaN is not
    designs_of_all = np.broadcast_to(begin.p, (*states.shape[:2], begin.p.shape[1]))
    inputs = np.concatenate([states, designs_of_all], axis=2)
    lost = float(np.isnan(values[0, : begin.candidates]).mean())
    counts = begin.counts
    if not isinstance(problem.model, LinearModel):
        leaving = _leaving(problem, begin, states[0], actions[0])
        counts = replace(counts, local=True, leaving=leaving)
    return ExpertData(inputs[known], actions[known], values[known], begin.acceptance, lost, counts)
