"""Ride of a vehicle, as metrics of a trajectory."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ccdtools.arrays import Array, ArrayField, Immutable
from ccdtools.exceptions import InputError
from ccdtools.trajectory import Trajectory
from ccdtools.vehicles.car_metrics import suspension_metrics
from ccdtools_ground.door import as_instance, as_positive, as_vector, shown


@dataclass(frozen=True, eq=False)
class Ride(Immutable):
    """Ride metrics of a trajectory, from the places of a vehicle's states.

    As the `metrics` of a study it stands beside every comparison:

        Ride(body=3, travels=[2], tyres=[0], stiffness=232.5e3, loads=[3826.0], stop=0.1)

    Attributes
    ----------
    body : int
        State that is the vertical speed of the body [m/s], positive upwards.
    travels, tyres : sequences of int
        States that are the travels of the suspension [m], positive when it extends, and the deflections of the tyres
        [m], positive when the wheel rises from the road; one of each per wheel, in the same order.
    stiffness : float
        Of every tyre [N/m].
    loads : (wheels,) array
        Static loads of the tyres [N].
    stop : float
        Travel at which a suspension meets its stop [m].
    forces : sequence of int, optional
        States that are the active forces [N], positive when they extend the suspension; the inputs by default.

    Raises
    ------
    InputError
        If an index is no whole number ≥ 0, or the numbers of wheels differ.
    """

    body: int
    travels: Sequence[int]
    tyres: Sequence[int]
    stiffness: float
    loads: ArrayField
    stop: float
    forces: Sequence[int] | None = None

    def __post_init__(self) -> None:
        self._set(body=_indices("body", [self.body])[0])
        self._set(travels=_indices("travels", self.travels))
        wheels = len(self.travels)
        for name in ("tyres",) if self.forces is None else ("tyres", "forces"):
            found = _indices(name, getattr(self, name))
            if len(found) != wheels:
                raise InputError(name, f"{len(found)} states", f"{wheels}, one per travel")
            self._set(**{name: found})
        self._set(stiffness=as_positive("stiffness", self.stiffness, unit="N/m"))
        loads = as_vector("loads", self.loads, wheels, of="one per travel")
        if not (loads > 0).all():
            raise InputError("loads", shown(loads), "static loads above 0 [N]")
        self._set(loads=loads)
        self._set(stop=as_positive("stop", self.stop, unit="m"))

    def __call__(self, run: Trajectory) -> dict[str, float]:
        """Means over runs and wheels, by metric name.

        Travel is the largest over the wheels; power is the sum over the actuators, without what braking gives back.

        Raises
        ------
        InputError
            If the trajectory has fewer states than the indices say, or other inputs than one per wheel.
        """
        as_instance("run", run, Trajectory, "a Trajectory")
        states = run.states
        used = (self.body, *self.travels, *self.tyres, *(self.forces or ()))
        if max(used) >= states.shape[2]:
            raise InputError("run", f"{states.shape[2]} states", f"more than {max(used)}, the largest index")
        found = suspension_metrics(
            acceleration=np.diff(states[:, :, self.body]) / run.dt,
            travel=_of_wheels(states, self.travels),
            tyre_force=-self.stiffness * _of_wheels(states, self.tyres) / self.loads[:, None],
            force=self._forces(run),
            dt=run.dt,
            stop=self.stop,
            static_load=1.0,
        )
        duration = run.dt * run.inputs.shape[1]
        return {
            "weighted body acceleration [m/s²]": float(found.comfort.mean()),
            "rms travel [mm]": float(1e3 * found.travel_rms.mean()),
            "largest travel [% of the stop]": float(100 * found.travel_share.max(axis=1).mean()),
            "rms tyre load [% of static]": float(100 * found.load_rms.mean()),
            "off the road [% of the time]": float(100 * found.lift_off.mean()),
            "actuator power [W]": float(found.energy.sum(axis=1).mean() / duration),
        }

    def _forces(self, run: Trajectory) -> Array:
        """Active forces (n, wheels, T): inputs, or mean states over each step."""
        if self.forces is not None:
            ends = _of_wheels(run.states, self.forces)
            return 0.5 * (ends[..., 1:] + ends[..., :-1])
        if run.inputs.shape[2] != len(self.travels):
            raise InputError("run", f"{run.inputs.shape[2]} inputs", f"{len(self.travels)}, one per wheel")
        return np.moveaxis(run.inputs, 1, -1)


def _of_wheels(states: Array, indices: Sequence[int]) -> Array:
    """States of the wheels, (n, wheels, T + 1)."""
    return np.moveaxis(states[:, :, list(indices)], 1, -1)


def _indices(argument: str, value: Sequence[int]) -> tuple[int, ...]:
    try:
        found = tuple(value)
    except TypeError:
        found = ()
    whole = all(isinstance(i, int | np.integer) and not isinstance(i, bool) and i >= 0 for i in found)
    if not found or not whole or len(set(found)) != len(found):
        raise InputError(argument, shown(value), "different numbers of states, from 0")
    return tuple(int(i) for i in found)
