"""Problems whose policies see the last outputs and inputs."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Any

import casadi as ca
import numpy as np

from ccdtools.arrays import Array, Immutable
from ccdtools.checks import as_count, as_instance
from ccdtools.co_design.design_controllers import saturated_lqr
from ccdtools.co_design.measured import observed
from ccdtools.co_design.preview import previewed_objective, previewed_output_limits
from ccdtools.co_design.problem import CoDesignProblem, Scenarios
from ccdtools.co_design.tolerances import PREVIEW_ROOM
from ccdtools.design_limits import DesignLimits
from ccdtools.estimation.measurement import Measurement
from ccdtools.exceptions import InputError
from ccdtools.plants.discretisation import discretise
from ccdtools.plants.linear_model import LinearModel
from ccdtools.plants.models import Model
from ccdtools.plants.plant import Plant
from ccdtools.plants.tolerances import MODEL_AT_REST
from invariant_sets.system_checks import as_set
from learning.networks import ActorCritic
from learning.warm_start import fit_actor_critic
from mpc import NotStabilisableError


def history_problem(problem: CoDesignProblem, length: int) -> CoDesignProblem:
    """Problem whose policies see the last outputs and inputs.

    Its state is (x, y_k, …, y_{k−m+1}, u_{k−1}, …, u_{k−m}), of which x is `hidden`; its disturbance is (w, v). What is
    measured at the start is that of the design in the middle of the box.

    Parameters
    ----------
    problem : CoDesignProblem
        With a `measurement` of a plant's outputs, or by a matrix C.
    length : int
        m samples.

    Raises
    ------
    InputError
        If the problem measures nothing, or by a Python function, or its outputs are not 0 at rest.
    """
    as_instance("problem", problem, CoDesignProblem, "a CoDesignProblem")
    length = as_count("length", length)
    if problem.measurement is None:
        raise InputError("problem", "one without a measurement", "CoDesignProblem(measurement=Measurement(…))")
    output = _symbolic(problem.model, problem.measurement.output)
    ny, nu = output.numel_out(0), problem.model.nu
    scenarios = HistoryScenarios(problem.scenarios, problem.measurement, problem.model, length)
    lower, upper = problem.input_bounds
    drawn = scenarios.sample(256, problem.steps, np.random.default_rng(0))
    x = np.random.default_rng(0).uniform(-1, 1, (1024, problem.model.nx)) * problem.state_scale
    y = problem.measurement.at(problem.model.nx, nu, problem.design.centre).of(x, np.zeros((len(x), nu)))
    seen = np.abs(y).max(axis=0) + np.abs(drawn[1][..., problem.model.nw :]).max(axis=(0, 1))
    rest = [output(np.zeros(problem.model.nx), np.zeros(nu), p).toarray().ravel() for p in problem.design.spread()]
    if (np.abs(rest) > MODEL_AT_REST * seen).any():
        raise InputError("measurement", "outputs that are not 0 at rest", "0 at every design", "Subtract those.")
    room = PREVIEW_ROOM * np.r_[np.tile(seen, length), np.tile(np.maximum(-lower, upper), length)]
    box = as_set((-room, room), "X", len(room))
    X = problem.X
    return replace(
        problem, model=_with_history(problem.model, output, length), scenarios=scenarios, measurement=None,
        hidden=problem.model.nx, objective=previewed_objective(problem.objective, length, channels=ny + nu),
        X=X.followed_by(-room, room) if isinstance(X, DesignLimits) else X.cartesian_product(box),
        output_limits=previewed_output_limits(problem.output_limits, problem.model.nx),
    )  # fmt: skip


@dataclass(frozen=True, eq=False)
class HistoryScenarios(Immutable):
    """Scenarios of a model with a history."""

    own: Scenarios
    measurement: Measurement
    model: Model  # without the history
    length: int

    def sample(self, runs: int, steps: int, rng: np.random.Generator) -> tuple[Array, Array]:
        """Initial states (runs, nx + m (ny + nu)), disturbances (runs, steps, nw + ny)."""
        x0, w = self.own.sample(runs, steps, rng)
        assert self.model.design is not None
        h = self.measurement.at(self.model.nx, self.model.nu, self.model.design.centre)
        v = self.measurement.drawn(runs, steps + 1, rng).noise
        assert v is not None
        v = np.broadcast_to(v[:, : steps + 1], (runs, steps + 1, v.shape[2]))
        first = h.of(x0, np.zeros((runs, self.model.nu))) + v[:, 0]
        before = np.zeros((runs, (self.length - 1) * first.shape[1] + self.length * self.model.nu))
        return np.hstack([x0, first, before]), np.concatenate([w, v[:, 1:]], axis=2)


def warm_start_of_outputs(
    problem: CoDesignProblem, known: CoDesignProblem, rng: np.random.Generator, *, gamma: float = 0.99
) -> ActorCritic:
    """Agent that imitates LQG at designs all over the box.

    Parameters
    ----------
    problem, known : CoDesignProblem
        With the history, and the one that it was made of.
    """
    data = []
    for v in rng.random((32, known.design.dim)):  # designs
        with suppress(NotStabilisableError):
            p = known.design.project(known.design.from_unit(v))
            data.append(_loops(problem, known, p, rng, gamma))
    if not data:
        raise InputError("problem", "no design at which LQG keeps a run", "one that it stabilises", "Pass an agent.")
    seen, actions, values = (np.concatenate(part) for part in zip(*data))
    least, most = problem.observation_bounds
    low, high = seen.min(axis=0), seen.max(axis=0)
    high = np.maximum(high, low + np.finfo(np.float32).eps * (most - least))
    nz = least.size - known.design.dim
    bounds = (np.r_[low[:nz], least[nz:]], np.r_[high[:nz], most[nz:]])
    return fit_actor_critic(
        seen, actions, values, action_bounds=problem.action_bounds, input_bounds=bounds, rng=rng
    )  # fmt: skip


def _loops(
    problem: CoDesignProblem, known: CoDesignProblem, p: Array, rng: np.random.Generator, gamma: float
) -> tuple[Array, Array, Array]:
    """What LQG of a design sees (k, ·), does (k, nu) and is worth from there on (k,)."""
    runs, nx, nu = 16, known.model.nx, known.model.nu
    lqg = observed(known, saturated_lqr(known, p), p)
    z, w = problem.scenarios.sample(runs, problem.steps, rng)
    ny, last = w.shape[2] - known.model.nw, z.shape[1] - nu * (z.shape[1] - nx) // (nu + w.shape[2] - known.model.nw)
    step = problem.model.stepper(p, batch=runs)
    seen, actions, rewards = [], [], []
    for k in range(problem.steps):
        u = lqg(y=z[:, nx : nx + ny], u_prev=z[:, last : last + nu])
        after = np.asarray(step(z, u, w[:, k]))
        seen.append(z[:, nx:])
        actions.append(u)
        rewards.append(np.asarray(problem.objective.rewards(after, u, z, p)))
        z = after
    values = np.array(rewards)
    for k in range(len(values) - 2, -1, -1):
        values[k] += gamma * values[k + 1]
    kept = np.isfinite(z).all(axis=1) & (np.abs(z) <= problem.limit).all(axis=1)
    histories = np.array(seen)[:, kept].reshape(-1, problem.model.nx - nx)
    given = np.tile(p, (len(histories), 1))
    return np.hstack([histories, given]), np.array(actions)[:, kept].reshape(-1, nu), values[:, kept].ravel()


def _symbolic(model: Model, output: Any) -> ca.Function:
    """Function (x, u, p) → y of CasADi columns."""
    x, u, p = (ca.SX.sym(name, n) for name, n in zip("xup", (model.nx, model.nu, model.step.numel_in(3))))
    if isinstance(output, Plant):
        return output.output
    if not isinstance(output, np.ndarray):
        cure = "Name them in the plant: Plant(outputs=…)."
        raise InputError("measurement", "a Python function", "outputs of a Plant, or a matrix C", cure)
    return ca.Function("y", [x, u, p], [ca.DM(output) @ x])


def _with_history(model: Model, output: ca.Function, length: int) -> Model:
    """Model with state (x, outputs, inputs) and disturbance (w, v)."""
    if not isinstance(model, LinearModel) and model.plant.continuous and model.method != "rk4":
        got = f"a model by {model.method}, whose step is no expression"
        raise InputError("model", got, 'one by Runge–Kutta: discretise(plant, method="rk4")')
    step = model.step if isinstance(model, LinearModel) else model.step.expand()
    nx, nu, nw, ny = model.nx, model.nu, model.nw, output.numel_out(0)
    z, u, w = (ca.SX.sym(name, n) for name, n in zip("zuw", (nx + length * (ny + nu), nu, nw + ny)))
    p = ca.SX.sym("p", step.numel_in(3))
    x, y, before = ca.vertsplit(z, [0, nx, nx + length * ny, z.numel()])
    after = step(x, u, w[:nw], p)
    latest = output(after, u, p) + w[nw:]
    moved = ca.vertcat(after, latest, y[: (length - 1) * ny], u, before[: (length - 1) * nu])
    assert model.design is not None
    return discretise(Plant(z, u, w, p, moved, model.design, model.dt, continuous=False), sampling_guard="ignore")
