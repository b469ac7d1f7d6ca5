"""LQR and MPC of a design, for nested search and comparison."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike

from ccdtools.arrays import Array
from ccdtools.co_design.budgets import LONGEST_PLAN
from ccdtools.co_design.custom_objective import CustomObjective
from ccdtools.co_design.problem import CoDesignProblem
from ccdtools.controllers.controllers import Controller, LinearFeedback, Passive
from ccdtools.exceptions import InputError
from ccdtools.plants.linear_model import LinearModel
from ccdtools.plants.models import Model
from ccdtools_ground.door import as_choice, as_count, as_instance
from mpc import LinearMPC, NotStabilisableError, lqr, lqr_sensitivity
from mpc.robust import as_disturbance_set

if TYPE_CHECKING:
    from torch import Tensor

    from invariant_sets import Polytope
    from mpc.optimal_control import NonlinearMPC, Phase

HORIZON = 20  # The MPC looks ahead so many steps.
CONTROL = ("lqr", "mpc")
ON_TANGENT = "The plant is not linear: LQR, MPC, expert and landscape are of its tangent at rest, or a note says more."


def tangent_note(problem: CoDesignProblem) -> str:
    """Note that LQR uses the tangent at rest; empty if linear."""
    return "" if isinstance(problem.model, LinearModel) else ON_TANGENT


def saturated_lqr(problem: CoDesignProblem, design: ArrayLike) -> LinearFeedback:
    """LQR of the nominal model at a design, clipped to U.

    With a disturbance whose stated mean d is not 0 it has the offset that costs least on average,
    −(R + B'PB)⁻¹ B' (I − (A − BK)')⁻¹ P E d.
    """
    as_instance("problem", problem, CoDesignProblem, "a CoDesignProblem")
    p = problem.design.check_one(design)
    A, B, E = problem.model.matrices(p)
    return affine_lqr(problem, p, A, B, E @ problem.mean_disturbance)


def affine_lqr(problem: CoDesignProblem, p: Array, A: Array, B: Array, c: Array) -> LinearFeedback:
    """LQR with an offset against c (nx,), at a design (np,)."""
    weights = problem.weights(p)
    K, P = lqr(A, B, **weights.keywords())
    offset: Any = lqr_offset(A, B, K, P, weights.R, c).numpy() if c.any() else 0.0
    return LinearFeedback(K, *problem.input_bounds_at(p), offset=offset)


def lqr_offset(*data: Array | Tensor) -> Tensor:
    """Input (nu,) at x = 0 against c (nx,), of A, B, K, P, R and c."""
    import torch

    A, B, K, P, R, c = (part if isinstance(part, torch.Tensor) else torch.tensor(part) for part in data)
    ahead = torch.linalg.solve(torch.eye(len(A)) - (A - B @ K).T, P @ c)  # half the slope of x'Px + 2s'x
    offset: Tensor = -torch.linalg.solve(R + B.T @ P @ B, B.T @ ahead)
    return offset


def regulator_data(problem: CoDesignProblem, p: Array) -> dict[str, Array]:
    """Model and weights at a design (np,), with derivatives, for `lqr_sensitivity`."""
    A, B, _ = problem.model.matrices(p)
    dA, dB, _ = problem.model.derivatives(p)
    return {"A": A, "B": B, **problem.weights(p).keywords(), "dA": dA, "dB": dB, **weight_changes(problem, p)}


def weight_changes(problem: CoDesignProblem, p: Array) -> dict[str, Array]:
    """dQ, dR and dS."""
    model = problem.model
    changed = problem.objective.weight_derivatives(p, model.nx, model.nu)
    return {f"d{name}": value for name, value in changed.keywords().items()}


def lqr_laws(
    problem: CoDesignProblem, matrices: tuple[Array, Array, Array], designs: Array
) -> tuple[Array, Array]:  # fmt: skip
    """LQR gains (n, nu, nx) and offsets (n, nu), NaN without LQR."""
    n, nx, nu = matrices[1].shape
    K, k = np.full((n, nu, nx), np.nan), np.full((n, nu), np.nan)
    for i, (A, B, E, p) in enumerate(zip(*matrices, designs)):
        with suppress(NotStabilisableError):
            weights = problem.weights(p)
            K[i], P = lqr(A, B, **weights.keywords())
            k[i] = lqr_offset(A, B, K[i], P, weights.R, E @ problem.mean_disturbance)
    return K, k


def linear_mpc(
    problem: CoDesignProblem, design: ArrayLike, *, horizon: int = HORIZON, W: Polytope | Any = None
) -> LinearMPC:
    """MPC of the nominal model, or its linearisation at rest, within a design's limits.

    A stated mean of the disturbance is part of the model, see `mean` of `LinearMPC`. With `W`, such as
    `ccdtools.twin.disturbance_set` finds in a log, limits are tightened for x⁺ = Ax + Bu + w with any w (nx,) in W,
    which holds that mean, too.
    """
    as_instance("problem", problem, CoDesignProblem, "a CoDesignProblem")
    p = problem.design.check_one(design)
    A, B, E = problem.model.matrices(p)
    own = problem.weights(p).keywords()
    if problem.mean_disturbance.any():
        still, mean = np.eye(len(A)), E @ problem.mean_disturbance
        own |= {"E": still, "mean": mean}
        W = None if W is None else as_disturbance_set(W, still).affine_map(still, -mean)
    return LinearMPC(A, B, **own, horizon=horizon, X=problem.kept_by_mpc(p), U=problem.input_limits(p), W=W)


def nonlinear_mpc(
    problem: CoDesignProblem, design: ArrayLike, *, horizon: int = HORIZON, iterations: int | None = 1,
    cost: str = "weights",
) -> NonlinearMPC:  # fmt: skip
    """MPC of the nominal model itself at one design.

    Parameters
    ----------
    problem : CoDesignProblem
    design : (np,) array
    horizon : int
        [steps]
    iterations : int, optional
        Quadratic programs a sample: 1 follows the optimum from sample to sample; None goes to the optimum in each.
    cost : {"weights", "objective"}
        What it minimises: the weights that LQR and MPC take, or of a `CustomObjective` the cost itself, to the optimum
        in each sample. Behind the horizon both count what LQR costs.

    Returns
    -------
    mpc.optimal_control.NonlinearMPC
        With the limits of the problem at the design, and the disturbance at rest or at its stated mean.
    """
    from mpc.optimal_control import NonlinearMPC

    as_instance("problem", problem, CoDesignProblem, "a CoDesignProblem")
    p = problem.design.check_one(design)
    X, U = problem.kept_by_mpc(p), problem.input_limits(p)
    iterations = None if iterations is None else as_count("iterations", iterations)
    if as_choice("cost", cost, ("weights", "objective")) == "objective" and own_cost(problem):
        return NonlinearMPC(_phase(problem, p, as_count("horizon", horizon), X), p=p)
    mean, own = problem.mean_disturbance, problem.weights(p).keywords()
    if mean.any():
        own |= {"disturbances": len(mean), "mean": mean}
    return NonlinearMPC(
        named_step(problem.model, disturbed=bool(mean.any())), problem.model.nx, problem.model.nu, p=p, **own,
        horizon=horizon, X=X, U=U, iterations=iterations,
    )  # fmt: skip


def own_cost(problem: CoDesignProblem) -> bool:
    """Whether the objective has a cost beside the weights of LQR."""
    return isinstance(problem.objective, CustomObjective)


def _phase(problem: CoDesignProblem, p: Array, horizon: int, X: Polytope) -> Phase:
    """So many steps of the model and of the cost itself, within X and U."""
    from mpc.optimal_control import Phase

    nx, nu, objective = problem.model.nx, problem.model.nu, problem.objective
    assert isinstance(objective, CustomObjective)
    A, B, _ = problem.model.matrices(p)
    _, P = lqr(A, B, **problem.weights(p).keywords())
    step = named_step(problem.model, w=problem.mean_disturbance)
    stage_cost = objective.stage_cost.function(nx, nu, len(p))
    return Phase(
        lambda x, u, p: step(x, u, p), nx, nu, discrete=True, duration=horizon, u_bounds=problem.input_bounds_at(p),
        stage_cost=lambda x, u, p: stage_cost(x, u, p), terminal_cost=lambda x: x.T @ P @ x,
        path=lambda x: X.A @ x - X.b,
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


def named_step(model: Model, *, disturbed: bool = False, w: Array | None = None) -> ca.Function:
    """Function (x, u, p) → x⁺, by name.

    It is at w (nw,), 0 by default, or of (x, u, w, p).
    """
    step = model.step
    kind: Any = ca.SX if step.is_a("SXFunction") else ca.MX
    free = {name: kind.sym(name, step.size1_in(i)) for i, name in enumerate("xuwp") if disturbed or name != "w"}
    known = {"w": ca.DM.zeros(model.nw) if w is None else ca.DM(w)} | free
    return ca.Function("step", [*free.values()], [step(*(known[name] for name in "xuwp"))], [*free], ["value"])


@dataclass(frozen=True, eq=False)
class DesignLaw:
    """Control law for every design."""

    words: str
    controller: Callable[[CoDesignProblem, Array], Controller]  # problem and design (np,) → controller
    # problem and design tensor (np,) → the same law, differentiable by state and design; by default the controller is
    # made anew at every design and asked at every state
    exact: Callable[[CoDesignProblem, Tensor], Callable[[Tensor], Tensor]] | None = None

    def on_line(self, problem: CoDesignProblem, p: Tensor) -> Callable[[Tensor], Tensor]:
        """Controller of a design (np,) as a law; a lost run is given no program to solve."""
        controller = self.controller(problem, p.detach().numpy())

        def law(x: Tensor) -> Tensor:
            """Inputs."""
            states = x.detach().numpy()
            lost = (np.abs(states) > problem.limit).any(axis=1)
            return x.new_tensor(controller(np.where(lost[:, None], 0.0, states)))

        return law


def fed_back(problem: CoDesignProblem, at: Tensor, *, rounding: float = 0.0) -> Callable[[Tensor], Tensor]:
    """Law u = clip(k(p) − (K(p) + ΔK) x), k and K those of LQR, with its exact slope.

    `at` holds p (np,), and behind it ΔK by rows, if any. Clipping is rounded off over this part of U.
    """
    import torch

    p = at[: problem.design.dim]
    known = p.detach()

    def near(value: Array, slope: Array) -> Tensor:
        """Value with its slope."""
        return torch.tensor(value) + torch.tensor(slope) @ (p - known)

    offset: Any = 0.0
    if p.requires_grad:
        data = regulator_data(problem, known.numpy())
        found = lqr_sensitivity(**data)
        K = near(found.K, found.dK)
        if problem.mean_disturbance.any():
            from ccdtools.co_design.differentiable_model import matrices

            *pair, E = matrices(problem.model, p)
            drift = E @ torch.tensor(problem.mean_disturbance)
            offset = lqr_offset(*pair, K, near(found.P, found.dP), near(data["R"], data["dR"]), drift)
    else:
        A, B, E = problem.model.matrices(known.numpy())
        law = affine_lqr(problem, known.numpy(), A, B, E @ problem.mean_disturbance)
        K, offset = torch.tensor(law.K), torch.tensor(law.offset)
    if len(at) > len(p):
        K = K + at[len(p) :].view_as(K)
    low, high = (torch.as_tensor(bound, dtype=torch.float64) for bound in problem.input_bounds_at(p))
    if not rounding:
        return lambda x: torch.clamp(offset - x @ K.T, low, high)
    soft = rounding * (high - low)

    def rounded(x: Tensor) -> Tensor:
        """Inputs."""
        asked = offset - x @ K.T
        return (low + high + torch.hypot(asked - low, soft) - torch.hypot(asked - high, soft)) / 2

    return rounded


PASSIVE = DesignLaw(
    "the passive plant", lambda problem, p: Passive(problem.model.nu),
    lambda problem, p: lambda x: x.new_zeros(len(x), problem.model.nu),
)  # fmt: skip
LQR = DesignLaw("saturated LQR", saturated_lqr, fed_back)


def mpc_law(horizon: int = HORIZON, *, nonlinear: bool = False) -> DesignLaw:
    """MPC of every design, on line; nonlinear by one real-time iteration per sample and run."""
    made = nonlinear_mpc if nonlinear else linear_mpc
    words = f"{'nonlinear' if nonlinear else 'linear'} MPC (N = {horizon})"
    return DesignLaw(words, lambda problem, p: made(problem, p, horizon=horizon))


def long_mpc(problem: CoDesignProblem, design: ArrayLike, cost: str = "weights") -> NonlinearMPC:
    """MPC of the model itself, to the optimum of every sample, over an episode or `LONGEST_PLAN` steps of it."""
    return nonlinear_mpc(problem, design, horizon=min(problem.steps, LONGEST_PLAN), iterations=None, cost=cost)
