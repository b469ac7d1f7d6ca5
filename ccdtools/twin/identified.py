"""Plant, and its LQR, that logs tell by least squares."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike

from ccdtools.arrays import Array
from ccdtools.co_design.design_controllers import affine_lqr
from ccdtools.co_design.problem import CoDesignProblem, as_seen_problem
from ccdtools.controllers.controllers import LinearFeedback
from ccdtools.exceptions import InputError
from ccdtools.plants.discretisation import discretise
from ccdtools.plants.models import Model, PlantOfModel
from ccdtools.plants.plant import Plant
from ccdtools.plants.simulated_model import SimulatedModel
from ccdtools.trajectory import Trajectory
from ccdtools.twin.budgets import BLOCKS, RIDGES
from ccdtools.twin.residuals import Logs, Residuals, errors_in, residuals
from ccdtools.twin.tolerances import EXCITED
from ccdtools.twin.transport import Transport, carried
from ccdtools.twin.unknown_plant import disturbed, mean_disturbance, moved_at_rest
from ccdtools_ground.door import as_instance


def identified_lqr(problem: CoDesignProblem, design: ArrayLike, logs: Logs) -> LinearFeedback:
    """LQR with an offset, of the affine model that explains logs best.

    The one-step errors of the nominal model are fitted by (ΔA, ΔB, c), each state by ridge regression towards no change
    in A and B whose weight generalised cross-validation chooses; c is free. Clipped to U. Least squares mistake a
    disturbance that lasts for a consequence of the state.

    Parameters
    ----------
    problem : CoDesignProblem
    design : (np,) array_like
        Logs of other designs are carried to it.
    logs : Trajectory or Residuals, or a sequence of them
        From `deploy`, or `twin.logs`.

    Raises
    ------
    InputError
        If there is no log, or one of another plant.
    mpc.NotStabilisableError
        If the model found cannot be stabilised.

    References
    ----------
    Golub, Heath and Wahba, "Generalized cross-validation as a method for choosing a good ridge parameter",
    Technometrics 21, 1979.
    """
    as_instance("problem", problem, CoDesignProblem, "a CoDesignProblem")
    p = problem.design.check_one(design)
    A, B, _ = problem.model.matrices(p)
    dA, dB, c = fitted_change(_carried(problem, logs, p), problem.state_scale)
    return affine_lqr(problem, p, A + dA, B + dB, c)


def _carried(problem: CoDesignProblem, logs: Logs, p: Array | None = None) -> list[Residuals]:
    """Errors of logs, at one design (np,): the last by default."""
    errors = errors_in(problem, logs)
    at = errors[-1].p if p is None else p
    return [carried(problem.model, log, at, problem.state_scale) for log in errors]


def identified_change(problem: CoDesignProblem, logs: Logs) -> IdentifiedChange:
    """Affine change of a model, from logs.

    Fitted as by `identified_lqr`. ``updated_problem(problem, identified_change(problem, log))`` is what LQR, MPC, sets
    and every co-design take, with the constant where the disturbance states its mean.

    Parameters
    ----------
    problem : CoDesignProblem
        On states that are seen, its model by `discretise`, not by collocation.
    logs : Trajectory or Residuals, or a sequence of them
        From `deploy`, or `twin.logs`. Those of other designs are carried to that of the last. An affine model is right
        where the loop has been: the last log alone is often better than all.

    Raises
    ------
    InputError
        If there is no log, or one of another plant; or the model has no step to build on.
    """
    check_changeable(problem)
    return IdentifiedChange(_carried(problem, logs))


def check_changeable(problem: CoDesignProblem) -> None:
    """Raise an `InputError` unless least squares can change the problem's model."""
    as_seen_problem(as_instance("problem", problem, CoDesignProblem, "a CoDesignProblem"))
    if isinstance(problem.model, SimulatedModel) or not problem.model.step.is_a("SXFunction"):
        expected = "a model by discretise(plant), not by collocation"
        raise InputError("problem.model", repr(problem.model), expected, "fit_plant(plant=) takes what is unknown.")
    disturbed(problem, lambda w: w)


