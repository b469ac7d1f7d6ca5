"""Problems whose policies see the estimate of a Kalman filter."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache, cached_property, partial
from typing import Any

import casadi as ca
import numpy as np

from ccdtools.arrays import Array
from ccdtools.co_design.differentiable_model import matrices
from ccdtools.co_design.measured import kalman_filter
from ccdtools.co_design.output_history import SensedScenarios, history_problem, in_expressions, with_memory
from ccdtools.co_design.problem import CoDesignProblem
from ccdtools.co_design.tolerances import PREVIEW_ROOM
from ccdtools.controllers.history import History
from ccdtools.controllers.observed import Observed
from ccdtools.estimation.belief import Belief
from ccdtools.estimation.cubature import CubatureKalmanFilter
from ccdtools.estimation.outputs import linear_outputs
from ccdtools.estimation.regression import predicted, updated
from ccdtools.plants.black_box import BlackBox
from ccdtools.plants.linear_model import LinearModel
from ccdtools.plants.pathwise_step import pathwise
from ccdtools.plants.plant import Plant
from ccdtools.plants.runge_kutta import ExplicitStep
from ccdtools.plants.sampled_model import SampledModel
from ccdtools.plants.simulated_model import SimulatedModel
from ccdtools_ground.door import as_instance


def estimator_at(problem: CoDesignProblem, p: Array) -> Any:
    """Kalman filter of a problem's sensors at a design (np,).

    It goes by cubature points where the model or its outputs are not linear; linearised at rest of a simulator, which
    has no expressions.
    """
    linear, output = kalman_filter(problem, p), problem.measurement.output
    exact = isinstance(output, np.ndarray) or (isinstance(output, Plant) and linear_outputs(output))
    if not isinstance(problem.model, SampledModel | LinearModel) or (exact and isinstance(problem.model, LinearModel)):
        return linear
    told = {"disturbance": (problem.mean_disturbance, problem.moments[2]), "P0": linear.P0, "x0": linear.x0}
    return CubatureKalmanFilter(problem.model, problem.measurement, W=0 * linear.c, V=linear.V, design=p, **told)


def memory_at(problem: CoDesignProblem, p: Array, history: int | None) -> Callable[[Any], Any]:
    """What stands around a policy that sees so many outputs and inputs, or the estimate."""
    if history is not None:
        return partial(History, length=history)
    return partial(Observed, estimator=estimator_at(problem, p))


def measured_problem(problem: CoDesignProblem, history: int | None) -> CoDesignProblem:
    """Problem whose policies see so many last outputs and inputs, or the estimate."""
    return filter_problem(problem) if history is None else history_problem(problem, history)


def filter_problem(problem: CoDesignProblem) -> CoDesignProblem:
    """Problem whose policies see a Kalman filter's estimate.

    The filter is that of `estimator_at`. The state is (x, 1, P, x̂), of which x̂ alone is not `hidden`; P is the lower
    triangle of the covariance, by columns. The disturbance is (w, v). The 1 stands at mean and covariance of w, so that
    the model rests at 0. What is measured at the start is that of the design in the middle of the box. Where a step or
    an output is no expression, see `history_problem`, the problem's model is a simulator, too.

    Parameters
    ----------
    problem : CoDesignProblem
        With a `measurement`.

    Raises
    ------
    InputError
        If the problem measures nothing.
    """
    as_instance("problem", problem, CoDesignProblem, "a CoDesignProblem")
    known = cache(lambda p: estimator_at(problem, np.array(p)))
    centre = known(tuple(problem.design.project(problem.design.centre)))
    scale = problem.state_scale

    def first(y: Array) -> Array:
        """Memory (n, ·) of a first measurement."""
        return _row(centre.update(centre.start(len(y)), y, np.zeros((len(y), centre.nu))))

    unseen = PREVIEW_ROOM * np.r_[1.0, _packed(np.outer(scale, scale))]
    room = np.r_[unseen, PREVIEW_ROOM * scale]
    modelled = partial(_with_filter, problem, known, centre.V)
    extent = np.r_[1.0, _packed(_largest_covariance(problem)), scale]
    return with_memory(problem, SensedScenarios(problem, first), room, extent, len(unseen), modelled)


def _largest_covariance(problem: CoDesignProblem) -> Array:
    """Sizes (nx, nx) of the covariance along an episode at the design in the middle."""
    linear = kalman_filter(problem, problem.design.project(problem.design.centre))
    u, belief = np.zeros((1, linear.nu)), linear.start(1)
    largest = np.zeros(linear.nx)
    for _ in range(problem.steps):
        belief = linear.predict(linear.update(belief, linear.y0[None], u), u)
        largest = np.maximum(largest, np.diag(belief.covariance))
    return np.sqrt(np.outer(largest, largest))


def _packed(P: Array) -> Array:
    """Lower triangles (..., n (n + 1) / 2) of symmetric matrices (..., n, n), by columns."""
    return P[(..., *np.triu_indices(P.shape[-1]))]


def _unpacked(triangle: Array, n: int) -> Array:
    """Symmetric matrices (..., n, n) of their lower triangles."""
    P = np.empty((*triangle.shape[:-1], n, n))
    rows, columns = np.triu_indices(n)
    P[..., rows, columns] = P[..., columns, rows] = triangle
    return P


def _row(belief: Belief) -> Array:
    """Memory (n, ·) of beliefs."""
    n = len(belief.mean)
    P = np.broadcast_to(belief.covariance, (n, *belief.covariance.shape[-2:]))
    return np.hstack([np.ones((n, 1)), _packed(P), belief.mean])


@dataclass(frozen=True, eq=False, repr=False)
class FilteredModel(SampledModel):
    """Discrete model with a filter, whose matrices at p are found once for all runs."""

    linear: LinearModel | None = None
    given: Any = None  # (z, u, (w, v), (A B E, p)) → z⁺ of the matrices of `linear`

    @cached_property
    def _own_step(self) -> ExplicitStep:
        """The step at any number of rows."""
        return FilterStep(self.plant.right_hand_side, 1)

    @cached_property
    def pathwise(self) -> Callable[..., Any]:
        """Step on torch tensors (n, ·) with p (np,) or (n, np), differentiable once."""
        import torch

        if self.linear is None:
            return partial(pathwise, self._own_step)
        step, linear = FilterStep(self.given, 1), self.linear

        def stepped(z: Any, u: Any, w: Any, p: Any) -> Any:
            """z⁺ (n, nz)."""
            M = torch.cat(matrices(linear, p), dim=-1)
            return pathwise(step, z, u, w, torch.cat([M.mT.flatten(-2), p], dim=-1))

        return stepped


class FilterStep(ExplicitStep):
    """Step of many instructions, for which CasADi's machine is the fastest at any number of rows."""

    few_rows = np.inf  # type: ignore[assignment]


