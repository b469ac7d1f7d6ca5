"""Models with disturbances known ahead as states, in a shift register.

References
----------
Tomizuka, "Optimal continuous finite preview problem", IEEE TAC 20(3), 1975; for suspensions Louam, Wilson and Sharp,
"Optimal control of a vehicle suspension incorporating the time delay between front and rear wheel inputs", Vehicle
System Dynamics 17(6), 1988.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any, overload

import casadi as ca
import numpy as np

from ccdtools.arrays import Array
from ccdtools.exceptions import InputError
from ccdtools.plants.discretisation import discretise
from ccdtools.plants.integration_error import IntegrationError
from ccdtools.plants.linear_model import LinearModel
from ccdtools.plants.models import Model
from ccdtools.plants.plant import Plant
from ccdtools.plants.sampled_model import SampledModel
from ccdtools_ground.door import as_count, as_different, as_instance


@overload
def with_preview(model: Plant, steps: int, *, channels: Sequence[int] | None = None) -> Plant: ...


@overload
def with_preview(model: Model, steps: int, *, channels: Sequence[int] | None = None) -> Model: ...


def with_preview(model: Model | Plant, steps: int, *, channels: Sequence[int] | None = None) -> Model | Plant:
    """Model with state (x, w_k, …, w_{k+N−1}) and disturbance w_{k+N}, N samples ahead.

    Its LQR is optimal preview control, and whatever else sees its state sees the preview. It has as many inputs and
    disturbances as before, and stays symbolic in its design.

    Parameters
    ----------
    model : LinearModel, SampledModel or Plant
        Of a plant comes the discrete plant with its sampling time: exact where it is linear, else by its Runge–Kutta
        steps.
    steps : int
        N; the first of the samples that are known is the present one.
    channels : sequence of int, optional
        Which disturbances are known ahead, from 0; all by default. The others act at once, as before.

    Returns
    -------
    LinearModel, SampledModel or Plant
        What was given; nx + N·(number of channels) states.

    Raises
    ------
    InputError
        If an argument is of the wrong kind or size, or the model is integrated by collocation, whose step is no
        expression.

    Examples
    --------
    >>> ahead = with_preview(discretise(plant), 10)
    >>> K, _ = lqr(*ahead.matrices(p)[:2], Q=previewed_objective(objective, 10).Q, R=objective.R)  # doctest: +SKIP
    """
    kinds = "a LinearModel, a SampledModel or a Plant"
    given: Any = as_instance("model", model, (LinearModel, SampledModel, Plant), kinds)
    steps = as_count("steps", steps)
    known = as_channels(channels, model.nw)
    if isinstance(given, LinearModel):
        return _linear(given, steps, known)
    if isinstance(given, SampledModel):
        return _sampled(given, steps, known)
    step = discretise(given, sampling_guard="ignore").step if given.linear else given.step  # exact where it can be
    return _plant(given, step, steps, known)


def as_channels(channels: Sequence[int] | None, nw: int) -> tuple[int, ...]:
    """Disturbances known ahead, in the order given, checked against nw."""
    if nw == 0:
        raise InputError("model", "no disturbance", "one whose disturbance is known ahead")
    if channels is None:
        return tuple(range(nw))
    known = as_different("channels", channels, 0, nw - 1)
    if not known:
        raise InputError("channels", "[]", f"different whole numbers from 0 to {nw - 1}")
    return known


def previewed_state(x: Any, w: Any, channels: Sequence[int] | None = None) -> Array:
    """(x, w_k, …, w_{k+N−1}) (..., nx + N·channels) from x (..., nx) and w (..., N, nw)."""
    w = np.asarray(w, dtype=float)
    known = w if channels is None else w[..., list(channels)]
    return np.concatenate([x, known.reshape(*known.shape[:-2], -1)], axis=-1)


def _linear(model: LinearModel, steps: int, known: tuple[int, ...]) -> LinearModel:
    """Linear model with the register."""
    x, u, w, p, after = _registered(model.step, steps, known)
    z = ca.vertcat(x, u, w)
    J = ca.substitute(ca.jacobian(after, z), p, model.symbols)
    A, B, E = ca.horzsplit(J, [0, x.numel(), x.numel() + model.nu, z.numel()])
    c = ca.vertcat(model.c, ca.SX.zeros(x.numel() - model.nx, 1))
    names = (*model.state_names, *_ahead(steps, known))
    return LinearModel(model.symbols, A, B, E, model.dt, model.design, c, names, model.input_names)


def _sampled(model: SampledModel, steps: int, known: tuple[int, ...]) -> SampledModel:
    """Sampled model with the register, as a discrete plant."""
    if model.plant.continuous and model.method != "rk4":
        got = f"a model by {model.method}, whose step is no expression"
        raise InputError("model", got, 'one by Runge–Kutta: discretise(plant, method="rk4")')
    plant = _plant(model.plant, model.step.expand(), steps, known)
    length = len(known) * steps
    error = model.error
    if error is not None:
        ahead = np.tile(_padded(error.w, model.nw)[list(known)], steps)
        bound = np.r_[error.bound, np.zeros(length)]
        error = IntegrationError(bound, error.relative, np.r_[error.x, ahead], error.u, _padded(error.w, model.nw),
                                 error.p)  # fmt: skip
    scale = None if model.scale is None else np.r_[model.scale, np.ones(length)]
    return replace(model, plant=plant, method="rk4", error=error, scale=scale, errors=False)


def _padded(w: Array, size: int) -> Array:
    """Disturbance with zeros appended."""
    return np.asarray(np.r_[w, np.zeros(size - len(w))])


def _registered(step: ca.Function, steps: int, known: tuple[int, ...]) -> tuple[ca.SX, ...]:
    """Symbols x, u, w, p of a step with the register, and its next state."""
    nx = step.numel_in(0)
    x = ca.SX.sym("x", nx + len(known) * steps)
    u, w, p = (ca.SX.sym(name, step.numel_in(i)) for i, name in enumerate("uwp", start=1))
    register = x[nx:]
    acting = ca.SX(w)
    for i, channel in enumerate(known):
        acting[channel] = register[i]
    return x, u, w, p, ca.vertcat(step(x[:nx], u, acting, p), register[len(known) :], w[list(known)])


def _ahead(steps: int, known: tuple[int, ...]) -> list[str]:
    """Names of the disturbances in the register."""
    return [f"w{channel + 1} in {k} samples" if k else f"w{channel + 1}" for k in range(steps) for channel in known]


def _plant(plant: Plant, step: ca.Function, steps: int, known: tuple[int, ...]) -> Plant:
    """Plant of a step with the register."""
    x, u, w, p, after = _registered(step, steps, known)
    return Plant(
        x, u, w, p, after, plant.design, plant.dt, continuous=False,
        state_names=[*plant.state_names, *_ahead(steps, known)], input_names=plant.input_names,
        outputs=plant.output(x[: plant.nx], u, p) if plant.ny else (), output_names=plant.output_names,
        output_limits=plant.output_limits if plant.ny else None,
    )  # fmt: skip
