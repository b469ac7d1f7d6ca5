"""Equilibrium of a plant as a function of its design."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike

from ccdtools.arrays import Array, Immutable, Mask, frozen
from ccdtools.exceptions import InputError
from ccdtools.plants.plant import ABOUT_REST, Plant
from ccdtools.plants.rates import Rates, independent, newton_step, rest_near
from ccdtools.plants.tolerances import PATHS, RATE_ROUNDING, SAME_REST
from ccdtools_ground.door import as_floats, as_instance, as_vector, shown


@dataclass(frozen=True, eq=False, repr=False)
class Equilibrium(Immutable):
    """State and input at rest, with their design derivatives.

    Attributes
    ----------
    plant : Plant
    x, u, w : arrays (nx,), (nu,) and (nw,)
        State, input and disturbance at rest.
    p : (np,) array
        The design it was found at.
    free : (nx + nu,) bool array
        Which entries of (x, u) were looked for; the others are given, at every design.
    unique : bool
        Whether no other point near it is an equilibrium with the given entries; where some are, the entries that
        decide nothing keep the values of the guess.
    """

    plant: Plant
    x: Array
    u: Array
    w: Array
    p: Array
    free: Mask
    unique: bool

    def __repr__(self) -> str:
        where = f" at {self.plant.design.describe(self.p)}" if self.plant.design.dim else ""
        return f"Equilibrium(x = {np.round(self.x, 6).tolist()}, u = {np.round(self.u, 6).tolist()}{where})"

    @property
    def dx_dp(self) -> Array:
        """∂x/∂p (nx, np) at the design."""
        return self._derivative[: self.plant.nx]

    @property
    def du_dp(self) -> Array:
        """∂u/∂p (nu, np) at the design."""
        return self._derivative[self.plant.nx :]

    @cached_property
    def _derivative(self) -> Array:
        """∂(x, u)/∂p (nx + nu, np), by the implicit function theorem."""
        rates = Rates(self.plant, self.w)
        z = np.r_[self.x, self.u]
        rows, columns = independent(rates.jacobian(z, self.p)[:, self.free])
        chosen = np.flatnonzero(self.free)[columns]
        full = np.zeros((len(z), len(self.p)))
        if len(chosen):
            J = rates.jacobian(z, self.p)[np.ix_(rows, chosen)]
            full[chosen] = -np.linalg.solve(J, rates.by_design(z, self.p)[rows])
        return full

    @cached_property
    def function(self) -> ca.Function:
        """Expression p → (x, u) at rest, by Newton's method.

        The way has as few stations, and each as few steps, as the box of designs needs: one step where the plant is
        linear. It ends where the longest way ends, so that no step leaps to another rest.

        Raises
        ------
        InputError
            If it is not followed to rest at some design of the box.
        """
        plant = self.plant
        rates = Rates(plant, self.w)
        start = np.r_[self.x, self.u]
        rows, columns = independent(rates.jacobian(start, self.p)[:, self.free])
        chosen = [int(i) for i in np.flatnonzero(self.free)[columns]]
        z, p = rates.z, plant.p
        step = ca.Function("step", [z, p], [newton_step(rates, rows, chosen)])
        designs = plant.design.spread()
        longest = np.asarray(_followed(step, start, self.p, designs.T, *PATHS[-1])).reshape(len(start), len(designs))
        rests = np.array([rates.at_rest(z, q) for z, q in zip(longest.T, designs)])
        size = np.abs(longest[:, rests])
        rounding = RATE_ROUNDING * size.max(initial=0.0)
        near = (SAME_REST * size.max(axis=1, initial=0.0) + rounding)[:, None] + np.column_stack(
            [rates.resolution(z, q, rows, chosen) for z, q in zip(longest.T, designs)]
        )
        for stations, steps in PATHS:
            found = _followed(step, ca.SX(ca.DM(start)), self.p, p, stations, steps)
            function = ca.Function("equilibrium", [p], [found[: plant.nx], found[plant.nx :]], ["p"], ["x", "u"])
            ends = np.vstack([np.asarray(part).reshape(-1, len(designs)) for part in function.call([designs.T])])
            leaps = (np.abs(ends - longest) > near).any(axis=0) & rests
            if not leaps.any() and all(rates.at_rest(z, q) for z, q in zip(ends.T, designs)):
                return function
        place = plant.design.describe(designs[int(np.argmin(rests))])
        raise InputError(
            "equilibrium", f"a rest that was not followed from {plant.design.describe(self.p)} to {place}",
            "one at every design of the box",
            "Narrow the box of designs to where it rests, start nearer the middle, or free other entries of x and u.",
        )  # fmt: skip


def _followed(step: ca.Function, start: Any, p0: Array, p: Any, stations: int, steps: int) -> Any:
    """Ends (nx + nu, n) of Newton steps from `p0` to `p` (np, n).

    Stations are denser at both ends, where a rest may be about to vanish at a bound of the box.
    """
    found = start if p.shape[1] == 1 else np.tile(start[:, None], p.shape[1])
    origin = ca.repmat(ca.DM(p0), 1, p.shape[1])
    for k in range(1, stations + 1):
        station = origin + (p - origin) * (0.5 - 0.5 * math.cos(math.pi * k / stations))
        for _ in range(steps + 5 * (k == stations > 1)):  # 5 last steps where there is a way
            found = step(found, station)
    return found


def equilibrium(
    plant: Plant,
    p: ArrayLike = (),
    *,
    x: ArrayLike | None = None,
    u: ArrayLike | None = None,
    w: ArrayLike | None = None,
    guess: tuple[ArrayLike, ArrayLike] | None = None,
) -> Equilibrium:
    """State and input at which a plant rests at a design.

    Parameters
    ----------
    plant : Plant
    p : (np,) array_like
        The design.
    x : (nx,) array_like, optional
        Entries that are given, NaN for those that are looked for; all of them by default.
    u : (nu,) array_like, optional
        The same of the input; 0 by default.
    w : (nw,) array_like, optional
        The disturbance at rest; 0 by default. `deviations` and `linearise` count w from it, as they count u from the
        input at rest: their w = 0 is this one.
    guess : (x, u), optional
        Where to look first; 0 by default.

    Returns
    -------
    Equilibrium

    Raises
    ------
    InputError
        If a size is wrong, the design lies outside its bounds, or the plant rests nowhere with the given entries.

    Examples
    --------
    >>> equilibrium(tanks, [0.5], x=[np.nan, 0.3], u=[np.nan])  # the input that holds the second level at 0.3 m
    ... # doctest: +SKIP
    """
    as_instance("plant", plant, Plant, "a Plant", ABOUT_REST)
    p = plant.design.check_one(p)
    given = np.r_[
        _given("x", np.full(plant.nx, np.nan) if x is None else x, plant.nx),
        _given("u", np.zeros(plant.nu) if u is None else u, plant.nu),
    ]
    disturbance = np.zeros(plant.nw) if w is None else as_vector("w", w, plant.nw)
    first = np.zeros(plant.nx + plant.nu)
    if guess is not None:
        pair = isinstance(guess, tuple | list) or (isinstance(guess, np.ndarray) and guess.ndim > 0)
        if not pair or len(guess) != 2:
            raise InputError("guess", shown(guess), "a pair (x, u)")
        first = np.r_[as_vector("guess, x", guess[0], plant.nx), as_vector("guess, u", guess[1], plant.nu)]
    free = np.isnan(given)
    rates = Rates(plant, disturbance)
    z = rest_near(rates, np.where(free, first, given), free, p)
    _, columns = independent(rates.jacobian(z, p)[:, free])
    unique = len(columns) == int(free.sum())
    at, held = (frozen(part.copy()) for part in (z[: plant.nx], z[plant.nx :]))
    return Equilibrium(plant, at, held, frozen(disturbance), p, frozen(free), unique)


def _given(name: str, value: ArrayLike, size: int) -> Array:
    """Vector of that size; NaN for what is looked for."""
    vector = as_floats(name, value)
    vector = np.broadcast_to(vector, (size,)) if vector.ndim == 0 else vector
    if vector.shape != (size,) or np.isinf(vector).any():
        got = f"{vector.tolist()} of shape {vector.shape}"
        raise InputError(name, got, f"({size},) numbers, NaN for what is looked for")
    return vector.copy()