def _with_filter(problem: CoDesignProblem, known: Any, V: Array, extent: Array) -> FilteredModel | SimulatedModel:
    """Model with state (x, 1, P, x̂) and disturbance (w, v); a simulator where it is no expression."""
    model: Any = problem.model
    measurement: Any = problem.measurement
    output, nx, nu, nw = measurement.output, model.nx, model.nu, model.nw
    ends = np.cumsum([0, nx, 1, nx * (nx + 1) // 2, nx]).tolist()
    if not in_expressions(model, output):

        def advance(z: Array, u: Array, w: Array, p: Array) -> Array:
            """States (n, nz) one sample later."""
            x, _, P, mean = np.split(z, ends[1:-1], axis=1)
            after = np.asarray(model.stepper(p, batch=len(x))(x, u, w[:, :nw]))
            y = measurement.at(nx, nu, p).of(after, u) + w[:, nw:]
            estimator = known(tuple(p))
            with np.errstate(all="ignore"):  # of a run that is lost
                belief = estimator.update(estimator.predict(Belief(mean, _unpacked(P, nx)), u), y, u)
            return np.hstack([after, _row(belief)])

        return SimulatedModel(
            BlackBox(advance, ends[-1], nu, model.dt, nw + len(V), model.design, batched=True), extent
        )  # fmt: skip
    z, u, w, p = (ca.SX.sym(name, n) for name, n in zip("zuwp", (ends[-1], nu, nw + len(V), model.design.dim)))
    M = ca.SX.sym("M", nx, nx + nu + nw)
    A, B, E = ca.horzsplit(M, np.cumsum([0, nx, nu, nw]).tolist())
    linear = model if isinstance(model, LinearModel) else None
    nonlinear = None if linear else model.step.expand()

    def step(x: Any, u: Any, w: Any) -> Any:
        """Next states of the plant."""
        return A @ x + B @ u + E @ w if nonlinear is None else nonlinear(x, u, w, p)

    def seen(x: Any, u: Any) -> Any:
        """Outputs without noise."""
        return output.output(x, u, p) if isinstance(output, Plant) else ca.DM(output) @ x

    x, one, P, mean = ca.vertsplit(z, ends)
    belief = mean, ca.tril2symm(ca.SX(ca.Sparsity.lower(nx), P))
    disturbance, noise = ca.vertsplit(w, [0, nw, nw + len(V)])
    after = step(x, u, disturbance)
    told = one * ca.DM(problem.mean_disturbance), one * ca.DM(problem.moments[2])
    mean, P, _ = updated(
        lambda x: seen(x, u), *predicted(lambda x, w: step(x, u, w), *belief, told), seen(after, u) + noise, ca.DM(V)
    )
    triangle = [P[i, j] for j in range(nx) for i in range(j, nx)]
    moved = ca.cse(ca.vertcat(after, one, *triangle, mean))
    plain = ca.substitute(moved, M, ca.reshape(model.function.expand()(p), M.shape))
    given = None if linear is None else ca.Function("given", [z, u, w, ca.vertcat(ca.vec(M), p)], [moved])
    plant = Plant(z, u, w, p, plain, model.design, model.dt, continuous=False)
    return FilteredModel(plant, model.dt, linear=linear, given=given, jump=model.jump)
