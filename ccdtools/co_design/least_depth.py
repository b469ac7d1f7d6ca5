"""Least violation of X that a start forces on all controllers."""

from __future__ import annotations

import warnings

import numpy as np
from numpy.typing import ArrayLike
from scipy import sparse
from scipy.optimize import linprog

from ccdtools.arrays import Array
from ccdtools.co_design.budgets import DEPTH_TIME
from ccdtools.co_design.design_controllers import HORIZON
from ccdtools.co_design.problem import CoDesignProblem, FixedStart
from ccdtools.co_design.tolerances import NO_VIOLATION
from ccdtools.exceptions import LimitWarning
from ccdtools.output_limits import scaled_rows
from ccdtools_ground.door import as_count, as_instance, as_vector


def least_depth(
    problem: CoDesignProblem, design: ArrayLike, *, x0: ArrayLike | None = None, steps: int | None = None
) -> float:
    """Least peak violation of X [half-widths] by inputs in U, without disturbance.

    A linear program over the inputs of the first `steps` samples of the nominal model at one design; 0 where X can be
    kept. What a disturbance adds is not in it, so no controller does better.

    Parameters
    ----------
    problem : CoDesignProblem
    design : (np,) array_like
    x0 : (nx,) array_like, optional
        The start of the problem's scenarios by default; where they have several, the mean over the starts of eight.
    steps : int, optional
        The problem's by default, at most 20.

    Raises
    ------
    InputError
        If an argument has the wrong size, or the design lies outside its box.
    """
    as_instance("problem", problem, CoDesignProblem, "a CoDesignProblem")
    p = problem.design.check_one(design)
    horizon = min(problem.steps, HORIZON) if steps is None else as_count("steps", steps)
    if x0 is not None:
        starts = as_vector("x0", x0, problem.model.nx, of="one per state")[None]
    elif isinstance(problem.scenarios, FixedStart):
        starts = problem.scenarios.x0[None]
    else:
        drawn = problem.scenarios.sample(8, problem.steps, np.random.default_rng(0))[0]
        starts = np.unique(np.asarray(drawn, dtype=float), axis=0)
    return float(np.mean([_least(problem, p, start, horizon) for start in starts]))


def unavoidable_depth(problem: CoDesignProblem, design: Array) -> tuple[float, float]:
    """Least violation at a design, and over spread designs if above 0."""
    here = least_depth(problem, design)
    if here <= NO_VIOLATION:
        return 0.0, 0.0
    others = (least_depth(problem, other) for other in problem.design.spread()[:9])
    anywhere = min(here, *others)
    return here, anywhere if anywhere > NO_VIOLATION else 0.0


def warn_of_unavoidable_depth(problem: CoDesignProblem, design: Array) -> None:
    """Issue a `LimitWarning` if a fixed start forces every controller outside X.

    Starts that were logged may lie anywhere, and are what they are.
    """
    if not isinstance(problem.scenarios, FixedStart):
        return
    if problem.output_limits is not None:
        p = problem.design.check_one(design)
        (broken,) = problem.output_limits.broken_at(problem.scenarios.x0, problem.model.nu, p[None])
        if broken:
            text = f"the start breaks a limit of an output at this design, whatever the input: {broken}"
            warnings.warn(text, LimitWarning, stacklevel=3)
    here, anywhere = unavoidable_depth(problem, design)
    if here > 0:
        where = f"the least over the box of designs is {anywhere:.3g}" if anywhere > 0 else "other designs can keep it"
        text = f"no controller keeps X from the start at this design: it is left by {here:.3g} half-widths at least"
        warnings.warn(f"{text}; {where}", LimitWarning, stacklevel=3)


def _least(problem: CoDesignProblem, p: Array, x0: Array, steps: int) -> float:
    """Least s ≥ 0 with rows·x_k ≤ bounds + s for all k, in units of X and U."""
    F, g, _ = scaled_rows(problem.state_limits(p))
    A, B, _ = problem.model.matrices(p)
    size = problem.state_scale
    applied = np.array(problem.input_bounds_at(p))
    reach = np.max(np.abs(applied), axis=0)
    A = A * size / size[:, None]
    B = B * reach / size[:, None]
    nx, nu = B.shape
    eye = sparse.identity(steps, format="csr")
    back = sparse.diags([np.ones(steps - 1)], [-1], shape=(steps, steps), format="csr")
    dynamics = sparse.hstack([sparse.kron(eye, np.eye(nx)) - sparse.kron(back, A), -sparse.kron(eye, B),
                              sparse.csr_matrix((steps * nx, 1))], format="csr")  # fmt: skip
    first = np.zeros(steps * nx)
    first[:nx] = A @ (x0 / size)
    m = len(g)
    rows = sparse.hstack([sparse.kron(eye, F * size), sparse.csr_matrix((steps * m, steps * nu)),
                          -np.ones((steps * m, 1))], format="csr")  # fmt: skip
    lower, upper = applied / reach
    bounds = [(None, None)] * (steps * nx) + list(zip(lower, upper)) * steps + [(0.0, None)]
    cost = np.zeros(steps * (nx + nu) + 1)
    cost[-1] = 1.0
    upper = np.tile(g, steps)
    found = linprog(cost, rows, upper, dynamics, first, bounds, method="highs", options=DEPTH_TIME)
    return max(float(found.fun), 0.0) if found.status == 0 else 0.0
