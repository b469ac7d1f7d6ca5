"""Measurements by sensors: outputs with reproducible noise."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache
from typing import Any, TypeAlias

import numpy as np

from ccdtools.arrays import Array, Immutable, frozen
from ccdtools.disturbances.disturbance import Gaussian
from ccdtools.estimation.outputs import Output, as_stated_output, check_sizes, output_at
from ccdtools.exceptions import InputError
from ccdtools.plants.plant import Plant
from ccdtools_ground.door import as_finite, as_floats, as_generator, shown

Sensor: TypeAlias = Callable[[int, Array, Array], Array]  # sample k, states (n, nx), inputs (n, nu) → outputs (n, ny)


@dataclass(frozen=True, eq=False, repr=False)
class Measurement(Immutable):
    """Measurement y_k = h(x_k, u_{k-1}, p) + v_k, made before u_k.

    Outputs that depend on the input see the one that was applied until then, u_{k-1}, which is 0 before the first.

    Parameters
    ----------
    output : (ny, nx) array_like, Plant, or callable
        C of y = C x; a plant whose `outputs` are measured, at the design that is simulated; or a function of states
        (n, nx) that returns (n, ny), and is also given u (n, nu) and p (np,) where its arguments have these names.
    noise : (ny,) array_like, Disturbance, or (T, ny) or (n, T, ny) array_like, optional
        Standard deviations of independent normal noise, in the units of y; anything with ``sample(runs, steps, rng)``;
        or the noise itself, run by run. None by default.

    Raises
    ------
    InputError
        If `output` states none, or `noise` is neither; sizes are compared once the plant is known.

    Examples
    --------
    >>> sensor = Measurement([[1.0, 0.0]], noise=[0.01])
    >>> run = simulate(plant, controller, x0=x0, steps=100, output=sensor, rng=np.random.default_rng(0))
    """

    output: Any
    noise: Any = None

    def __post_init__(self) -> None:
        self._set(output=as_stated_output(self.output))
        self._set(noise=_as_noise(self.noise))

    def __repr__(self) -> str:
        what = "a matrix" if isinstance(self.output, np.ndarray) else type(self.output).__name__
        return f"Measurement({what}, {'no noise' if self.noise is None else f'noise: {type(self.noise).__name__}'})"

    def check(self, nx: int, nu: int) -> None:
        """Raise an `InputError` unless sizes fit; functions show when called."""
        check_sizes(self.output, nx, nu)

    @property
    def random(self) -> bool:
        """Whether its noise is yet to be drawn."""
        return hasattr(self.noise, "sample")

    def at(self, nx: int, nu: int, p: Array) -> Output:
        """Output function h(x, u) at one design."""
        return output_at(self.output, nx, nu, p)

    def drawn(self, runs: int, steps: int, rng: np.random.Generator | None) -> Measurement:
        """Measurement with its noise drawn, which covers all runs, steps and outputs.

        How many outputs a function has shows when it is called.
        """
        noise = self.noise
        if self.random:
            noise = as_floats("output.noise", noise.sample(runs, steps, as_generator("rng", rng)))
            if noise.ndim != 3:
                raise InputError("output.noise", f"a sample of shape {noise.shape}", f"({runs}, {steps}, ny)")
        if noise is None:
            return self
        if len(noise) not in (1, runs) or noise.shape[1] < steps:
            raise InputError("output.noise", f"shape {noise.shape}", f"({runs}, {steps}, ny)")
        if isinstance(self.output, Plant | np.ndarray):
            check_channels(noise, self.output.ny if isinstance(self.output, Plant) else len(self.output))
        return replace(self, noise=as_finite("output.noise", noise))

    def first(self, runs: int, steps: int) -> Measurement:
        """Measurement with drawn noise cut to the first runs and steps."""
        return self.part(slice(runs), steps)

    def part(self, runs: slice, steps: int) -> Measurement:
        """Measurement with drawn noise cut to some runs and the first steps."""
        if self.noise is None or self.random:
            return self
        own = runs if len(self.noise) > 1 else slice(None)  # one noise is that of all runs
        return replace(self, noise=self.noise[own, :steps])

    def sensor(self, plant: Any, p: Array, runs: int, steps: int, rng: np.random.Generator | None) -> Sensor:
        """Sensor (k, x, u) → y of a closed loop.

        Its noise comes from a generator of its own, split off from `rng`: what else is drawn from `rng` stays the same
        with and without it, and it is drawn only where a controller listens.
        """
        h = self.at(plant.nx, plant.nu, p)
        own = as_generator("rng", rng).spawn(1)[0] if self.random else None
        drawn = cache(lambda: self.drawn(runs, steps, own).noise)
        if not self.random:
            drawn()  # refused at once, not where a controller listens

        def measured(k: int, x: Array, u: Array) -> Array:
            """Outputs (n, ny) of states (n, nx) after inputs (n, nu)."""
            with np.errstate(all="ignore"):  # of a run that is lost
                y = h.of(x, u)
            noise = drawn()
            if noise is None:
                return y
            check_channels(noise, y.shape[1])
            return np.asarray(y + noise[:, k])

        return measured


def as_measurement(value: Any) -> Measurement:
    """Measurement as given, or a noiseless one of stated outputs."""
    return value if isinstance(value, Measurement) else Measurement(value)


def _as_noise(value: Any) -> Any:
    """Noise as an object to sample or array (n, T, ny)."""
    expected = "standard deviations (ny,), a Disturbance, or noise (T, ny) or (n, T, ny)"
    if value is None:
        return None
    if hasattr(value, "sample"):
        if isinstance(value, type):
            raise InputError("output.noise", shown(value), "an object of it")
        return value
    noise = np.atleast_1d(as_floats("output.noise", value, expected=expected))
    as_finite("output.noise", noise)
    if noise.ndim == 1 and noise.size and (noise >= 0).all():
        return Gaussian(noise)
    if noise.ndim not in (2, 3) or noise.size == 0:
        got = "a negative standard deviation" if noise.ndim == 1 and noise.size else f"shape {noise.shape}"
        raise InputError("output.noise", got, expected)
    return frozen(noise[None] if noise.ndim == 2 else noise)


def check_channels(noise: Array, outputs: int) -> None:
    """Raise an `InputError` unless noise has these channels."""
    if noise.shape[2] != outputs:
        raise InputError("output.noise", f"{noise.shape[2]} channels", f"{outputs}, one per output")
