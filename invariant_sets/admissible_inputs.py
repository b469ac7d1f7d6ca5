"""Filter of inputs that keep a state set."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import daqp
import numpy as np

from ccdtools_ground.door import Immutable
from invariant_sets.engine.certificate import tightened_rows
from invariant_sets.engine.local_problem import left_inverse
from invariant_sets.exceptions import EmptySetError, InputError, UnboundedError
from invariant_sets.input_intervals import nearest_inputs
from invariant_sets.linear_programs import minimise
from invariant_sets.polyhedron import nonempty_body
from invariant_sets.polytope import Polytope
from invariant_sets.system_checks import LinearSystem, Set, checked_system
from invariant_sets.tolerances import FAR_PROPOSAL, LARGEST_ROOM, LP_SOLVER, MEMBERSHIP
from invariant_sets.validation import as_batch, as_vector

Array = np.ndarray


@dataclass(frozen=True, eq=False, repr=False, init=False)
class AdmissibleInputs(Immutable):
    """Inputs {u in U : A x + B u + E w in S for all w}.

    Parameters
    ----------
    A : (nx, nx) array
        State matrix.
    B : (nx, nu) array
        Input matrix.
    S : Polytope, or bounds (lower, upper)
        Where the next state must lie, for example a control invariant set.
    U : Polytope, or bounds (lower, upper)
        Input constraints; nonempty and bounded.
    E : (nx, nw) array, optional
        Disturbance matrix; the identity if W is given without it.
    W : Polytope, or bounds (lower, upper), optional
        Bounded disturbance set.

    Raises
    ------
    InputError
        If shapes do not match or numbers are not finite.
    EmptySetError, UnboundedError
        If U is empty or unbounded.

    Notes
    -----
    Violations are scaled: a row of S is divided by its range over the bounding box of S, so that 1 means "once the
    size of the set away", whatever the units.

    References
    ----------
    Wabersich, Zeilinger (2018), Linear model predictive safety certification for learning-based control, CDC: the
    projection of a proposed input on those that keep the state in an invariant set.
    """

    S: Polytope
    U: Polytope
    rows: _LocalRows  # for the families of this module, and no part of what users are promised

    def __init__(self, A: Any, B: Any, S: Set, U: Set, *, E: Any = None, W: Set | None = None) -> None:
        system, S, U = checked_system(A, B, S, U, E, W, name="S")
        if U.is_empty:
            raise EmptySetError("AdmissibleInputs", "U is empty, no input can be admissible")
        if not U.is_bounded:
            raise UnboundedError("AdmissibleInputs", "U is unbounded. Intersect it with a box")
        self._set(S=S, U=U, rows=_local_rows(system, S, U))

    def __repr__(self) -> str:
        nx = self.rows.after.shape[1]
        nu = self.U.dim
        return f"AdmissibleInputs(nx={nx}, nu={nu}, {len(self.rows.room)} rows of S, {len(self.U.b)} rows of U)"

    def at(self, x: Any) -> Polytope:
        """Admissible inputs at one state x (nx,) as a `Polytope`, possibly empty."""
        x = as_vector(x, "x", size=self.rows.after.shape[1])
        rows = self.rows.slope @ self.rows.back
        return self.U.intersection(Polytope(rows, self.rows.rooms(x[None])[0] + rows @ self.rows.middle))

    def project(self, x: Any, u_proposed: Any) -> tuple[Array, Any]:
        """Nearest admissible input to a proposed one, and whether any exists.

        Parameters
        ----------
        x : (nx,) or (k, nx) array
            States, in the units of x; finite.
        u_proposed : (nu,) or (k, nu) array
            Inputs to project.

        Returns
        -------
        u : (nu,) or (k, nu) array
            The nearest admissible input, in the Euclidean norm of inputs scaled by the half widths of U. Where
            none exists, the input in U with the least scaled violation (and nearest to the proposed one among those).
        admissible : bool or (k,) array of bools
            False where no input keeps the next state in S.

        Notes
        -----
        One input: a closed-form interval. Several: one QP a state (DAQP). It raises for wrong shapes, NaN
        and infinity only.
        """
        rows = self.rows
        states, single = as_batch(x, "x", rows.after.shape[1])
        proposed = _proposals(u_proposed, self.U.dim, len(states))
        rooms = rows.rooms(states)
        wanted = rows.local(proposed)
        if rows.slope.shape[1] == 1:
            low, high = rows.interval
            slope = np.broadcast_to(rows.slope[:, 0], rooms.shape)
            values, violation = nearest_inputs(slope, rooms, low, high, wanted[:, 0])
            v = values[:, None]
            admissible = violation <= MEMBERSHIP
        else:
            v, admissible = _by_programs(rows, rooms, wanted)
        u = rows.middle + v @ rows.size.T
        return (u[0], bool(admissible[0])) if single else (u, admissible)


@dataclass(frozen=True, eq=False, repr=False, init=False)
class AdmissibleInputFamily(Immutable):
    """Admissible inputs of several plants; filter i takes state i.

    Parameters
    ----------
    filters : sequence of AdmissibleInputs
        One a plant (a design, say), all with the same numbers of states and inputs.

    Raises
    ------
    InputError
        If there is none, one is of another type, or the numbers of states and inputs differ.
    """

    filters: tuple[AdmissibleInputs, ...]
    _slope: Array
    _room: Array
    _after: Array

    def __init__(self, filters: Sequence[AdmissibleInputs]) -> None:
        filters = tuple(filters)
        if not filters or not all(isinstance(one, AdmissibleInputs) for one in filters):
            raise InputError("filters", f"{len(filters)} values", "one or more AdmissibleInputs")
        shapes = {(one.rows.after.shape[1], one.U.dim) for one in filters}
        if len(shapes) > 1:
            raise InputError("filters", f"(nx, nu) of {sorted(shapes)}", "the same in all")
        self._set(filters=filters)
        most = max(len(one.rows.room) for one in filters)
        slope = np.zeros((len(filters), most))
        after = np.zeros((len(filters), most, next(iter(shapes))[0]))
        room = np.full((len(filters), most), LARGEST_ROOM)  # a filter with fewer rows gets rows that never matter
        for i, one in enumerate(filters):
            count = len(one.rows.room)
            slope[i, :count] = one.rows.slope[:, 0] if one.rows.slope.shape[1] else 0.0
            room[i, :count] = one.rows.room
            after[i, :count] = one.rows.after
        self._set(_slope=slope, _room=room, _after=after)

    def __repr__(self) -> str:
        return f"AdmissibleInputFamily({len(self.filters)} filters, nx={self._after.shape[2]})"

    def project(self, x: Any, u_proposed: Any) -> tuple[Array, Array]:
        """Nearest admissible input of each filter, and whether any exists.

        Parameters
        ----------
        x, u_proposed : (k, nx) and (k, nu) arrays
            State and proposed input of each of the k filters; finite.

        Returns
        -------
        u, admissible : (k, nu) array and (k,) array of bools
            As `AdmissibleInputs.project`. One input is done for all filters at once.
        """
        states, _ = as_batch(x, "x", self._after.shape[2])
        if len(states) != len(self.filters):
            raise InputError("x", f"{len(states)} rows", f"{len(self.filters)}, one a filter")
        proposed = _proposals(u_proposed, self.filters[0].U.dim, len(states))
        if any(one.rows.slope.shape[1] != 1 for one in self.filters):
            answers = [one.project(*pair) for one, *pair in zip(self.filters, states, proposed)]
            return np.array([u for u, _ in answers]), np.array([admissible for _, admissible in answers])
        with np.errstate(over="ignore", invalid="ignore"):
            rooms = self._room + np.einsum("kmn,kn->km", self._after, states)
        rooms = np.clip(np.nan_to_num(rooms, nan=-LARGEST_ROOM), -LARGEST_ROOM, LARGEST_ROOM)
        wanted = np.array([one.rows.local(u[None])[0, 0] for one, u in zip(self.filters, proposed)])
        ends = np.array([one.rows.interval for one in self.filters])
        v, violation = nearest_inputs(self._slope, rooms, ends[:, 0], ends[:, 1], wanted)
        u = np.array([one.rows.middle + one.rows.size[:, 0] * value for one, value in zip(self.filters, v)])
        return u, violation <= MEMBERSHIP


@dataclass(frozen=True)
class _LocalRows(Immutable):
    """Rows on v, u = middle + size v: slope v <= room + after x, H v <= h."""

    middle: Array
    size: Array
    back: Array
    after: Array
    slope: Array
    room: Array
    H: Array
    h: Array

    @property
    def interval(self) -> tuple[float, float]:
        """Smallest and largest v of a single input."""
        ends = self.h / self.H[:, 0]
        side = self.H[:, 0]
        return float(ends[side < 0].max()), float(ends[side > 0].min())

    def rooms(self, states: Array) -> Array:
        """Room (k, m) of each row of S before the input acts."""
        with np.errstate(over="ignore", invalid="ignore"):
            rooms = self.room + states @ self.after.T
        return np.asarray(np.clip(np.nan_to_num(rooms, nan=-LARGEST_ROOM), -LARGEST_ROOM, LARGEST_ROOM))

    def local(self, u: Array) -> Array:
        """Inputs (k, nu) as v (k, q)."""
        with np.errstate(over="ignore"):
            return np.asarray(np.clip((u - self.middle) @ self.back.T, -LARGEST_ROOM, LARGEST_ROOM))


def _local_rows(system: LinearSystem, S: Polytope, U: Polytope) -> _LocalRows:
    """Rows of S and U in coordinates with unit extents of U."""
    body = nonempty_body(U, "AdmissibleInputs")
    F, g = tightened_rows(S, system.disturbances)
    after = -F @ system.A
    push = F @ system.B
    return _LocalRows(
        body.centre,
        body.basis,
        left_inverse(body.basis),
        after,
        push @ body.basis,
        g - push @ body.centre,
        body.F,
        body.g,
    )


def _proposals(value: Any, nu: int, count: int) -> Array:
    """Proposed inputs (count, nu), or raise `InputError`."""
    proposed, _ = as_batch(value, "u_proposed", nu)
    if len(proposed) != count:
        raise InputError("u_proposed", f"{len(proposed)} rows", f"{count} as in x")
    return proposed


def _by_programs(rows: _LocalRows, rooms: Array, wanted: Array) -> tuple[Array, Array]:
    """Nearest admissible v (k, q) by QPs, and whether each is admissible."""
    v = np.zeros(wanted.shape)
    admissible = np.zeros(len(rooms), bool)
    for k, room in enumerate(rooms):
        nearest = _nearest(rows, room + 0.5 * MEMBERSHIP, wanted[k])
        if nearest is None or not _meets(rows, nearest, room):
            nearest = _least_violation(rows, room, wanted[k])
        v[k] = nearest
        admissible[k] = _meets(rows, nearest, room)
    return v, admissible


def _meets(rows: _LocalRows, v: Array, room: Array) -> bool:
    """Whether v meets all rows of S to the tolerance."""
    return bool((rows.slope @ v - room).max(initial=-np.inf) <= MEMBERSHIP)


def _nearest(rows: _LocalRows, room: Array, wanted: Array) -> Array | None:
    """Point of U nearest to `wanted` with slope·v <= room, or None."""
    if not len(wanted):
        return wanted
    reach = np.abs(wanted).max()
    target = wanted if reach < FAR_PROPOSAL else wanted / reach * FAR_PROPOSAL
    program = np.vstack([rows.slope, rows.H])  # a new array: DAQP wants one that it could write to
    v, _, flag, _ = daqp.solve(np.eye(len(target)), -target, program, np.append(room, rows.h), primal_tol=LP_SOLVER)
    return np.array(v) if flag == 1 and (rows.H @ v - rows.h).max(initial=0.0) <= MEMBERSHIP else None


def _least_violation(rows: _LocalRows, room: Array, wanted: Array) -> Array:
    """Input in U with the least largest scaled violation."""
    nu = len(wanted)
    if nu == 0 or not len(room):
        return wanted
    shift = room.min()
    spread = max(1.0, float(np.minimum(room - shift, LARGEST_ROOM).max()))
    matrix = np.block([[rows.slope / spread, -np.ones((len(room), 1))], [rows.H, np.zeros((len(rows.H), 1))]])
    norms = np.linalg.norm(matrix, axis=1)
    right = np.append((room - shift) / spread, rows.h) / norms
    cost = np.zeros(nu + 1)
    cost[nu] = 1.0
    value, best = minimise(cost, matrix / norms[:, None], right)
    if best is None:  # pragma: no cover - U is nonempty and bounded, so a minimiser exists
        return np.zeros(nu)
    nearest = _nearest(rows, room - shift + (value + MEMBERSHIP) * spread, wanted)
    return best[:nu] if nearest is None else nearest
