"""Closed-loop simulation of a plant, a controller and a disturbance."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ccdtools.arrays import Array
from ccdtools.controllers.controllers import Controller
from ccdtools.controllers.signals import Driver, Reference
from ccdtools.disturbances.disturbance import Disturbance
from ccdtools.estimation.measurement import Measurement, as_measurement
from ccdtools.exceptions import CCDError, InputError
from ccdtools.plants.design_space import NO_DESIGN, DesignSpace
from ccdtools.plants.models import Simulable, as_simulable
from ccdtools.plants.simulated_model import stepped
from ccdtools.progress import bar
from ccdtools.tolerances import DIVERGENCE_LIMIT
from ccdtools.trajectory import Trajectory
from ccdtools_ground.door import as_count, as_finite, as_floats, as_generator, shown
from ccdtools_ground.user_functions import at_step, stopped

BATCHED = "It is called with the states (n, nx) of all runs and returns (n, nu): x[:, :1] for x[0], x @ K.T for K @ x."


def simulate(
    plant: Simulable | Any,
    controller: Controller,
    *,
    x0: ArrayLike,
    steps: int,
    disturbance: ArrayLike | Disturbance | None = None,
    design: ArrayLike | None = None,
    limit: ArrayLike | None = None,
    reference: Reference | ArrayLike | None = None,
    output: ArrayLike | Measurement | Any = None,
    rng: np.random.Generator | None = None,
    progress: bool = False,
) -> Trajectory:
    """Closed-loop trajectories of `plant` under ``u = controller(x)``.

    Parameters
    ----------
    plant : Plant, LinearModel, SampledModel, TwinPlant or control.StateSpace
        A StateSpace must be discrete.
    controller : callable
        (n, nx) → (n, nu). One that needs more than the state, or has memory, is served as
        `ccdtools.controllers.controllers` says; the one given is not changed.
    x0 : (nx,) or (n, nx) array_like
        Initial states.
    steps : int
        Number of samples T.
    disturbance : (T, nw) or (n, T, nw) array_like, or Disturbance, optional
        Held over each sample; a `Disturbance` is sampled with `rng`. Zero by default.
    design : (np,) array_like
        Required when the plant has design parameters; for a `LearnedPolicy`, exported or not, its own.
    limit : (nx,) array_like, optional
        Divergence limit on |x|; a run beyond it, or not finite, is stopped and counted. By default 1e6 times the
        largest that a state is in any run at the start and in the first nx samples, and at least 1e6.
    reference : Reference, or (nx,) or (T, nx) array_like, optional
        State reference for controllers that track one; `Reference(x, u)` where an input belongs to it.
    output : Measurement, or (ny, nx) array_like, Plant, or callable, optional
        What is measured, for controllers that need it: y = C x, a plant's outputs, or a function; `Measurement` adds
        noise. The state itself by default.
    rng : numpy.random.Generator, optional
        Required by a random disturbance and by random noise of the measurement, which is the same for every
        controller and does not change what the disturbance is.
    progress : bool
        Show a progress bar.

    Raises
    ------
    InputError
        On wrong shapes, a missing design, reference or generator, a policy for another design, a preview longer than
        the record, or a controller that returns the wrong shape or NaN.
    SimulatorError
        If the plant stops in a step; what was simulated before is `kept` in it.
    """
    plant = as_simulable(plant)
    p = _design(plant, design)
    _check_own_design(controller, p, plant.design)
    steps = as_count("steps", steps)
    try:
        measurement = as_output(plant, output)
        given = _drawn(plant, x0, disturbance, steps, rng)
        x, w = matched_runs(plant, x0, given, steps)
        bound = _bound(limit, x)
        sensor = None if measurement is None else measurement.sensor(plant, p, len(x), steps, rng)
        driver = Driver(
            controller, len(x), plant.nu, disturbances=_record(given, w), recorded=disturbance is not None,
            reference=as_reference(plant, reference), output=sensor,
        )  # fmt: skip
        return _run(plant, driver, x, w, p, bound, plant.nx if limit is None else 0, progress)
    except MemoryError:
        raise InputError("steps", f"{steps}, which do not fit into memory", "fewer steps, or fewer runs") from None


def _run(
    plant: Simulable, driver: Driver, x: Array, w: Array, p: Array, bound: Array, first: int, progress: bool
) -> Trajectory:  # fmt: skip
    """Trajectories from x (n, nx) under w (n, T, nw); the bound (nx,) grows with the states of the first samples."""
    n, steps = w.shape[:2]
    edge = np.minimum(bound, np.finfo(float).max)
    step = plant.stepper(p, batch=n)
    states = np.empty((n, steps + 1, plant.nx))
    inputs = np.zeros((n, steps, plant.nu))
    diverged_at = np.full(n, -1)
    states[:, 0] = x
    running, whole = diverged_at < 0, True
    own = getattr(plant, "model", plant)  # of a plant of a model, that
    names = (*getattr(own, "state_names", ()), *getattr(own, "input_names", ()))
    names = names if len(names) == plant.nx + plant.nu else ()

    def logged(k: int) -> Trajectory:
        """Trajectories of the first k steps."""
        outputs = np.stack(driver.heard[:k], axis=1) if driver.heard else None
        return Trajectory(states[:, : k + 1], inputs[:, :k], w[:, :k], diverged_at, p, plant.dt, outputs, names)

    for k in bar(range(steps), label="simulating", total=steps, progress=progress):
        u = _asked(driver, k, x, plant.nu, running)
        inputs[:, k] = u if whole else np.where(running[:, None], u, 0.0)
        driver.remember(inputs[:, k])
        try:
            x_next = stepped(step, x, u, w[:, k])
        except InputError as error:
            died = at_step(k, error)
            died.kept = logged(k) if k else None
            raise died from error
        if k < first:
            edge = np.maximum(edge, _beyond(np.where(np.isfinite(x_next), x_next, 0.0)))
        inside = np.abs(x_next) <= edge
        if whole and inside.all():
            x = np.array(x_next)
        else:
            diverged_at[running & ~inside.all(axis=1)] = k
            x = np.where(running[:, None], np.where(np.isfinite(x_next), x_next, np.sign(x) * edge), x)
            running, whole = diverged_at < 0, False
        states[:, k + 1] = x
    return logged(steps)


def _asked(driver: Driver, k: int, x: Array, nu: int, running: NDArray[np.bool_]) -> Array:
    """Inputs (n, nu) that the controller returns at the states x (n, nx), finite for running runs."""
    shape = (len(x), nu)
    try:
        given = driver(k, x)
    except CCDError:
        raise
    except (TypeError, ValueError, IndexError) as error:
        if k > 0:
            raise
        at = f" for states of shape {x.shape}"
        raise stopped("controller", driver, error, f"inputs {shape}", BATCHED, at=at) from error
    try:
        if np.iscomplexobj(given):
            raise TypeError
        u: Array = np.asarray(given, dtype=float)
    except (TypeError, ValueError, RuntimeError):
        raise InputError("controller", f"{shown(given)} as its inputs", f"an array {shape}") from None
    if u.shape != shape:
        raise InputError("controller", f"inputs of shape {u.shape}", f"{shape}", BATCHED)
    if not (np.isfinite(u).all() or np.isfinite(u[running]).all()):
        raise InputError("controller", f"an input that is not finite at step {k}", "finite ones")
    return u


def _design(plant: Simulable, design: ArrayLike | None) -> Array:
    """Design (np,) to simulate at; empty for a plant without one."""
    space = plant.design or NO_DESIGN
    if design is None and space.dim:
        raise InputError("design", "nothing", f"values for {', '.join(space.names)}")
    return space.check_one(() if design is None else design)


def _check_own_design(controller: Any, p: Array, space: DesignSpace | None) -> None:
    """Raise an `InputError` if the controller was made for another design."""
    own = getattr(controller, "design", None)
    if own is None or space is None or isinstance(controller, type):
        return
    if np.shape(own) != p.shape or not np.allclose(space.to_unit(own), space.to_unit(p), rtol=0, atol=1e-6):
        raise InputError(
            "design", shown(p), f"{shown(np.asarray(own))}, the design of the policy",
            "Use LearnedPolicy(agent, design), of the agent that it was made of, for another.",
        )  # fmt: skip


def _bound(limit: ArrayLike | None, x: Array) -> Array:
    """Divergence limit (nx,) for runs from x (n, nx)."""
    nx = x.shape[1]
    if limit is None:
        return _beyond(x)
    bound = as_floats("limit", limit)
    if bound.shape not in ((), (1,), (nx,)) or not (bound > 0).all():
        raise InputError("limit", f"{bound.tolist()} of shape {bound.shape}", f"({nx},) positive numbers")
    return np.broadcast_to(bound, (nx,))


def _beyond(x: Array) -> Array:
    """Divergence limit (nx,) in sizes of states (n, nx)."""
    with np.errstate(over="ignore"):
        return np.asarray(np.minimum(DIVERGENCE_LIMIT * np.abs(x).max(axis=0, initial=1.0), np.finfo(float).max))


def as_reference(plant: Simulable, reference: Reference | ArrayLike | None) -> Reference | None:
    """Reference, checked against the sizes of the plant."""
    if reference is None:
        return None
    reference = reference if isinstance(reference, Reference) else Reference(reference)
    reference.check(plant.nx, plant.nu)
    return reference


def as_output(plant: Simulable, output: Any) -> Measurement | None:
    """Measured output, checked against the sizes of the plant."""
    if output is None:
        return None
    measurement = as_measurement(output)
    measurement.check(plant.nx, plant.nu)
    return measurement


def _drawn(plant: Simulable, x0: ArrayLike, disturbance: Any, steps: int, rng: Any) -> Any:
    """Disturbance as an array, sampled if a `Disturbance`, zero if None."""
    if disturbance is None:
        return np.zeros((1, steps, plant.nw))
    if not hasattr(disturbance, "sample"):
        return disturbance
    if isinstance(disturbance, type):
        raise InputError("disturbance", shown(disturbance), "an object of it")
    return disturbance.sample(len(_states(plant, x0)), steps, as_generator("rng", rng))


def _record(given: ArrayLike, w: Array) -> Array:
    """Disturbances (n, T', nw) for previews: those met and what follows."""
    whole = np.asarray(given)
    if whole.shape[1 if whole.ndim == 3 else 0] == w.shape[1]:
        return w
    whole = whole[:, None] if whole.ndim == 1 else whole
    later = np.broadcast_to(whole[..., w.shape[1] :, :], (len(w), whole.shape[-2] - w.shape[1], w.shape[2]))
    return np.concatenate([w, later], axis=1)


def _states(plant: Simulable, x0: ArrayLike) -> Array:
    """Initial states (n, nx)."""
    given = as_floats("x0", x0)
    x = np.atleast_2d(given)
    if x.ndim != 2 or x.shape[1] != plant.nx or len(x) == 0:
        raise InputError("x0", f"shape {given.shape}", f"({plant.nx},) or (n, {plant.nx})")
    return as_finite("x0", x)


def matched_runs(plant: Simulable, x0: ArrayLike, disturbance: ArrayLike, steps: int) -> tuple[Array, Array]:
    """Initial states (n, nx) and disturbances (n, T, nw) of equal number."""
    x = _states(plant, x0)
    w = as_floats("disturbance", disturbance)
    if w.ndim == 1 and plant.nw == 1:
        w = w[:, None]
    if w.ndim == 2:
        w = w[None]
    if w.ndim != 3 or w.shape[1] < steps or w.shape[2] != plant.nw or (len(w) > 1 and 1 < len(x) != len(w)):
        expected = f"({steps}, {plant.nw}) or ({len(x)}, {steps}, {plant.nw})"
        raise InputError("disturbance", f"shape {np.shape(w)}", expected)
    as_finite("disturbance", w)
    n = max(len(x), len(w))
    return (
        np.ascontiguousarray(np.broadcast_to(x, (n, plant.nx))),
        np.ascontiguousarray(np.broadcast_to(w[:, :steps], (n, steps, plant.nw))),
    )
