"""Model of a simulator, differentiated by differences."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import Any, ClassVar, NoReturn, Protocol

import numpy as np
from numpy.typing import ArrayLike

from ccdtools.arrays import Array, ArrayField, Immutable
from ccdtools.exceptions import CCDError, InputError, SimulatorError
from ccdtools.plants.design_space import NO_DESIGN, DesignSpace
from ccdtools.plants.linear_model import DiscreteModel
from ccdtools.plants.tolerances import SIMULATED_STEP
from ccdtools_ground.door import shown
from ccdtools_ground.user_functions import in_words

Step = Callable[[Array, Array, Array], Array]
POINTS = np.arange(-2.0, 3.0)  # Steps at which a slope asks, exact to fourth order.


class Simulable(Protocol):
    """Protocol of a plant that `simulate` can step."""

    @property
    def nx(self) -> int:
        """Number of states."""

    @property
    def nu(self) -> int:
        """Number of inputs."""

    @property
    def nw(self) -> int:
        """Number of disturbances."""

    @property
    def dt(self) -> float:
        """Sampling time [s]."""

    @property
    def design(self) -> DesignSpace | None:
        """Box of designs, if any."""

    def stepper(self, p: Array, *, batch: int) -> Step:
        """Step function (x (n, nx), u (n, nu), w (n, nw)) → x⁺."""


@dataclass(frozen=True, eq=False, repr=False)
class SimulatedModel(Immutable):
    """Model of a simulator, with slopes by differences.

    A `CoDesignProblem` or a `DigitalTwin` makes it. A slope asks the simulator four times for each state, input,
    disturbance and free entry of the design that is no whole number; noise of the simulator is a thousand times as
    large in it. For a design between whole numbers it is asked at the nearest ones.

    Parameters
    ----------
    box : BlackBox, or another Simulable
        Its step must hold no memory.
    extent : (nx + nu + nw,) array_like, optional
        Sizes of states, inputs and disturbances, which steps are parts of; 1 by default.
    errors : bool
        Whether the disturbance is (w, r), of which r (nx,) is added to the next state.

    References
    ----------
    Fornberg, "Generation of finite difference formulas on arbitrarily spaced grids", Math. Comp. 51, 1988.
    """

    box: Simulable
    extent: ArrayField = None
    errors: bool = False

    few_rows = np.inf  # a step has no parts whose states are kept for the way back

    def __repr__(self) -> str:
        return f"SimulatedModel({self.box!r})"

    @property
    def nx(self) -> int:
        """Number of states."""
        return self.box.nx

    @property
    def nu(self) -> int:
        """Number of inputs."""
        return self.box.nu

    @property
    def nw(self) -> int:
        """Number of disturbances."""
        return self.box.nw + self.nx * self.errors

    jump: ClassVar[str] = ""  # none is known of a simulator

    @property
    def input_bounds(self) -> Any:
        """Lower and upper inputs that the simulator takes."""
        return getattr(self.box, "input_bounds", DiscreteModel.input_bounds)

    @property
    def dt(self) -> float:
        """Sampling time [s]."""
        return self.box.dt

    @property
    def design(self) -> DesignSpace:
        """Box of designs."""
        return self.box.design or NO_DESIGN

    @property
    def sizes(self) -> tuple[int, ...]:
        """Sizes of x, u, w and p."""
        return self.nx, self.nu, self.nw, self.design.dim

    @property
    def step(self) -> NoReturn:
        """An `InputError`: nonlinear MPC and plans need expressions.

        Raises
        ------
        InputError
            Always.
        """
        raise InputError("model", f"{self.box!r}, which has no expressions", "a model by discretise(plant)",
                         "LQR, LQG, linear MPC, a search and policies take a simulator.")  # fmt: skip

    def stepper(self, p: ArrayLike, *, batch: int) -> Callable[[Array, Array, Array], Array]:
        """Step of x, u and w (..., n) at a design."""
        p = self.design.check_one(p)
        return lambda x, u, w: self.advance(x, u, w, p)

    def with_errors(self) -> SimulatedModel:
        """Model driven by (w, r), with r (nx,) added to the next state."""
        return replace(self, errors=True)

    def undisturbed(self, p: ArrayLike) -> Callable[[Array, Array], Array]:
        """Step of x and u (..., n) without disturbances."""
        step = self.stepper(p, batch=1)
        return lambda x, u: step(x, u, np.zeros(self.nw))

    def advance(self, x: Array, u: Array, w: Array, p: Array) -> Array:
        """x⁺ (..., nx) of arrays (..., n); leading shapes broadcast."""
        shape = np.broadcast_shapes(*(part.shape[:-1] for part in (x, u, w, p)))
        runs = int(np.prod(shape))
        first, *held = (np.broadcast_to(v, (*shape, v.shape[-1])).reshape(runs, v.shape[-1]) for v in (x, u, w, p))
        return self.rows(first, tuple(held)).reshape(*shape, self.nx)

    @cached_property
    def pathwise(self) -> Callable[..., Any]:
        """Step of torch tensors (n, ·), differentiable once."""
        from ccdtools.plants.pathwise_step import pathwise

        return partial(pathwise, self)

    def rows(self, x: Array, held: tuple[Array, ...]) -> Array:
        """x⁺ (n, nx) of rows, or common (·,) u, w, p."""
        u, w = (np.broadcast_to(part, (len(x), part.shape[-1])) for part in held[:2])
        w, r = np.split(w, [self.box.nw], axis=1)
        return self._own_rows(x, u, w, held[2]) + r if self.errors else self._own_rows(x, u, w, held[2])

    def _own_rows(self, x: Array, u: Array, w: Array, p: Array) -> Array:
        """x⁺ (n, nx) without errors."""
        p = np.where(self.design.whole, np.round(p), p)
        p = np.clip(p, *self.design.outermost)  # single precision rounds
        if p.ndim == 1:
            return stepped(self.box.stepper(p, batch=len(x)), x, u, w)
        designs, of = np.unique(p, axis=0, return_inverse=True)
        after = np.empty((len(x), self.nx))
        for k, design in enumerate(designs):
            runs = of.ravel() == k
            after[runs] = stepped(self.box.stepper(design, batch=int(runs.sum())), x[runs], u[runs], w[runs])
        return after

    def slopes(self, x: Array, held: tuple[Array, ...], states: list[Array], multiplier: Array) -> list[Array]:
        """Products (n, ·) of a multiplier (n, nx) with slopes."""
        found = np.zeros((len(x), sum(self.sizes)))
        asked = multiplier.any(axis=1)  # of a lost run nothing is asked, and its slope may be no number
        if asked.any():
            parts = [part[asked] if part.ndim == 2 else part for part in (x, *held)]
            found[asked] = np.einsum("nij,ni->nj", self._jacobian(*parts), multiplier[asked])
        return np.split(found, np.cumsum(self.sizes)[:-1], axis=1)

    def matrices(self, p: ArrayLike = ()) -> tuple[Array, Array, Array]:
        """A (nx, nx), B (nx, nu), E (nx, nw) about 0.

        Of one design (np,), or stacked for (n, np).

        Raises
        ------
        InputError
            If a design has the wrong shape or lies outside its bounds, or the simulator has no slope there.
        """
        p = self.design.check(p)
        designs = np.atleast_2d(p)
        J = self._jacobian(*(np.zeros((len(designs), size)) for size in self.sizes[:3]), designs, by=range(3))
        if not np.isfinite(J).all():
            got = f"a design at which a step beside rest is not finite: {p.tolist()}"
            raise InputError("design", got, "one where the simulator goes on", "Leave it out of the design bounds.")
        A, B, E = (np.ascontiguousarray(part) for part in np.split(J, np.cumsum(self.sizes[:2]), axis=-1))
        return (A, B, E) if p.ndim == 2 else (A[0], B[0], E[0])

    def derivatives(self, p: ArrayLike = ()) -> tuple[Array, Array, Array]:
        """∂A/∂p (nx, nx, np), ∂B/∂p (nx, nu, np), ∂E/∂p (nx, nw, np) at a design."""
        p = self.design.check_one(p)
        slopes = np.zeros((self.nx, sum(self.sizes[:3]), len(p)))
        for j, points in self._points(3, p):
            slopes[..., j] = sum(weight * self.function(moved) for weight, moved in points)
        A, B, E = np.split(slopes, np.cumsum(self.sizes[:2]), axis=1)
        return A, B, E

    def function(self, p: Array) -> Array:
        """[A B E] (nx, nx + nu + nw) at a design (np,)."""
        return np.concatenate(self.matrices(np.clip(p, self.design.lower, self.design.upper)), axis=1)

    def jacobian(self, p: Array) -> Array:
        """∂vec[A B E]/∂p, (nx·(nx + nu + nw), np), vec by columns."""
        slopes = np.concatenate(self.derivatives(np.clip(p, self.design.lower, self.design.upper)), axis=1)
        return slopes.transpose(1, 0, 2).reshape(-1, self.design.dim)

    def by_disturbance(self, x: Array, u: Array, w: Array, p: Array) -> Array:
        """Slopes ∂x⁺/∂w (n, nx, nw) at rows."""
        return self._jacobian(x, u, w, p, by=(2,))[..., self.nx + self.nu :]

    def _jacobian(self, *parts: Array, by: Sequence[int] = range(4)) -> Array:
        """Slopes (n, nx, ·) by some parts, zeros before them."""
        out = np.zeros((len(parts[0]), self.nx, sum(self.sizes[: by[-1] + 1])))
        if self.errors:
            out[:, :, sum(self.sizes[:3]) - self.nx : sum(self.sizes[:3])] = np.eye(self.nx)
        for i in by:
            for j, points in self._points(i, parts[i]):
                for weight, moved in points:
                    given = (*parts[:i], moved, *parts[i + 1 :])
                    out[:, :, sum(self.sizes[:i]) + j] += weight[..., None] * self.rows(given[0], given[1:])
        return out

    def _points(self, i: int, part: Array) -> Iterator[tuple[int, list[tuple[Array, Array]]]]:
        """Entries that move, with weights and points of their slopes."""
        if i < 3:
            extent = np.ones(self.nx + self.nu + self.box.nw) if self.extent is None else self.extent
            steps = SIMULATED_STEP * np.split(extent, np.cumsum(self.sizes[:2]))[i]
            shifts = np.zeros(len(steps))
        else:  # within the box, and between no whole numbers
            lower, upper = self.design.lower, self.design.upper
            steps = np.where(self.design.whole, 0.0, SIMULATED_STEP * (upper - lower))
            shifts = np.clip(part, lower - POINTS[0] * steps, upper - POINTS[-1] * steps) - part
        for j in np.flatnonzero(steps):
            shift = shifts[..., j] / steps[j]
            points = []
            for point, weight in zip(POINTS, np.moveaxis(_weights(shift), -1, 0)):
                if weight.any():
                    moved = part.copy()
                    moved[..., j] += (point + shift) * steps[j]
                    points.append((weight / steps[j], moved))
            yield int(j), points


def stepped(step: Step, x: Array, u: Array, w: Array) -> Array:
    """Next states (n, nx) by a plant's step, which may be a user's own."""
    try:
        found = np.asarray(step(x, u, w), dtype=float)
    except (CCDError, MemoryError):
        raise
    except Exception as error:
        at = f" at x = {shown(x)}, u = {shown(u)}"
        raise SimulatorError("plant", f"a step that stops with {in_words(error)[0]}{at}", f"x⁺ {x.shape}") from error
    if found.shape != x.shape:
        raise SimulatorError("plant", f"a step to states of shape {found.shape}", f"{x.shape}")
    return found


def _weights(shifts: Array) -> Array:
    """Weights (..., 5) of values at moved `POINTS`."""
    powers = np.arange(len(POINTS))
    V = (POINTS + np.asarray(shifts)[..., None])[..., None, :] ** powers[:, None]
    weights: Array = np.linalg.solve(V, np.broadcast_to((powers == 1.0)[:, None] * 1.0, (*V.shape[:-1], 1)))[..., 0]
    return np.where(np.abs(weights) > np.finfo(float).eps, weights, 0.0)
