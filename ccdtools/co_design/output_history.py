"""Problems whose policies see the last outputs and inputs."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cache, partial
from typing import Any

import casadi as ca
import numpy as np

from ccdtools.arrays import Array, Immutable
from ccdtools.co_design.design_controllers import saturated_lqr
from ccdtools.co_design.loops import loops_of
from ccdtools.co_design.measured import observed
from ccdtools.co_design.preview import previewed_objective, previewed_output_limits
from ccdtools.co_design.problem import CoDesignProblem, Scenarios
from ccdtools.co_design.tolerances import LEAST_ACTION, PREVIEW_ROOM
from ccdtools.design_limits import DesignLimits
from ccdtools.estimation.measurement import Measurement
from ccdtools.exceptions import InputError
from ccdtools.plants.black_box import BlackBox
from ccdtools.plants.discretisation import discretise
from ccdtools.plants.linear_model import LinearModel
from ccdtools.plants.models import Model
from ccdtools.plants.plant import Plant
from ccdtools.plants.sampled_model import SampledModel
from ccdtools.plants.simulated_model import SimulatedModel
from ccdtools.plants.tolerances import MODEL_AT_REST
from ccdtools_ground.door import as_count, as_instance
from invariant_sets.system_checks import as_set
from learning.networks import ActorCritic
from learning.warm_start import fit_actor_critic
from mpc import NotStabilisableError


def history_problem(problem: CoDesignProblem, length: int) -> CoDesignProblem:
    """Problem whose policies see the last outputs and inputs.

    Its state is (x, y_k, …, y_{k−m+1}, u_{k−1}, …, u_{k−m}), of which x is `hidden`; its disturbance is (w, v). What is
    measured at the start is that of the design in the middle of the box. Where a step or an output is no expression, of
    a simulator, a step by collocation or a Python function, the problem's model is a simulator, too.

    Parameters
    ----------
    problem : CoDesignProblem
        With a `measurement`.
    length : int
        m samples.

    Raises
    ------
    InputError
        If the problem measures nothing, or its outputs are not 0 at rest.
    """
    as_instance("problem", problem, CoDesignProblem, "a CoDesignProblem")
    length = as_count("length", length)
    if problem.measurement is None:
        raise InputError("problem", "one without a measurement", "CoDesignProblem(measurement=Measurement(…))")
    measurement, nx, nu = problem.measurement, problem.model.nx, problem.model.nu
    lower, upper = problem.input_bounds

    def first(y: Array) -> Array:
        """History (n, ·) of a first measurement."""
        return np.hstack([y, np.zeros((len(y), (length - 1) * y.shape[1] + length * nu))])

    scenarios = SensedScenarios(problem, first)
    v = scenarios.sample(256, problem.steps, np.random.default_rng(0))[1][..., problem.model.nw :]
    x = np.random.default_rng(0).uniform(-1, 1, (1024, nx)) * problem.state_scale
    y = measurement.at(nx, nu, problem.design.centre).of(x, np.zeros((len(x), nu)))
    seen = np.abs(y).max(axis=0) + np.abs(v).max(axis=(0, 1))
    zero = np.zeros((1, nx)), np.zeros((1, nu))
    rest = [measurement.at(nx, nu, p).of(*zero)[0] for p in problem.design.spread()]
    if (np.abs(rest) > MODEL_AT_REST * seen).any():
        raise InputError("measurement", "outputs that are not 0 at rest", "0 at every design", "Subtract those.")
    room = PREVIEW_ROOM * np.r_[np.tile(seen, length), np.tile(np.maximum(-lower, upper), length)]
    modelled = partial(_with_history, problem.model, measurement, y.shape[1], length)
    return with_memory(problem, scenarios, room, room, 0, modelled)


def with_memory(
    problem: CoDesignProblem, scenarios: SensedScenarios, room: Array, size: Array, hidden: int,
    modelled: Callable[[Array], Model | SimulatedModel],
) -> CoDesignProblem:  # fmt: skip
    """Problem whose policies see a memory of what was measured.

    Parameters
    ----------
    room : (m,) array
        Bounds of the memory.
    size : (m,) array
        Extents of the memory, which differences of a simulator are parts of.
    hidden : int
        So many of its first numbers the policy does not see.
    modelled : callable
        Model with the memory, from the extents of its states, inputs and disturbances.
    """
    w = np.abs(scenarios.sample(256, problem.steps, np.random.default_rng(0))[1]).max(axis=(0, 1))
    extent = np.r_[problem.state_scale, size, np.abs(problem.input_bounds).max(axis=0), w + (w == 0)]
    X = problem.X
    box = as_set((-room, room), "X", len(room))
    return replace(
        problem, model=modelled(extent), scenarios=scenarios, measurement=None, hidden=problem.model.nx + hidden,
        objective=previewed_objective(problem.objective, len(room)), 
        X=X.followed_by(-room, room) if isinstance(X, DesignLimits) else X.cartesian_product(box),
        output_limits=previewed_output_limits(problem.output_limits, problem.model.nx),
    )  # fmt: skip


@dataclass(frozen=True, eq=False)
class SensedScenarios(Immutable):
    """Scenarios of a model with a memory of what is measured."""

    problem: CoDesignProblem  # without the memory
    first: Callable[[Array], Array]  # memory (n, m) of the first measurements (n, ny)

    @property
    def own(self) -> Scenarios:
        """Scenarios without the memory."""
        return self.problem.scenarios

    def sample(self, runs: int, steps: int, rng: np.random.Generator) -> tuple[Array, Array]:
        """Initial states (runs, nx + m), disturbances (runs, steps, nw + ny)."""
        problem = self.problem
        x0, w = self.own.sample(runs, steps, rng)
        h = problem.measurement.at(problem.model.nx, problem.model.nu, problem.design.centre)
        v = problem.measurement.drawn(runs, steps + 1, rng).noise
        assert v is not None
        v = np.broadcast_to(v[:, : steps + 1], (runs, steps + 1, v.shape[2]))
        y = h.of(x0, np.zeros((runs, problem.model.nu))) + v[:, 0]
        return np.hstack([x0, self.first(y)]), np.concatenate([w, v[:, 1:]], axis=2)


def in_expressions(model: Any, output: Any) -> bool:
    """Whether steps and outputs are explicit expressions."""
    explicit = isinstance(model, SampledModel) and (not model.plant.continuous or model.method == "rk4")
    return (explicit or isinstance(model, LinearModel)) and isinstance(output, Plant | np.ndarray)


def warm_start_of_outputs(
    problem: CoDesignProblem, known: CoDesignProblem, rng: np.random.Generator, *, gamma: float = 0.99
) -> ActorCritic:
    """Agent that imitates LQG at designs all over the box.

    An entry that LQG does not vary is seen in units of its limits.

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
    if not any(len(part[0]) for part in data):
        raise InputError("problem", "no design at which LQG keeps a run", "one that it stabilises", "Pass an agent.")
    seen, actions, values = (np.concatenate(part) for part in zip(*data))
    least, most = problem.observation_bounds
    low, high = seen.min(axis=0), seen.max(axis=0)
    kept = high - low < LEAST_ACTION * (most - least)
    kept[least.size - known.design.dim :] = True  # the design
    bounds = (np.where(kept, least, low), np.where(kept, most, high))
    return fit_actor_critic(
        seen, actions, values, action_bounds=problem.action_bounds, input_bounds=bounds, rng=rng
    )  # fmt: skip


