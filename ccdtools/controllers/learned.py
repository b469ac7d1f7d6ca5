"""Learned policy as a controller on NumPy arrays, saved without pickle."""

from __future__ import annotations

import copy
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np
import torch
from numpy.typing import ArrayLike

from ccdtools.arrays import Array, ArrayField, Immutable
from ccdtools.controllers.policy_code import PolicyCode, write_c
from ccdtools.controllers.policy_onnx import write_onnx
from ccdtools.exceptions import InputError
from ccdtools.tolerances import DESIGN_RANGE
from ccdtools_ground.door import as_finite, as_floats, as_generator, as_instance, as_vector, writable_path
from learning import checkpoint
from learning.networks import ActorCritic, Layers
from learning.tolerances import LOG_STD


@dataclass(frozen=True, eq=False, repr=False)
class LearnedPolicy(Immutable):
    """Controller u = π(x, p) of an agent at one design.

    Of an agent made for input limits U(p), the inputs lie within those of the design.

    Parameters
    ----------
    agent : ActorCritic
        It is copied: a later training of the agent is not seen.
    design : (np,) array_like
        Within the range of designs that the agent was made for.
    rng : numpy.random.Generator, optional
        Samples actions instead of taking the mean.

    Raises
    ------
    InputError
        If `agent` is none, or `design` has the wrong size, is not finite or lies outside that range.
    """

    agent: ActorCritic
    design: ArrayField
    rng: np.random.Generator | None = None
    # mean, exploration if it is a network, and middle and half width of the inputs at the design, in float64
    _mean: Layers = field(init=False)
    _std: Layers | None = field(init=False)
    _range: tuple[Array, Array] = field(init=False)

    def __post_init__(self) -> None:
        as_instance("agent", self.agent, ActorCritic, "an ActorCritic", "fit_actor_critic makes one.")
        if self.rng is not None:
            as_generator("rng", self.rng)
        self._set(design=as_vector("design", self.design))
        self._set(agent=copy.deepcopy(self.agent))
        self._check_design()
        std = self.agent.std_network
        at = (torch.tensor(self.design), self.agent.observation_offset, self.agent.observation_scale)
        self._set(_mean=self.agent.mean_network.at(*at).of(_array))
        self._set(_std=None if std is None else std.at(*at).of(_array))
        self._set(_range=tuple(map(_array, self.agent.action_range(at[0]))))

    def _check_design(self) -> None:
        size = len(self.design)
        most = len(self.agent.observation_offset) - 1
        if size > most:
            raise InputError(
                "design", f"{size} values", f"at most {most}: the agent observes {most + 1} numbers, (x, p)"
            )
        first = most + 1 - size  # the observation is (x, p)
        offset = _array(self.agent.observation_offset)[first:]
        scale = _array(self.agent.observation_scale)[first:]
        outside = np.abs(self.design - offset) > DESIGN_RANGE * scale
        if outside.any():
            i = int(np.argmax(outside))
            box = f"one in [{offset[i] - scale[i]:g}, {offset[i] + scale[i]:g}], which the agent was made for"
            raise InputError("design", f"{self.design[i]:g} as parameter {i + 1}", box)

    def __repr__(self) -> str:
        kind = "mean" if self.rng is None else "sampled"
        return f"LearnedPolicy({self.nx} states, {self.nu} inputs, {kind} action, design {self.design.tolist()})"

    def __call__(self, x: ArrayLike) -> Array:
        """Inputs (n, nu) or (nu,), within the bounds."""
        x = as_floats("x", x)
        if x.shape[-1:] != (self.nx,):
            raise InputError("x", f"shape {x.shape}", f"({self.nx},) or (n, {self.nx})")
        as_finite("x", x)
        latent = self._mean(x, np.tanh)
        if self.rng is not None:
            log_std = _array(self.agent.log_std) if self._std is None else np.clip(self._std(x, np.tanh), *LOG_STD)
            latent = latent + np.exp(log_std) * self.rng.standard_normal(latent.shape)
        middle, half = self._range
        u: Array = middle + half * np.minimum(np.maximum(latent, -1.0), 1.0)  # half the time of clip
        return u

    def sampled(self, rng: np.random.Generator) -> LearnedPolicy:
        """Stochastic policy, drawing from `rng`."""
        return LearnedPolicy(self.agent, self.design, as_generator("rng", rng))

    def to_casadi(self) -> ca.Function:
        """Mean action as the `casadi.Function` "policy", bounded: x (nx,) to u (nu,).

        CasADi differentiates it, calls it in expressions, and writes it in C: ``to_casadi().generate("policy.c")``. For
        torch, `agent` is a module with the same mean action at observations (..., nx + np) of state and design, in
        single precision, which `torch.export` takes.
        """
        x = ca.MX.sym("x", self.nx)
        latent = self._mean.of(lambda array: ca.DM(np.atleast_2d(array)))(x.T, ca.tanh).T  # a vector is a row
        middle, half = map(ca.DM, self._range)
        u = middle + half * ca.fmin(ca.fmax(latent, -1), 1)
        return ca.Function("policy", [x], [u], ["x"], ["u"])

    def to_c(
        self, folder: str | Path, *, name: str = "policy", scalar: str = "double", history: int = 0,
        estimator: Any = None,
    ) -> PolicyCode:  # fmt: skip
        """Write the mean action in C99 without allocation or libraries, and report its costs.

        `name`.h and `name`.c define `int name_law(const name_real x[], name_real u[])`, which returns 0, or 2 where x
        is not finite (u is then the input nearest to zero). Normalisation, design and limits are inside.

        Parameters
        ----------
        folder : path
            Created when missing.
        name : str
            A C identifier.
        scalar : "double" or "float"
            Type of the numbers.
        history : int
            Samples that the code remembers, where x is a history: `History.to_c` gives its length.
        estimator : KalmanFilter or CubatureKalmanFilter, optional
            What the code estimates x with: `Observed.to_c` gives its own.

        Raises
        ------
        InputError
            An unknown option, or a folder that cannot be written to.
        """
        where = Path(as_instance("folder", folder, (str, Path), "the path of a folder"))
        memory = {"length": history, "estimator": estimator}
        return write_c(*self._normalised(), self._range, where, name=name, scalar=scalar, **memory)

    def to_onnx(self, path: str | Path) -> Path:
        """Write the mean action as an ONNX model in double precision: x (n, nx) to u (n, nu).

        Its metadata hold the design.

        Raises
        ------
        InputError
            If onnx is not installed, or the folder does not exist.
        """
        return write_onnx(*self._normalised(), self._range, self.design, writable_path("path", path))

    def _normalised(self) -> tuple[Layers, Array, Array]:
        """Layers of the mean in states normalised by a centre and half-widths (nx,)."""
        offset, scale = self.agent.observation_offset.double().clone(), self.agent.observation_scale.double().clone()
        centre, width = _array(offset[: self.nx]), _array(scale[: self.nx])
        offset[: self.nx], scale[: self.nx] = 0.0, 1.0
        return self.agent.mean_network.at(torch.tensor(self.design), offset, scale).of(_array), centre, width

    def save(self, path: str | Path, **notes: str) -> None:
        """Save networks, design and notes as one safetensors file for `load_policy`.

        Raises
        ------
        InputError
            If the folder does not exist, or a note is no text.
        """
        saved_with(self, path, notes, {})

    @cached_property
    def nx(self) -> int:
        """Number of states."""
        return len(self.agent.observation_offset) - len(self.design)

    @property
    def nu(self) -> int:
        """Number of inputs."""
        return len(self.agent.action_offset)


def saved_with(policy: LearnedPolicy, path: str | Path, notes: dict[str, str], extra: dict[str, Any]) -> None:
    """Save a policy with notes and extra values."""
    for name, note in notes.items():
        as_instance(name, note, str, "a note in text")
    extra = extra | {"design": policy.design.tolist(), "notes": notes}
    checkpoint.save(writable_path("path", path), policy.agent, extra)


def _array(tensor: torch.Tensor) -> Array:
    """Copy of a tensor in float64."""
    return tensor.detach().double().numpy().copy()
