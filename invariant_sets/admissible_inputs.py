"""The inputs that keep the next state in a set: a filter to put behind any controller."""

from __future__ import annotations

from typing import Any

import daqp
import numpy as np

from invariant_sets.engine.certificate import relative_rows
from invariant_sets.exceptions import EmptySetError, InputError, UnboundedError
from invariant_sets.linear_programs import minimise
from invariant_sets.polytope import Polytope
from invariant_sets.system_checks import checked_system
from invariant_sets.validation import as_batch, as_vector, frozen

Array = np.ndarray
_TOLERANCE = 1e-9  # of the extent of S: a smaller violation counts as admissible
_LARGE = 1e150  # beyond this the arithmetic is clipped, so that a diverged state cannot raise


class AdmissibleInputs:
    """The set {u in U : A x + B u + E w in S for every w in W}, as a function of the state x.

    Parameters
    ----------
    A : (nx, nx) array
        State matrix.
    B : (nx, nu) array
        Input matrix.
    S : Polytope
        Where the next state must lie, for example a control invariant set.
    U : Polytope
        Input constraints; nonempty and bounded.
    E : (nx, nw) array, optional
        Disturbance matrix; the identity if W is given without it.
    W : Polytope, optional
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

    def __init__(self, A: Any, B: Any, S: Polytope, U: Polytope, *, E: Any = None, W: Polytope | None = None) -> None:
        A, B, E = checked_system(A, B, S, U, E, W, state_set="S")
        if U.is_empty:
            raise EmptySetError("U is empty; no input can be admissible.")
        if not U.is_bounded:
            raise UnboundedError("U is unbounded, expected a bounded input set.")
        body = U._body
        assert body is not None
        self._A, self._B, self.S, self.U = frozen(A), frozen(B), S, U
        self._middle, self._size = body.centre, body.basis  # u = middle + size v
        self._back = np.linalg.pinv(body.basis)
        F, g = relative_rows(S)
        if E is not None and W is not None:
            g = g - (F @ E @ W.vertices.T).max(axis=1)
        self._next, self._slope, self._room = -F @ A, F @ B @ self._size, g - F @ B @ self._middle
        self._H, self._h = body.F, body.g
        self._rows = np.ascontiguousarray(np.vstack([self._slope, self._H]))

    def at(self, x: Any) -> Polytope:
        """Return the admissible inputs at one state x (nx,) as a `Polytope`, possibly empty."""
        x = as_vector(x, "x", size=self._A.shape[0])
        rooms = self._rooms(x[None])[0]
        rows = self._slope @ self._back
        return self.U.intersection(Polytope(rows, rooms + rows @ self._middle))

    def project(self, x: Any, u_proposed: Any) -> tuple[Array, Any]:
        """Return the admissible input nearest to a proposed one, and whether there is any.

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
        nx, nu = self._B.shape
        states, single = as_batch(x, "x", nx)
        proposed, _ = as_batch(u_proposed, "u_proposed", nu)
        if len(states) != len(proposed):
            raise InputError(f"u_proposed has {len(proposed)} rows, expected {len(states)} as in x.")
        with np.errstate(over="ignore"):
            wanted = np.clip((proposed - self._middle) @ self._back.T, -_LARGE, _LARGE)
        rooms = self._rooms(states)
        v, admissible = self._intervals(rooms, wanted) if self._slope.shape[1] == 1 else self._programs(rooms, wanted)
        for k in np.flatnonzero(~admissible):
            v[k] = self._least_violation(rooms[k], wanted[k])
            admissible[k] = (self._slope @ v[k] - rooms[k]).max(initial=-np.inf) <= _TOLERANCE  # DAQP may have given up
        u = self._middle + v @ self._size.T
        return (u[0], bool(admissible[0])) if single else (u, admissible)

    def _rooms(self, states: Array) -> Array:
        """Return what is left of each row of S before the input acts, (k, m)."""
        with np.errstate(over="ignore", invalid="ignore"):
            rooms = self._room + states @ self._next.T
        return np.clip(np.nan_to_num(rooms, nan=-_LARGE), -_LARGE, _LARGE)

    def _intervals(self, rooms: Array, wanted: Array) -> tuple[Array, Array]:
        slope = self._slope[:, 0]
        up, down = slope > 1e-14, slope < -1e-14
        low = float((self._h / self._H[:, 0])[self._H[:, 0] < 0].max())
        high = float((self._h / self._H[:, 0])[self._H[:, 0] > 0].min())
        lower = (rooms[:, down] / slope[down]).max(axis=1, initial=low)
        upper = (rooms[:, up] / slope[up]).min(axis=1, initial=high)
        # at the nearest input, is every row met to the tolerance?
        middle = (lower + upper) / 2
        lower, upper = np.where(lower > upper, middle, lower), np.where(lower > upper, middle, upper)
        v = np.clip(np.clip(wanted[:, 0], lower, upper), low, high)
        violation = (v[:, None] * slope - rooms).max(axis=1, initial=-np.inf)
        return v[:, None], violation <= _TOLERANCE

    def _programs(self, rooms: Array, wanted: Array) -> tuple[Array, Array]:
        v, admissible = np.zeros(wanted.shape), np.zeros(len(rooms), bool)
        for k in range(len(rooms)):
            nearest = self._nearest(rooms[k] + 0.5 * _TOLERANCE, wanted[k])
            if nearest is not None:
                v[k] = nearest
                admissible[k] = (self._slope @ nearest - rooms[k]).max(initial=-np.inf) <= _TOLERANCE
        return v, admissible

    def _nearest(self, room: Array, wanted: Array) -> Array | None:
        """Return the point of U nearest to `wanted` with slope·v <= room, or None."""
        if not len(wanted):
            return wanted
        reach = np.abs(wanted).max()
        target = wanted if reach < 1e6 else wanted / reach * 1e6
        v, _, flag, _ = daqp.solve(np.eye(len(target)), -target, self._rows, np.append(room, self._h),
                                   primal_tol=1e-10)
        return np.array(v) if flag == 1 and (self._H @ v - self._h).max(initial=0.0) <= 1e-8 else None

    def _least_violation(self, room: Array, wanted: Array) -> Array:
        """Return the input in U whose largest scaled violation is least."""
        nu = len(wanted)
        if nu == 0 or not len(room):
            return wanted
        shift = room.min()
        spread = max(1.0, float(np.minimum(room - shift, _LARGE).max()))
        rows = np.block([[self._slope / spread, -np.ones((len(room), 1))], [self._H, np.zeros((len(self._H), 1))]])
        norms = np.linalg.norm(rows, axis=1)
        right = np.append((room - shift) / spread, self._h) / norms
        cost = np.zeros(nu + 1)
        cost[nu] = 1.0
        value, best = minimise(cost, rows / norms[:, None], right)
        if best is None:  # pragma: no cover - U is nonempty and bounded, so a minimiser exists
            return self._nearest(np.full(len(room), _LARGE), wanted)  # type: ignore[return-value]
        allowed = room - shift + (value + 1e-9) * spread
        nearest = self._nearest(allowed, wanted)
        return best[:nu] if nearest is None else nearest