@dataclass(frozen=True, eq=False)
class IdentifiedChange:
    """Affine change of a model, from logs.

    It is fitted to one-step errors at one design. At a design q it is T(q) (ΔA x + ΔB u + c), as errors are carried;
    see `Transport`. Of A and B what no log excites stays as in the model; c is what the mean of the problem's
    disturbance leaves.

    Attributes
    ----------
    errors : sequence of Residuals
    """

    errors: Sequence[Residuals]

    def updated(self, problem: CoDesignProblem) -> CoDesignProblem:
        """Problem on the changed model.

        The constant enters with a further disturbance, which is 1.
        """
        model, scale = problem.model, problem.state_scale
        x, u, w, p = (ca.SX.sym(*sized) for sized in zip("xuwp", (model.nx, model.nu, model.nw, problem.design.dim)))
        after, signals = model.step(x, u, w, p), ca.vertcat(x, u, w)
        E = ca.substitute(ca.jacobian(after, w), signals, ca.DM.zeros(signals.shape))
        carry = Transport.at(model, self.errors[-1].p, scale).matrix(E)
        dA, dB, c = map(ca.DM, fitted_change(self.errors, scale))
        rest, p0 = (ca.DM.zeros(model.nx), ca.DM.zeros(model.nu)), self.errors[-1].p
        still, stated = (model.step(*rest, met, p0) for met in (ca.DM.zeros(model.nw), mean_disturbance(problem)))
        plant = Plant(
            x, u, w, p, after + carry @ (dA @ x + dB @ u), problem.design, model.dt, continuous=False,
            state_names=problem.state_names, input_names=problem.input_names,
        )  # fmt: skip
        plant, scenarios = moved_at_rest(problem, plant, carry @ (c - (stated - still)))
        return replace(problem, model=discretise(plant), scenarios=scenarios)

    def drawn(self, problem: CoDesignProblem, draws: int, rng: np.random.Generator) -> Iterator[CoDesignProblem]:
        """Problems by stretches of the logs, drawn with replacement."""
        parts = [
            log.part(slice(i, i + 1), slice(a, b))
            for log in self.errors
            for i in range(log.runs)
            for a, b in pairwise(np.linspace(0, log.steps, -(-BLOCKS // log.runs) + 1, dtype=int))
            if a < b
        ]
        for _ in range(draws):
            yield IdentifiedChange([parts[i] for i in rng.integers(0, len(parts), len(parts))]).updated(problem)


@dataclass(frozen=True, eq=False)
class IdentifiedPlant(PlantOfModel):
    """Model with an affine change, f(x, u, w, p) + ΔA x + ΔB (u, w) + c."""

    model: Model
    change: tuple[Array, Array, Array]

    def stepper(self, p: Array, *, batch: int) -> Callable[[Array, Array, Array], Array]:
        """Steps (x, u, w) → x⁺ at design `p` (np,)."""
        step = self.model.stepper(p, batch=batch)
        A, B, c = self.change
        nu = self.model.nu
        return lambda x, u, w: step(x, u, w) + x @ A.T + u @ B[:, :nu].T + w @ B[:, nu:].T + c


def identified_plant(problem: CoDesignProblem, logs: Trajectory | Sequence[Trajectory]) -> IdentifiedPlant:
    """Plant that logs with a recorded disturbance tell.

    Errors of the nominal model under the disturbance of the log are fitted as by `identified_lqr`, by states, inputs
    and disturbances. So one that lasts is not mistaken for a consequence of the state.

    Parameters
    ----------
    problem : CoDesignProblem
    logs : Trajectory, or a sequence of them at one design
        From `deploy`; runs that diverged are left out.

    Raises
    ------
    InputError
        If a log is of another plant or disturbance, or all of its runs diverged.

    Examples
    --------
    >>> switchback_on(problem, plant, law, other, design, model=identified_plant(problem, log), **options)
    """
    as_instance("problem", problem, CoDesignProblem, "a CoDesignProblem")
    given: list[Any] = list(logs) if isinstance(logs, list | tuple) else [logs]
    met = [residuals(problem.model, log, met=True, argument=f"logs[{i}]") for i, log in enumerate(given)]
    errors = [
        replace(one, u=np.concatenate([one.u, log.disturbances[one.numbers]], axis=2))
        for one, log in zip(errors_in(problem, met), given)
    ]
    return IdentifiedPlant(problem.model, fitted_change(errors, problem.state_scale))


def fitted_change(logs: Sequence[Residuals], scale: Array) -> tuple[Array, Array, Array]:
    """ΔA (nx, nx), ΔB (nx, nu) and c (nx,) of errors, by ridge regression.

    What hardly varies, as inputs beside the states that they follow from, is not told: there what is not linear in the
    plant varies with what is not linear in the law.
    """
    x, u, e = (np.concatenate([getattr(log, name).reshape(-1, getattr(log, name).shape[2]) for log in logs])
               for name in ("x", "u", "e_next"))  # fmt: skip
    z, e = np.hstack([x, u]), e / scale
    mean, spread = z.mean(axis=0), z.std(axis=0)
    spread = np.where(spread > 0, spread, 1.0)
    U, s, V = np.linalg.svd((z - mean) / spread, full_matrices=False)
    told = s >= EXCITED * s[0]
    U, s, V = U[:, told], s[told], V[told]
    parts = U.T @ (e - e.mean(axis=0))
    kept = s[:, None] ** 2 / (s[:, None] ** 2 + max(s[0], 1.0) ** 2 * RIDGES)  # (m, ridges); none for the last
    left = np.square(e - e.mean(axis=0)).sum(axis=0)[:, None] - np.square(parts).T @ (1 - (1 - kept) ** 2)
    free = len(z) - 1 - kept.sum(axis=0)
    best = np.argmin(np.where(free >= 1, left / np.maximum(free, 1) ** 2, np.inf), axis=1)  # none through all
    share = np.divide(kept[:, best], s[:, None], out=np.zeros_like(parts), where=s[:, None] > 0)
    change = (V.T @ (share * parts)).T * scale[:, None] / spread
    return change[:, : x.shape[1]], change[:, x.shape[1] :], e.mean(axis=0) * scale - change @ mean
