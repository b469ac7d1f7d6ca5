"""Closing any loop: a plant, a controller, a disturbance."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray
from tqdm import trange

from ccdtools.arrays import Array
from ccdtools.co_design.objective import QuadraticObjective
from ccdtools.controllers.controllers import Controller
from ccdtools.disturbances.disturbance import Disturbance
from ccdtools.exceptions import InputError
from ccdtools.plants.design_space import DesignSpace
from ccdtools.plants.discretisation import LinearModel

Step = Callable[[Array, Array, Array], Array]


class Simulable(Protocol):
    """What `simulate` asks of a plant."""

    @property
    def nx(self) -> int:
        """Number of states."""
        ...

    @property
    def nu(self) -> int:
        """Number of inputs."""
        ...

    @property
    def nw(self) -> int:
        """Number of disturbances."""
        ...

    @property
    def dt(self) -> float:
        """Sampling time [s]."""
        ...

    @property
    def design(self) -> DesignSpace | None:
        """The box of designs, if any."""
        ...

    def stepper(self, p: Array, *, batch: int) -> Step:
        """(x (n, nx), u (n, nu), w (n, nw)) → x⁺ (n, nx) at one design, for n = `batch`."""
        ...


@dataclass(frozen=True, eq=False)
class Trajectory:
    """Closed-loop runs.

    Attributes
    ----------
    states : (n, T + 1, nx) array
    inputs : (n, T, nu) array
        Inputs as applied.
    disturbances : (n, T, nw) array
    diverged_at : (n,) int array
        First step after which a run had left `limit`, or −1. Such a run is stopped there: its later states
        repeat the last one and its later inputs are zero.
    design : (np,) array
    dt : float
        Sampling time [s].
    """

    states: Array
    inputs: Array
    disturbances: Array
    diverged_at: NDArray[np.int64]
    design: Array
    dt: float

    @property
    def diverged(self) -> NDArray[np.bool_]:
        """Runs that left the divergence limit, (n,)."""
        return self.diverged_at >= 0

    @property
    def time(self) -> Array:
        """Sample times [s], (T + 1,)."""
        return self.dt * np.arange(self.states.shape[1], dtype=float)

    def rewards(self, objective: QuadraticObjective) -> Array:
        """Rewards (n, T); zero after a run was stopped."""
        rewards = objective.rewards(self.states[:, 1:], self.inputs)
        steps = np.arange(rewards.shape[1])
        over = self.diverged[:, None] & (steps > self.diverged_at[:, None])
        return np.where(over, 0.0, rewards)

    def returns(self, objective: QuadraticObjective) -> Array:
        """Undiscounted returns (n,); read them together with `diverged`."""
        return self.rewards(objective).sum(axis=1)


def simulate(
    plant: Simulable | Any,
    controller: Controller,
    *,
    x0: ArrayLike,
    steps: int,
    disturbance: ArrayLike | Disturbance | None = None,
    design: ArrayLike | None = None,
    limit: ArrayLike | None = None,
    rng: np.random.Generator | None = None,
    progress: bool = False,
) -> Trajectory:
    """Closed-loop trajectories of `plant` under ``u = controller(x)``.

    Parameters
    ----------
    plant : Plant, LinearModel, TwinPlant or control.StateSpace
        A StateSpace must be discrete.
    controller : callable
        (n, nx) → (n, nu). One with memory has ``reset(n)``, called once at the start.
    x0 : (nx,) or (n, nx) array_like
        Initial states.
    steps : int
        Number of samples T.
    disturbance : (T, nw) or (n, T, nw) array_like, or Disturbance, optional
        Held over each sample; a `Disturbance` is sampled with `rng`. Zero by default.
    design : (np,) array_like
        Required when the plant has design parameters.
    limit : (nx,) array_like, optional
        Divergence limit on |x|; a run beyond it, or not finite, is stopped and counted. 1e6 by default.
    rng : numpy.random.Generator, optional
        Required by a random disturbance.
    progress : bool
        Show a progress bar.

    Raises
    ------
    InputError
        On wrong shapes, a missing design or generator, or a controller that returns the wrong shape or NaN.
    """
    if not hasattr(plant, "stepper"):
        plant = LinearModel.from_state_space(plant)
    p = _design(plant, design)
    if steps < 1:
        raise InputError(f"steps: got {steps}, expected at least 1.")
    x, w = _scenarios(plant, x0, disturbance, steps, rng)
    n = len(x)
    bound = _bound(limit, plant.nx)
    edge = np.minimum(bound, np.finfo(float).max)
    step = plant.stepper(p, batch=n)
    reset = getattr(controller, "reset", None)
    if reset is not None:
        reset(n)
    states = np.empty((n, steps + 1, plant.nx))
    inputs = np.zeros((n, steps, plant.nu))
    diverged_at = np.full(n, -1)
    states[:, 0] = x
    for k in trange(steps, desc="simulating", disable=not progress, leave=False):
        running = diverged_at < 0
        u = np.asarray(controller(x), dtype=float)
        if u.shape != (n, plant.nu):
            raise InputError(f"controller: got inputs of shape {u.shape}, expected ({n}, {plant.nu}).")
        if not np.isfinite(u[running]).all():
            raise InputError(f"controller: got an input that is not finite at step {k}, expected finite ones.")
        inputs[:, k] = np.where(running[:, None], u, 0.0)
        x_next = step(x, u, w[:, k])
        left = running & ~(np.isfinite(x_next) & (np.abs(x_next) <= bound)).all(axis=1)
        diverged_at[left] = k
        x_next = np.where(np.isfinite(x_next), x_next, np.sign(x) * edge)
        x = np.where(running[:, None], x_next, x)
        states[:, k + 1] = x
    return Trajectory(states, inputs, w, diverged_at, p, plant.dt)


def _design(plant: Simulable, design: ArrayLike | None) -> Array:
    if plant.design is None or plant.design.dim == 0:
        return np.zeros(0)
    if design is None:
        raise InputError(f"design: got nothing, expected values for {', '.join(plant.design.names)}.")
    p = plant.design.check(design)
    if p.ndim != 1:
        raise InputError(f"design: got shape {p.shape}, expected one design ({plant.design.dim},).")
    return p


def _bound(limit: ArrayLike | None, nx: int) -> Array:
    bound = np.asarray(1e6 if limit is None else limit, dtype=float)
    if bound.shape not in ((), (1,), (nx,)) or not (bound > 0).all():
        raise InputError(f"limit: got {bound} of shape {bound.shape}, expected ({nx},) positive numbers.")
    return np.broadcast_to(bound, (nx,))


def _scenarios(plant, x0, disturbance, steps, rng) -> tuple[Array, Array]:
    x = np.atleast_2d(np.array(x0, dtype=float))
    if x.ndim != 2 or x.shape[1] != plant.nx:
        raise InputError(f"x0: got shape {np.shape(x0)}, expected ({plant.nx},) or (n, {plant.nx}).")
    if not np.isfinite(x).all():
        raise InputError("x0: got a value that is not finite, expected finite states.")
    if disturbance is None:
        w = np.zeros((1, steps, plant.nw))
    elif hasattr(disturbance, "sample"):
        if rng is None:
            raise InputError("rng: got nothing, expected a numpy Generator to sample the disturbance.")
        w = disturbance.sample(len(x), steps, rng)
    else:
        w = np.array(disturbance, dtype=float)
        if w.ndim == 1 and plant.nw == 1:
            w = w[:, None]
        if w.ndim == 2:
            w = w[None]
    if w.ndim != 3 or w.shape[1] < steps or w.shape[2] != plant.nw or (len(w) > 1 and 1 < len(x) != len(w)):
        raise InputError(
            f"disturbance: got shape {np.shape(w)}, expected ({steps}, {plant.nw}) or ({len(x)}, {steps}, {plant.nw})."
        )
    if not np.isfinite(w).all():
        raise InputError("disturbance: got a value that is not finite, expected finite samples.")
    n = max(len(x), len(w))
    return (
        np.ascontiguousarray(np.broadcast_to(x, (n, plant.nx))),
        np.ascontiguousarray(np.broadcast_to(w[:, :steps], (n, steps, plant.nw))),
    )
