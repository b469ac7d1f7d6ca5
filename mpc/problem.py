"""Checked statement of a linear MPC problem."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, Self

import numpy as np
from numpy.typing import ArrayLike

from ccdtools_ground.door import as_cross_weight, as_pair, as_weight, frozen
from mpc.checks import Array, Immutable, as_array, as_blocks, as_count, as_halfspaces, as_rate_limit, as_set, as_soft
from mpc.exceptions import InfeasibleError, InputError
from mpc.halfspaces import Limits, along_axes, first_positive, is_empty, projection
from mpc.riccati import lqr, settled
from mpc.robust import ADVICE, as_disturbance_set, robust_terminal_rows, tightened, tube_gain


@dataclass(frozen=True, eq=False, repr=False)
class MPCProblem(Immutable):
    """Minimise Σ x'Qx + 2 x'Su + u'Ru + x_N'Px_N subject to model and limits.

    `LinearMPC` says what every argument is. `condense` turns it into a `ParametricQP`, `LinearMPC` solves it.

    Attributes
    ----------
    state_rows, input_rows, terminal_rows : (H, h)
        The sets as half-spaces {v : Hv <= h}, before they are tightened; see `rows_at`.
    given_P : (nx, nx) array or None
        The terminal weight, if it was given; None where it is the solution of the Riccati equation.
    riccati_gain : (nu, nx) array or None
        The gain that belongs to that solution.
    """

    A: Any
    B: Any = None
    Q: Any = field(kw_only=True)
    R: Any = field(kw_only=True)
    S: Any = field(default=None, kw_only=True)
    horizon: int = field(kw_only=True)
    P: Any = field(default=None, kw_only=True)
    X: Any = field(default=None, kw_only=True)
    U: Any = field(default=None, kw_only=True)
    terminal_set: Any = field(default=None, kw_only=True)
    E: Any = field(default=None, kw_only=True)
    mean: Any = field(default=None, kw_only=True)
    W: Any = field(default=None, kw_only=True)
    rate_limit: Any = field(default=None, kw_only=True)
    soft: tuple[float, float] | None = field(default=None, kw_only=True)
    blocks: tuple[int, ...] | None = field(default=None, kw_only=True)
    uses: tuple[str, ...] = field(default=(), kw_only=True)
    state_rows: tuple[Array, Array] = field(init=False)
    input_rows: tuple[Array, Array] = field(init=False)
    terminal_rows: tuple[Array, Array] = field(init=False)
    given_P: Array | None = field(init=False)
    riccati_gain: Array | None = field(init=False, default=None)

    def __post_init__(self) -> None:
        A, B = as_pair(self.A, self.B)
        self._set(A=A, B=B, Q=as_weight("Q", self.Q, len(A)), R=as_weight("R", self.R, B.shape[1]))
        self._set(S=as_cross_weight(self.S, self.Q, self.R))
        self._set(horizon=as_count("horizon", self.horizon))
        for name, rows, n in (
            ("X", "state_rows", self.nx), ("U", "input_rows", self.nu), ("terminal_set", "terminal_rows", self.nx),
        ):  # fmt: skip
            checked = as_set(name, getattr(self, name), n)
            H, h = as_halfspaces(name, checked, n)
            if len(h) and is_empty(H, h):
                got = f"an empty set of {len(h)} rows"
                raise InputError(name, got, "at least one point", "Is a lower bound too high?")
            self._set(**{name: checked, rows: (H, h)})
        if self.E is not None:
            self._set(E=as_array("E", self.E, (self.nx, None)))
        self._set(mean=self._checked_mean())
        self._set(uses=_checked_uses(self.uses, self.nw))
        if self.rate_limit is not None:
            self._set(rate_limit=as_rate_limit(self.rate_limit, self.nu))
        if self.soft is not None:
            self._set(soft=as_soft(self.soft))
        if self.blocks is not None:
            self._set(blocks=as_blocks(self.blocks, self.horizon))
        if self.W is not None:
            self._set(W=as_disturbance_set(self.W, self._entry))
        if self.P is None:
            gain, P = lqr(A, B, Q=self.Q, R=self.R, S=self.S)
            self._set(P=P, given_P=None, riccati_gain=gain)
        else:
            P = as_weight("P", self.P, len(A))
            self._set(P=P, given_P=P)
        if self.W is not None:
            self._close_robustly()

    def _checked_mean(self) -> Array | None:
        """Mean (nw,) of the disturbance, if one is stated."""
        if self.mean is None:
            return None
        if self.E is None:
            raise InputError("mean", "one without E", "a mean of what enters by E")
        mean = as_array("mean", self.mean, (self.nw,))
        return mean if mean.any() else None

    def _close_robustly(self) -> None:
        """Check what W goes with, and find the terminal set where none was given."""
        for name in ("rate_limit", "blocks"):
            if getattr(self, name) is not None:
                raise InputError(name, getattr(self, name), "none beside W", "No input would be free to answer to w.")
        if self.terminal_set is None:  # from a state of the robust set found here u = -Kx is a plan
            if len(self.state_rows[1]) + len(self.input_rows[1]):
                sets = self.about_rest["state"], self.about_rest["input"]
                K, E = self.tube_gain, self._entry
                H, h = robust_terminal_rows(self.A, self.B, K, *sets, E, self.W, self.horizon)
                self._set(terminal_rows=(H, h + H @ self.rest[0]))
            return
        N = self.horizon
        for kind, steps in (("state", range(1, N + 1)), ("input", range(N)), ("terminal", (N,))):
            for k in steps:
                H, h = self.rows_at(kind, k)
                if len(h) and is_empty(H, h):
                    raise InfeasibleError(f"disturbances of W leave nothing of the {kind} limits at step {k}. {ADVICE}")

    @property
    def _entry(self) -> Array:
        """Matrix by which disturbances of W enter."""
        return np.eye(self.nx) if self.E is None else self.E

    @cached_property
    def tube_gain(self) -> Array:
        """Gain K (nu, nx) by which limits are tightened, see `mpc.robust.tube_gain`."""
        units = replace(self.limits, sets=self.about_rest).price_units()
        sides = (self.state_rows, units["state"]), (self.input_rows, units["input"])
        weights = {"Q": self.Q, "R": self.R, "S": self.S}
        return frozen(tube_gain(self.A, self.B, weights, sides, self._entry, self.W))

    @cached_property
    def bounds(self) -> dict[str, Array]:
        """Bounds h (N + 1, rows) of each kind, tightened for W."""
        if self.W is None:
            return {kind: np.broadcast_to(h, (self.horizon + 1, len(h))) for kind, (_, h) in self.sets.items()}
        loop = self.A - self.B @ self.tube_gain
        rows = {kind: -H @ self.tube_gain if kind == "input" else H for kind, (H, _) in self.sets.items()}
        return {
            kind: frozen(h - tightened(rows[kind], loop, self._entry, self.W, self.horizon))
            for kind, (_, h) in self.sets.items()
        }

    def rows_at(self, kind: str, step: int) -> tuple[Array, Array]:
        """Half-spaces of a kind of limit at a step, tightened."""
        return self.sets[kind][0], self.bounds[kind][step]

    @property
    def sets(self) -> dict[str, tuple[Array, Array]]:
        """Half-spaces (H, h) by kind, not tightened."""
        return {"state": self.state_rows, "terminal": self.terminal_rows, "input": self.input_rows}

    @property
    def nx(self) -> int:
        """Number of states."""
        return int(self.B.shape[0])

    @property
    def nu(self) -> int:
        """Number of inputs."""
        return int(self.B.shape[1])

    @property
    def nw(self) -> int:
        """Number of disturbances; 0 without E."""
        return 0 if self.E is None else int(self.E.shape[1])

    @property
    def needs(self) -> frozenset[str]:
        """Signals that a closed loop hands over besides the state.

        "last_input" (keyword `u_prev`, (n, nu)) with a rate limit; "reference" (`x_ref`, and `u_ref` where there is
        one) and "preview" (`w`, (N, nw) or (n, N, nw) for the next N = `horizon` steps) where `uses` names them.
        """
        return frozenset(self.uses) | ({"last_input"} if self.rate_limit is not None else set())

    @property
    def signal_shapes(self) -> dict[str, tuple[int, int]]:
        """Shape of every signal of a solve besides the state."""
        N = self.horizon
        shapes = {"u_prev": (1, self.nu), "x_ref": (N + 1, self.nx), "u_ref": (N, self.nu), "w": (N, self.nw)}
        return shapes if self.nw else {name: shape for name, shape in shapes.items() if name != "w"}

    @cached_property
    def rest(self) -> tuple[Array, Array]:
        """State (nx,) and input (nu,) of least cost at rest under `mean`."""
        if self.mean is None:
            return np.zeros(self.nx), np.zeros(self.nu)
        x, u = settled(self.A, self.B, self.E @ self.mean, Q=self.Q, R=self.R, S=self.S)
        return frozen(x), frozen(u)

    @property
    def about_rest(self) -> dict[str, tuple[Array, Array]]:
        """Limits as half-spaces of deviations from the rest."""
        x, u = self.rest
        return {kind: (H, h - H @ (u if kind == "input" else x)) for kind, (H, h) in self.sets.items()}

    def lasting_beside(self, named: Collection[str]) -> dict[str, Array]:
        """Signals in place of those that a call does not name.

        A reference of its own replaces both.
        """
        if self.mean is None:
            return {}
        values = {} if "w" in named else {"w": self.mean}
        if not {"x_ref", "u_ref"} & {*named}:
            values |= dict(zip(("x_ref", "u_ref"), self.rest))
        return {name: np.tile(value, (self.signal_shapes[name][0], 1)) for name, value in values.items()}

    def settles(self, signals: dict[str, Any]) -> bool:
        """Whether the rest stands for a reference."""
        return "x_ref" in self.lasting_beside([name for name, value in signals.items() if value is not None])

    @cached_property
    def gain(self) -> Array:
        """Gain K (nu, nx) of the regulator u = -K x, see `lqr`."""
        if self.riccati_gain is not None:
            return self.riccati_gain
        return lqr(self.A, self.B, Q=self.Q, R=self.R, S=self.S)[0]

    @cached_property
    def cross(self) -> Array:
        """Cross weight S (nx, nu), zero where none was given."""
        return frozen(np.zeros((self.nx, self.nu))) if self.S is None else np.asarray(self.S)

    @cached_property
    def stage_weight(self) -> Array:
        """Weight [Q S; S' R] of a stage (nx + nu, nx + nu)."""
        return frozen(np.block([[self.Q, self.cross], [self.cross.T, self.R]]))

    @cached_property
    def nearest_inputs(self) -> Callable[[Array], Array]:
        """Function of rows (n, nu): `nearest_points` of U."""
        return projection(*self.input_rows)

    @property
    def limits(self) -> Limits:
        """Sets and rates, with their sizes."""
        return Limits(self.B, self.sets, self.rate_limit, self.horizon)

    @cached_property
    def input_extent(self) -> Array:
        """Size (nu,) of each input by bound or rate; 0 without limit."""
        return self.limits.input_extent()

    @cached_property
    def state_extent(self) -> Array:
        """Size (nx,) of each state by bounds, else by what inputs move first."""
        extent = np.where(self.input_extent > 0, self.input_extent, 1.0)
        stable = self.A / self._radius
        moved = first_positive(self.limits.state_extent(), *(each @ extent for each in self._responses(stable)))
        weight = np.diag(self.Q)
        price = max((weight * moved**2).max(), (np.diag(self.R) * extent**2).max())  # of a state that no input moves
        return first_positive(moved, np.sqrt(price / np.where(weight > 0, weight, np.inf)), np.ones(self.nx))

    @cached_property
    def state_size(self) -> Array:
        """Size (nx,) that states come to over the horizon."""
        return np.where(self._moved_states > 0, np.minimum(self.state_extent, self._moved_states), self.state_extent)

    @cached_property
    def _moved_states(self) -> Array:
        """Distance (nx,) that inputs move each state; infinite without limits."""
        farthest = along_axes(*self.input_rows, farthest=True)
        if self.rate_limit is not None:
            farthest = np.minimum(np.where(farthest > 0, farthest, np.inf), self.horizon * self.rate_limit)
        farthest = np.where(farthest > 0, farthest, self._reaching_inputs)
        moved = np.zeros(self.nx)
        with np.errstate(over="ignore", invalid="ignore"):
            for response in self._responses(self.A):
                moved = moved + np.where(response > 0, response * farthest, 0.0).sum(axis=1)
        return np.nan_to_num(moved, nan=np.inf, posinf=np.inf)

    @cached_property
    def _radius(self) -> float:
        """Growth of an unstable plant in a sample, else 1."""
        return max(1.0, float(np.abs(np.linalg.eigvals(self.A)).max()))

    @cached_property
    def _reaching_inputs(self) -> Array:
        """Least input sizes (nu,) that bring states to their limits.

        The size of an input without limits of its own; infinite where it reaches none. What an unstable plant adds by
        itself does not count.
        """
        limit = first_positive(along_axes(*self.state_rows), along_axes(*self.terminal_rows))
        size = np.full(self.nu, np.inf)
        for response in self._responses(self.A / self._radius):
            with np.errstate(divide="ignore", invalid="ignore"):
                ratio = np.where((response > 0) & (limit > 0)[:, None], limit[:, None] / response, np.inf)
            size = np.minimum(size, ratio.min(axis=0))
        return size

    def _responses(self, A: Array) -> Iterator[Array]:
        """Sizes |A^k B| (nx, nu) of the responses, while finite."""
        block = self.B
        for _ in range(self.horizon):
            yield np.abs(block)
            with np.errstate(over="ignore", invalid="ignore"):
                block = A @ block
            if not np.isfinite(block).all():
                return

    @cached_property
    def price_units(self) -> dict[str, Array]:
        """Unit of each row for pricing soft limits: its bound's size.

        Where a bound is zero (or vanishes beside the set) the extent of the set along the row takes its place; where
        the set has none, what inputs with limits move in one step, else 1.
        """
        return self.limits.price_units()

    @cached_property
    def row_units(self) -> dict[str, Array]:
        """Unit of each row for comparing violations of different rows.

        As `price_units`; where a bound is zero, what the inputs move over the horizon if that is less: limits of 1e6 on
        a state say nothing of its size.
        """
        moved = self._moved_states
        units = dict(self.price_units)
        for kind, (H, h) in (("state", self.state_rows), ("terminal", self.terminal_rows)):
            with np.errstate(invalid="ignore"):
                reach = np.where(H != 0, np.abs(H) * moved, 0.0).sum(axis=1)
            reach[reach == 0] = np.inf
            units[kind] = np.where(np.abs(h) < units[kind], np.clip(reach, np.abs(h), units[kind]), units[kind])
        return units

    def with_model(
        self, A: Any, B: ArrayLike | None = None, E: ArrayLike | None = None, *, P: ArrayLike | None = None
    ) -> Self:
        """Problem for another model.

        Parameters
        ----------
        A, B : arrays, or a discrete-time `control.StateSpace` and None
            The new model.
        E : (nx, nw) array, optional
            By default the present one.
        P : (nx, nx) array, optional
            By default the one that was given to this problem; where none was, the Riccati solution of the new model.
        """
        return replace(self, A=A, B=B, E=self.E if E is None else E, P=self.given_P if P is None else P)


def _checked_uses(value: Any, nw: int) -> tuple[str, ...]:
    """Names in `uses`, checked."""
    names = tuple(value) if isinstance(value, (tuple, list, set, frozenset)) else (value,)
    known = ("reference", "preview") if nw else ("reference",)
    for name in names:
        if name not in known:
            raise InputError("uses", repr(name), f"some of {known}", "" if nw else "A preview needs E.")
    return names
