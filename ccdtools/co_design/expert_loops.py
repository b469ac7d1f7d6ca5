"""Closed loops of the expert, with filters that keep them in X_fea(p)."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import torch

from ccdtools.arrays import Array, Indices, Mask
from ccdtools.co_design.candidates import Starts
from ccdtools.co_design.differentiable_model import Stepper
from ccdtools.co_design.problem import CoDesignProblem
from ccdtools.co_design.tolerances import LED_BACK, VALUE_TAIL, VISITS
from ccdtools.controllers.controllers import Controller
from ccdtools.progress import counted
from invariant_sets import AdmissibleInputs, Polytope
from mpc import LinearMPC


def follow(
    problem: CoDesignProblem, loops: ExpertLoops, gamma: float, rng: np.random.Generator, *, progress: bool = False
) -> tuple[Array, Array, Array]:
    """Closed loops on the problem's model and disturbances, recorded at `VISITS`.

    States (v, n, nx), inputs (v, n, nu) and discounted returns (v, n) of v visits; NaN where a run has diverged.
    """
    x = loops.starts.x
    steps = VISITS[-1] + VALUE_TAIL
    w = problem.driving(len(x), steps, rng)
    updated = None if problem.discrepancy is None else UpdatedSteps(problem, loops.starts.p)
    rewards = np.empty((steps, len(x)))
    visited = []
    actions = []
    for k in counted(range(steps), "expert's closed loops", total=steps, progress=progress):
        u = loops.inputs(x)
        if k in VISITS:
            visited.append(x)
            actions.append(u)
        before = x
        x, penalty = updated(x, u, w[:, k]) if updated else (loops.starts.regions.disturbed(x, u, w[:, k]), 0.0)
        x = np.where((np.abs(x) <= problem.limit).all(axis=1, keepdims=True), x, np.nan)
        earned = problem.objective.rewards(x, u, before, loops.starts.p) - penalty
        rewards[k] = np.where(np.isnan(x).any(axis=1), np.nan, earned)
    future = rewards[-VALUE_TAIL // 4 :].mean(axis=0) / (1 - gamma)  # stationary by then
    values = []
    for k in reversed(range(steps)):
        future = rewards[k] + gamma * future
        if k in VISITS:
            values.append(future)
    return np.array(visited), np.array(actions), np.array(values[::-1])


class ExpertLoops:
    """Filtered LQR, or MPC, at the designs of the starts.

    Parameters
    ----------
    problem : CoDesignProblem
    starts : Starts
    expert : {"lqr", "mpc", "explicit"}
    horizon : int
        Of the MPC experts.
    progress : bool
    """

    def __init__(
        self, problem: CoDesignProblem, starts: Starts, expert: str, horizon: int, *, progress: bool = False
    ) -> None:
        self.starts = starts
        self.filters = SetFilters(problem, starts)
        self.controllers: list[Controller] | None = None
        if expert != "lqr":
            weights = [problem.weights(p).keywords() for p in starts.p]
            kept = [problem.kept_by_mpc(p) for p in starts.p]
            applied = [problem.input_limits(p) for p in starts.p]
            models = zip(starts.regions.A, starts.regions.B, weights, kept, applied)
            laws = [LinearMPC(A, B, **own, horizon=horizon, X=X, U=U) for A, B, own, X, U in models]
            made: Any = counted(laws, f"{expert} of every design", total=len(laws), progress=progress)
            self.controllers = [law.explicit() if expert == "explicit" else law for law in made]

    def inputs(self, x: Array) -> Array:
        """Expert's inputs (n, nu); NaN where the state is."""
        if self.controllers is None:
            u = self.starts.regions.inputs(x, np.arange(len(x)))
            return self.filters.filtered(x, u)
        u = np.full((len(x), self.starts.regions.B.shape[2]), np.nan)
        for i in np.flatnonzero(np.isfinite(x).all(axis=1)):
            u[i] = self.controllers[i](x[i])
        return u


