"""The filter that keeps a design within its limits for ever, where the model holds."""

from __future__ import annotations

from numpy.typing import ArrayLike

from ccdtools.checks import as_instance, shown
from ccdtools.co_design.expert import feasible_sets
from ccdtools.co_design.problem import CoDesignProblem
from ccdtools.exceptions import InputError
from invariant_sets import AdmissibleInputs, Polytope


def admissible_inputs(problem: CoDesignProblem, design: ArrayLike, *, into: Polytope | None = None) -> AdmissibleInputs:
    """The inputs that keep the next state of the nominal model in X_fea(p), as a function of the state.

    Parameters
    ----------
    problem : CoDesignProblem
    design : (np,) array_like
    into : Polytope, optional
        Another set for the next state; by default X_fea(p), the maximal control invariant set of the design.

    Raises
    ------
    InputError
        If the design lies outside its box, or X_fea(p) is empty: no state can be kept within the limits for ever.
    """
    as_instance("problem", problem, CoDesignProblem, "a CoDesignProblem")
    p = problem.design.check_one(design)
    if into is None:
        into = feasible_sets(problem).at(p)
        if into.is_empty:
            got = f"{problem.design.describe(p)}, where no state can be kept within X for ever"
            raise InputError("design", got, "one with a control invariant set in X", "Widen X or U.")
    as_instance("into", into, Polytope, f"a Polytope, not {shown(into)}")
    A, B, _ = problem.model.matrices(p)
    return AdmissibleInputs(A, B, into, problem.U)
