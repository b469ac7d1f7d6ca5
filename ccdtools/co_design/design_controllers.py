"""LQR and MPC of a design, for nested search and comparison."""

from __future__ import annotations

from contextlib import suppress
from typing import TYPE_CHECKING, Any

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike

from ccdtools.arrays import Array
from ccdtools.checks import as_instance
from ccdtools.co_design.problem import CoDesignProblem
from ccdtools.controllers.controllers import Controller, LinearFeedback
from ccdtools.exceptions import InputError
from ccdtools.plants.models import Model
from ccdtools.plants.sampled_model import SampledModel
from mpc import LinearMPC, LQRSensitivity, NotStabilisableError, lqr, lqr_sensitivity

if TYPE_CHECKING:
    from mpc.optimal_control import NonlinearMPC

HORIZON = 20  # The MPC looks ahead so many steps.
CONTROL = ("lqr", "mpc")
ON_TANGENT = "The plant is not linear: LQR, MPC, expert and landscape are of its tangent at rest, or a note says more."


def tangent_note(problem: CoDesignProblem) -> str:
    """Note that LQR uses the tangent at rest; empty if linear."""
    return ON_TANGENT if isinstance(problem.model, SampledModel) else ""


def saturated_lqr(problem: CoDesignProblem, design: ArrayLike) -> LinearFeedback:
    """LQR of the nominal model at a design, clipped to U."""
    as_instance("problem", problem, CoDesignProblem, "a CoDesignProblem")
    p = problem.design.check_one(design)
    A, B, _ = problem.model.matrices(p)
    K, _ = lqr(A, B, **problem.weights(p).keywords())
    return LinearFeedback(K, *problem.input_bounds_at(p))


def regulator_of(problem: CoDesignProblem, p: Array) -> LQRSensitivity:
    """LQR of a design (np,), with derivatives of gain and cost."""
    A, B, _ = problem.model.matrices(p)
    dA, dB, _ = problem.model.derivatives(p)
    return lqr_sensitivity(A, B, **problem.weights(p).keywords(), dA=dA, dB=dB, **weight_changes(problem, p))


def weight_changes(problem: CoDesignProblem, p: Array) -> dict[str, Array]:
    """dQ, dR and dS."""
    model = problem.model
    changed = problem.objective.weight_derivatives(p, model.nx, model.nu)
    return {f"d{name}": value for name, value in changed.keywords().items()}


def lqr_gains(problem: CoDesignProblem, A: Array, B: Array, designs: Array) -> Array:
    """LQR gains (n, nu, nx) of designs (n, np), NaN where none stabilises."""
    K = np.full((len(B), B.shape[2], B.shape[1]), np.nan)
    for i, (pair, p) in enumerate(zip(zip(A, B), designs)):
        with suppress(NotStabilisableError):
            K[i] = lqr(*pair, **problem.weights(p).keywords())[0]
    return K


def linear_mpc(problem: CoDesignProblem, design: ArrayLike, *, horizon: int = HORIZON) -> LinearMPC:
    """MPC of the nominal model, or its linearisation at rest, within a design's limits."""
    as_instance("problem", problem, CoDesignProblem, "a CoDesignProblem")
    p = problem.design.check_one(design)
    A, B, _ = problem.model.matrices(p)
    own = problem.weights(p).keywords()
    return LinearMPC(A, B, **own, horizon=horizon, X=problem.kept_by_mpc(p), U=problem.input_limits(p))


def nonlinear_mpc(
    problem: CoDesignProblem, design: ArrayLike, *, horizon: int = HORIZON, iterations: int | None = 1
) -> NonlinearMPC:
    """MPC of the nominal model itself at one design.

    Parameters
    ----------
    problem : CoDesignProblem
    design : (np,) array
    horizon : int
        [steps]
    iterations : int, optional
        Quadratic programs a sample: 1 follows the optimum from sample to sample; None goes to the optimum in each.

    Returns
    -------
    mpc.optimal_control.NonlinearMPC
        With the limits of the problem at the design, its weights (of a custom objective those that LQR and MPC take),
        and the disturbance at rest.
    """
    from mpc.optimal_control import NonlinearMPC

    as_instance("problem", problem, CoDesignProblem, "a CoDesignProblem")
    p = problem.design.check_one(design)
    X, U = problem.kept_by_mpc(p), problem.input_limits(p)
    return NonlinearMPC(
        undisturbed_step(problem.model), problem.model.nx, problem.model.nu, p=p, **problem.weights(p).keywords(),
        horizon=horizon, X=X, U=U, iterations=iterations,
    )  # fmt: skip


def controller_of(kind: str, problem: CoDesignProblem, design: ArrayLike) -> Controller:
    """Controller, "lqr" or "mpc", of a design found without it.

    Raises
    ------
    InputError
        If that design cannot be stabilised.
    """
    try:
        return saturated_lqr(problem, design) if kind == "lqr" else linear_mpc(problem, design)
    except NotStabilisableError as error:
        found = problem.design.describe(np.asarray(design, dtype=float))
        mode = "" if error.eigenvalue is None else f": no input reaches its mode at {error.eigenvalue:.4g}"
        got = f"{found}, which was found without a controller and cannot be stabilised{mode}"
        cure = "Keep such designs out by bounds or constraints, or choose a method that closes the loop."
        raise InputError("design", got, "a design that can be stabilised", cure) from error


def undisturbed_step(model: Model) -> ca.Function:
    """Function (x, u, p) → x⁺ at w = 0, by name."""
    step = model.step
    kind: Any = ca.SX if step.is_a("SXFunction") else ca.MX
    names = ["x", "u", "p"]
    x, u, p = (kind.sym(name, step.size1_in(i)) for name, i in zip(names, (0, 1, 3)))
    return ca.Function("step", [x, u, p], [step(x, u, ca.DM.zeros(model.nw), p)], names, ["value"])