class UpdatedSteps:
    """Steps of a model with learned error, one design per run."""

    def __init__(self, problem: CoDesignProblem, p: Array) -> None:
        self._step = Stepper.at(problem, torch.tensor(p, dtype=torch.float32))
        self._e = torch.zeros(len(p), problem.model.nx)

    @torch.no_grad()
    def __call__(self, x: Array, u: Array, w: Array) -> tuple[Array, Array]:
        """Next states (n, nx) and penalties (n,) under errors or draws (n, nx).

        NaN where the state is: a lost run takes its step from the origin, so that no draw is looked up at NaN.
        """
        running = np.isfinite(x).all(axis=1, keepdims=True)
        state, applied = (torch.tensor(np.where(running, a, 0.0), dtype=torch.float32) for a in (x, u))
        drawn = torch.tensor(w, dtype=torch.float32)
        x_next, self._e, (penalty,) = self._step.advance(state, self._e, applied, drawn)
        return np.where(running, x_next.double().numpy(), np.nan), penalty.double().numpy()


class SetFilters:
    """Filters that keep each run's next nominal state in its known X_fea.

    Runs of one design share a filter, and products of all rows with all states are formed in pieces: with 300 facets
    and 1000 runs they would not fit otherwise.
    """

    def __init__(self, problem: CoDesignProblem, starts: Starts) -> None:
        self.problem = problem
        self.scale = problem.state_scale
        self.model = starts.regions
        guarded = [i for i, S in enumerate(starts.sets) if S is not None and not S.is_empty]
        groups: dict[int, list[int]] = {}
        for i in guarded:
            groups.setdefault(id(starts.sets[i]), []).append(i)
        self.groups = [np.array(runs) for runs in groups.values()]
        self.sets: list[Polytope] = [S for runs in self.groups if (S := starts.sets[runs[0]]) is not None]
        self._filters: dict[int, AdmissibleInputs] = {}

    def filtered(self, x: Array, u: Array) -> Array:
        """Inputs (n, nu), if needed the nearest that stay in the set."""
        u = u.copy()
        for piece in self._pieces:
            runs = piece.runs
            after = piece.states @ x[runs].swapaxes(1, 2) + piece.inputs @ u[runs].swapaxes(1, 2)
            leaving = (after > piece.limits[:, :, None]).any(axis=1)  # NaN is not
            leaving &= piece.first & np.isfinite(x[runs]).all(axis=2)
            for g in np.flatnonzero(leaving.any(axis=1)):
                chosen = runs[g][leaving[g]]
                chosen = chosen[self.sets[piece.begin + int(g)].contains(x[chosen], LED_BACK)]
                if len(chosen) == 0:
                    continue
                u[chosen] = self._filter(piece.begin + int(g)).project(x[chosen], u[chosen])[0]
        return u

    def _filter(self, g: int) -> AdmissibleInputs:
        """Filter that keeps states of group g in their set."""
        if g not in self._filters:
            i = self.groups[g][0]
            U = self.problem.input_limits(self.model.designs[i])
            self._filters[g] = AdmissibleInputs(self.model.A[i], self.model.B[i], self.sets[g], U)
        return self._filters[g]

    @cached_property
    def _pieces(self) -> list[_Piece]:
        """Groups, as many at once as fit."""
        if not self.groups:
            return []
        rows = max(len(S.b) for S in self.sets)
        members = max(len(runs) for runs in self.groups)
        width = rows * (self.model.A.shape[1] + self.model.B.shape[2] + 1 + members)
        step = max(1, 2**21 // width)  # 16 MiB
        return [self._piece(begin, min(begin + step, len(self.groups))) for begin in range(0, len(self.groups), step)]

    def _piece(self, begin: int, end: int) -> _Piece:
        """Groups `begin` to `end`, rows scaled to X."""
        groups = self.groups[begin:end]
        rows = max(len(S.b) for S in self.sets[begin:end])
        members = max(len(runs) for runs in groups)
        F = np.zeros((len(groups), rows, len(self.scale)))
        limits = np.ones((len(groups), rows))
        runs = np.array([np.resize(own, members) for own in groups])
        first = np.arange(members) < np.array([len(own) for own in groups])[:, None]
        for g, S in enumerate(self.sets[begin:end]):
            size = np.abs(S.A) @ self.scale
            F[g, : len(S.b)] = S.A / size[:, None]
            limits[g, : len(S.b)] = S.b / size
        A = self.model.A[runs[:, 0]]
        B = self.model.B[runs[:, 0]]
        return _Piece(begin, runs, first, F @ A, F @ B, limits)


@dataclass(frozen=True, eq=False)
class _Piece:
    """Padded groups of runs (g, r), first occurrences, and rows on x, u and right."""

    begin: int
    runs: Indices
    first: Mask
    states: Array
    inputs: Array
    limits: Array
