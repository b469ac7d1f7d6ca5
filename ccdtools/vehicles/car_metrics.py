"""Suspension metrics: comfort, travel, tyre load and energy."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from ccdtools.arrays import Array, Immutable
from ccdtools.exceptions import InputError
from ccdtools.vehicles.ride_comfort import as_signal, comfort, root_mean_square
from ccdtools_ground.door import as_number, as_positive

NAMES = {
    "comfort": "comfort {} m/s²",
    "travel_rms": "travel {} m rms",
    "travel_peak": "{} m peak",
    "travel_share": "{} of the stop",
    "load_rms": "tyre load {} of the static one rms",
    "lift_off": "off the road {} of the time",
    "energy": "energy {} J",
}


@dataclass(frozen=True, eq=False, repr=False)
class SuspensionMetrics(Immutable):
    """Metrics of how runs rode, per run or per run and wheel; smaller is better.

    Attributes
    ----------
    comfort : (...) array
        W_k-weighted root mean square of the body's vertical acceleration [m/s²], see `comfort`.
    travel_rms, travel_peak : (...) arrays
        Suspension travel from its rest: root mean square, and largest in either direction [m].
    travel_share : (...) array
        Largest travel over the stop; 1 and more is a suspension that hits it.
    load_rms : (...) array
        Root mean square of the dynamic tyre load over the static load.
    lift_off : (...) array
        Fraction of the samples at which the tyre carries nothing.
    energy : (...) array
        Work that the actuator does [J].
    """

    comfort: Array
    travel_rms: Array
    travel_peak: Array
    travel_share: Array
    load_rms: Array
    lift_off: Array
    energy: Array

    def __repr__(self) -> str:
        if not self.comfort.size:
            return "SuspensionMetrics(no runs)"
        means = (text.format(f"{np.mean(getattr(self, name)):.3g}") for name, text in NAMES.items())
        return f"SuspensionMetrics({', '.join(means)})"


def suspension_metrics(
    *,
    acceleration: ArrayLike,
    travel: ArrayLike,
    tyre_force: ArrayLike,
    force: ArrayLike,
    dt: float,
    stop: float,
    static_load: float,
    recovered: float = 0.0,
) -> SuspensionMetrics:
    """Metrics of signals whose last axis is time.

    Of a `Trajectory` of the quarter car, x = [z_us − z₀, ż_us, z_s − z_us, ż_s]::

        kept = ~run.diverged
        x, u = run.states[kept], run.inputs[kept]
        metrics = suspension_metrics(
            acceleration=np.diff(x[:, :, 3]) / run.dt, travel=x[:, :, 2], tyre_force=-k_t * x[:, :, 0],
            force=u[:, :, 0], dt=run.dt, stop=0.08, static_load=9.81 * (m_s + m_us),
        )

    For several wheels move theirs before the time, `np.moveaxis(x[:, :, wheels], 1, -1)`, (n, wheels, T + 1).

    Parameters
    ----------
    acceleration : (..., T) array_like
        Of the body, without gravity [m/s²].
    travel : (..., T + 1) array_like
        Of the suspension from its rest, positive when it extends [m].
    tyre_force : (..., S) array_like
        Dynamic load between tyre and road, positive when it presses [N].
    force : (..., T) array_like
        Of the actuator, held over each step, positive when it extends the suspension [N].
    dt : float
        Time step [s].
    stop : float
        Travel at which the suspension meets its stop [m].
    static_load : float
        Load of the wheel at rest [N]. The tyre carries nothing where the dynamic load takes all of it away; a linear
        tyre then pulls at the road, and results with such samples are those of a model that no longer holds.
    recovered : float
        Fraction of the braking work that returns to the battery. The work of a step is force times change of travel,
        exact for a force that is held over it, and counts with its sign: the true energy without recovery is larger
        where the travel turns within a step. Losses are not in it.

    Raises
    ------
    InputError
        If an argument is not as described.
    """
    z = as_signal("travel", travel)
    peak = np.abs(z).max(axis=-1)
    share = peak / as_positive("stop", stop, unit="m")
    dynamic = as_signal("tyre_force", tyre_force)
    static = as_positive("static_load", static_load, unit="N")
    u = as_signal("force", force)
    if z.shape != (*u.shape[:-1], u.shape[-1] + 1):
        raise InputError("force, travel", f"shapes {u.shape} and {z.shape}", "(..., T) and (..., T + 1)")
    returned = as_number("recovered", recovered, expected="a fraction from 0 to 1", low=0.0, high=1.0)
    work = u * np.diff(z, axis=-1)
    energy = np.maximum(work, 0.0).sum(axis=-1) + returned * np.minimum(work, 0.0).sum(axis=-1)
    load, lift_off = root_mean_square(dynamic) / static, np.mean(dynamic <= -static, axis=-1)
    return SuspensionMetrics(comfort(acceleration, dt), root_mean_square(z), peak, share, load, lift_off, energy)
