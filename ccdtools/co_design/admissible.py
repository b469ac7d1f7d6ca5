"""Filter that keeps a design within its limits for ever."""

from __future__ import annotations

from numpy.typing import ArrayLike

from ccdtools.checks import as_instance
from ccdtools.co_design.problem import CoDesignProblem
from ccdtools.co_design.tolerances import SET_SECONDS
from ccdtools.exceptions import InputError
from invariant_sets import AdmissibleInputs, Polytope, maximal_control_invariant_set


def admissible_inputs(problem: CoDesignProblem, design: ArrayLike, *, into: Polytope | None = None) -> AdmissibleInputs:
    """Inputs that keep the next nominal state in X_fea(p).

    Parameters
    ----------
    problem : CoDesignProblem
    design : (np,) array_like
    into : Polytope, optional
        Another set for the next state; by default X_fea(p), the maximal control invariant set of the design, or as
        much of it as is certified within a minute.

    Raises
    ------
    InputError
        If the design lies outside its box, or no control invariant set in X is found there.
    """
    as_instance("problem", problem, CoDesignProblem, "a CoDesignProblem")
    p = problem.design.check_one(design)
    A, B, _ = problem.model.matrices(p)
    U = problem.input_limits(p)
    if into is None:
        found = maximal_control_invariant_set(A, B, problem.state_limits(p), U, time_limit=SET_SECONDS)
        into = found.set
        if into.is_empty:
            got = f"{problem.design.describe(p)}, where no control invariant set in X was found ({found.status.name})"
            raise InputError("design", got, "a design at which some states can be kept within X", found.status.advice)
    as_instance("into", into, Polytope, "a Polytope or None")
    return AdmissibleInputs(A, B, into, U)