def _loops(
    problem: CoDesignProblem, known: CoDesignProblem, p: Array, rng: np.random.Generator, gamma: float
) -> tuple[Array, Array, Array]:
    """What LQG of a design sees (k, ·), does (k, nu) and is worth from there on (k,), with noise on its inputs.

    The noise is as large as what it does.

    References
    ----------
    Laskey, Lee, Fox, Dragan, Goldberg, "DART: noise injection for robust imitation learning", CoRL 2017.
    """
    nx, nu = known.model.nx, known.model.nu
    lqg = observed(known, saturated_lqr(known, p), p)
    z, w = problem.scenarios.sample(16, problem.steps, rng)
    ny, last = w.shape[2] - known.model.nw, z.shape[1] - nu * (z.shape[1] - nx) // (nu + w.shape[2] - known.model.nw)

    def law(z: Array) -> Array:
        """Inputs (n, nu) of the filter and its law."""
        return np.asarray(lqg(y=z[:, nx : nx + ny], u_prev=z[:, last : last + nu]))

    def noisy(_: Array, u: Array) -> Array:
        """Inputs with noise."""
        return np.asarray(u + np.sqrt(np.mean(u**2, axis=0)) * rng.standard_normal(u.shape))

    histories, actions, values = loops_of(problem, law, p, z, w, noisy).samples(gamma)
    return np.hstack([histories[:, nx:], np.tile(p, (len(histories), 1))]), actions, values


def _with_history(model: Any, measurement: Measurement, ny: int, length: int, extent: Array) -> Model | SimulatedModel:
    """Model with state (x, outputs, inputs) and disturbance (w, v); a simulator where it is no expression."""
    nx, nu, nw, output = model.nx, model.nu, model.nw, measurement.output
    size = nx + length * (ny + nu)
    ends = [0, nx, nx + (length - 1) * ny, nx + length * ny, size - nu, size]  # the last output and input are forgotten
    if not in_expressions(model, output):
        measured = cache(lambda p: measurement.at(nx, nu, np.array(p)).of)

        def advance(z: Array, u: Array, w: Array, p: Array) -> Array:
            """States (n, size) one sample later."""
            x, y, _, before, _ = np.split(z, ends[1:-1], axis=1)
            after = np.asarray(model.stepper(p, batch=len(x))(x, u, w[:, :nw]))
            return np.hstack([after, measured(tuple(p))(after, u) + w[:, nw:], y, u, before])

        return SimulatedModel(BlackBox(advance, size, nu, model.dt, nw + ny, model.design, batched=True), extent)
    step = model.step if isinstance(model, LinearModel) else model.step.expand()
    z, u, w, p = (ca.SX.sym(name, n) for name, n in zip("zuwp", (size, nu, nw + ny, step.numel_in(3))))
    x, y, _, before, _ = ca.vertsplit(z, ends)
    after = step(x, u, w[:nw], p)
    latest = output.output(after, u, p) if isinstance(output, Plant) else ca.DM(output) @ after
    moved = ca.vertcat(after, latest + w[nw:], y, u, before)
    assert model.design is not None
    return discretise(Plant(z, u, w, p, moved, model.design, model.dt, continuous=False), sampling_guard="ignore")
