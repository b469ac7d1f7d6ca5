"""What an expert would do, over the whole box of states and designs.

References
----------
Chen et al., "Approximating explicit model predictive control using constrained neural networks", ACC 2018
(projection on the control invariant set); the design joins the state as in Tsai et al., section "Initialization".
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property, partial

import numpy as np
from scipy.stats import qmc
from tqdm import tqdm, trange

from ccdtools.arrays import Array, Immutable, frozen
from ccdtools.checks import as_choice, as_count, as_generator, as_instance, as_share
from ccdtools.co_design.problem import CoDesignProblem
from ccdtools.controllers.controllers import Controller
from ccdtools.exceptions import InputError
from ccdtools.plants.linear_model import LinearModel
from invariant_sets import AdmissibleInputs, ParametricSet, Polytope
from mpc import LinearMPC, lqr

EXPERTS = ("lqr", "mpc", "explicit")
VISITS = (0, 1, 2, 4, 8, 16, 32, 64)  # steps of each closed loop whose states join the data
SET_WORK = 5e6  # designs × facets² of the initialisation: 8000 designs of 24 facets, 50 of 300
FEWEST_DESIGNS = 12
TAIL = 400  # further steps that the values look ahead; 0.99⁴⁰⁰ = 2 %, and the rest is extrapolated


@dataclass(frozen=True, eq=False, repr=False)
class ExpertData(Immutable):
    """Samples (x, p) → (u, V) of an expert.

    Attributes
    ----------
    inputs : (n, nx + np) array
        States and designs.
    actions : (n, nu) array
    values : (n,) array
        Discounted returns of that same controller; NaN where its run diverged.
    acceptance : float
        Fraction of the Latin hypercube samples that lay in X_fea(p).
    diverged : float
        Fraction of the accepted samples whose closed loop diverged under the disturbance.
    """

    inputs: Array
    actions: Array
    values: Array
    acceptance: float
    diverged: float

    def __post_init__(self) -> None:
        for name in ("inputs", "actions", "values"):
            object.__setattr__(self, name, frozen(np.array(getattr(self, name), dtype=float)))

    def __repr__(self) -> str:
        return f"ExpertData({len(self.inputs)} samples, {self.acceptance:.0%} feasible, {self.diverged:.1%} diverged)"


def feasible_sets(problem: CoDesignProblem) -> ParametricSet:
    """X_fea(p): the maximal control invariant set of every design, computed when asked for."""
    as_instance("problem", problem, CoDesignProblem, "a CoDesignProblem")
    return ParametricSet(partial(_state_and_input_matrices, problem.model), problem.X, problem.U)


def _state_and_input_matrices(model: LinearModel, design: Array) -> tuple[Array, Array]:
    """A(p) and B(p); a function of the module, so that the family of sets can be pickled."""
    A, B, _ = model.matrices(design)
    return A, B


def expert_dataset(
    problem: CoDesignProblem,
    *,
    samples: int,
    rng: np.random.Generator,
    expert: str = "lqr",
    gamma: float = 0.99,
    horizon: int = 10,
    designs: int | None = None,
    sets: ParametricSet | None = None,
    progress: bool = False,
) -> ExpertData:
    """Feasible states and designs with the expert's inputs and values.

    Candidates (x, p) fill X × design box by Latin hypercube sampling; those with x in X_fea(p) are accepted,
    each with its own design. From each, the expert's noisy closed loop is followed: the states it visits join the
    data, because a uniform sample hardly ever meets the neighbourhood of the origin, where the loop spends its time.

    Parameters
    ----------
    problem : CoDesignProblem
        Its scenarios' disturbance drives the closed loops.
    samples : int
        Candidates.
    rng : numpy.random.Generator
    expert : {"lqr", "mpc", "explicit"}
        LQR projected on the inputs that keep the next state in X_fea(p); online MPC; or the explicit MPC of
        every design, as in Chen et al.
    gamma : float
        Discount of the values: the training convention.
    horizon : int
        Of the MPC experts.
    designs : int, optional
        Distinct designs among the candidates. By default every candidate has its own, unless X_fea at the centre of
        the design box has so many facets that fewer designs must do.
    sets : ParametricSet, optional
        X_fea, if already at hand.

    Raises
    ------
    InputError
        If an argument is of the wrong kind or out of range, or no candidate is feasible.
    """
    as_instance("problem", problem, CoDesignProblem, "a CoDesignProblem")
    samples = as_count("samples", samples)
    as_generator("rng", rng)
    as_choice("expert", expert, EXPERTS)
    gamma = as_share("gamma", gamma)
    horizon = as_count("horizon", horizon)
    sets = as_instance(
        "sets", feasible_sets(problem) if sets is None else sets, ParametricSet, "a ParametricSet or None"
    )
    designs = min(samples, _affordable_designs(problem, sets) if designs is None else as_count("designs", designs))
    x, p, feasible = _accepted(problem, sets, samples, designs, rng, progress)
    loops = _Loops(problem, p, feasible, expert, horizon, progress)
    visited, actions, values, lost = _follow(problem, loops, x, gamma, rng, progress)
    inputs = np.concatenate([np.hstack([v, p]) for v in visited])
    known = np.isfinite(inputs).all(axis=1)
    return ExpertData(
        inputs[known], np.concatenate(actions)[known], np.concatenate(values)[known], len(x) / samples, lost
    )


def _affordable_designs(problem: CoDesignProblem, sets: ParametricSet) -> int:
    """How many sets to compute: the time of one grows with about the square of its facets."""
    facets = len(sets.at(problem.design.from_unit(np.full(problem.design.dim, 0.5))).b)
    return max(FEWEST_DESIGNS, int(SET_WORK / max(facets, 1) ** 2))


def _accepted(problem, sets, samples, distinct, rng, progress) -> tuple[Array, Array, list[Polytope]]:
    """Feasible states (n, nx) with their designs (n, np) and their sets."""
    lower, upper = problem.X.bounding_box()
    cube = qmc.LatinHypercube(problem.model.nx + problem.design.dim, rng=rng).random(samples)
    states = lower + cube[:, : problem.model.nx] * (upper - lower)
    designs = problem.design.from_unit(cube[:, problem.model.nx :])
    if distinct < samples:
        designs = problem.design.latin_hypercube(distinct, rng)[np.arange(samples) % distinct]
    chosen = []
    feasible = []
    for i in tqdm(range(samples), desc="X_fea(p)", disable=not progress, leave=False):
        set_of_design = sets.at(designs[i])
        if set_of_design.contains(states[i]):
            chosen.append(i)
            feasible.append(set_of_design)
    if not chosen:
        cure = "Take more samples, or check that X, U and the design bounds leave anything to control."
        raise InputError("samples", f"{samples} candidates of which none lies in X_fea(p)", "at least one", cure)
    return states[chosen], designs[chosen], feasible


def _follow(problem, loops: _Loops, x: Array, gamma: float, rng, progress):
    """States, inputs and values of the closed loops at `VISITS`, and the fraction that diverged."""
    n = len(x)
    steps = VISITS[-1] + TAIL
    w = problem.scenarios.sample(n, steps, rng)[1]
    rewards = np.empty((steps, n))
    visited = []
    actions = []
    for k in trange(steps, desc="expert", disable=not progress, leave=False):
        u = loops.inputs(x)
        if k in VISITS:
            visited.append(x)
            actions.append(u)
        x = loops.step(x, u, w[:, k])
        x = np.where((np.abs(x) <= problem.limit).all(axis=1, keepdims=True), x, np.nan)
        rewards[k] = problem.objective.rewards(x, u)
    future = rewards[-TAIL // 4 :].mean(axis=0) / (1 - gamma)  # stationary by then
    values = []
    for k in reversed(range(steps)):
        future = rewards[k] + gamma * future
        if k in VISITS:
            values.append(future)
    return visited, actions, values[::-1], float(np.isnan(future).mean())


class _Loops:
    """The expert's closed loops, one design each."""

    def __init__(self, problem, p, feasible, expert, horizon, progress) -> None:
        self.problem = problem
        self.feasible = feasible
        self._filters: dict[int, AdmissibleInputs] = {}
        self.A, self.B, self.E = problem.model.matrices(p)
        self.lower, self.upper = problem.input_bounds
        Q = problem.objective.Q
        R = problem.objective.R
        self.K = np.array([lqr(A, B, Q=Q, R=R)[0] for A, B in zip(self.A, self.B)])
        self.controllers: list[Controller] | None = None
        if expert != "lqr":
            mpc = [LinearMPC(A, B, Q=Q, R=R, horizon=horizon, X=problem.X, U=problem.U) for A, B in zip(self.A, self.B)]
            bar = tqdm(mpc, desc=expert, disable=not progress, leave=False)
            self.controllers = [law.explicit() if expert == "explicit" else law for law in bar]

    def step(self, x: Array, u: Array, w: Array) -> Array:
        """Next states (n, nx)."""
        return _times(self.A, x) + _times(self.B, u) + _times(self.E, w)

    def inputs(self, x: Array) -> Array:
        """The expert's inputs (n, nu); NaN where the state is."""
        alive = np.isfinite(x).all(axis=1)
        if self.controllers is not None:
            u = np.full((len(x), self.B.shape[2]), np.nan)
            for i in np.flatnonzero(alive):
                u[i] = self.controllers[i](x[i])
            return u
        u = np.clip(-_times(self.K, x), self.lower, self.upper)
        FA, FB, g = self._rows
        leaving = np.asarray(alive & (_times(FA, x) + _times(FB, u) > g).any(axis=1))
        for i in np.flatnonzero(leaving):
            u[i] = self._filter(int(i)).project(x[i], u[i])[0]
        return u

    def _filter(self, i: int) -> AdmissibleInputs:
        """What keeps the next state of run i in X_fea(p)."""
        if i not in self._filters:
            self._filters[i] = AdmissibleInputs(self.A[i], self.B[i], self.feasible[i], self.problem.U)
        return self._filters[i]

    @cached_property
    def _rows(self) -> tuple[Array, Array, Array]:
        """All X_fea(p) stacked: F A (n, m, nx), F B (n, m, nu) and g (n, m), rows scaled to the size of X."""
        m = max(len(S.b) for S in self.feasible)
        n = len(self.feasible)
        nx = self.problem.model.nx
        F = np.zeros((n, m, nx))
        g = np.ones((n, m))
        for i, S in enumerate(self.feasible):
            size = np.abs(S.A) @ self.problem.state_scale
            F[i, : len(S.b)] = S.A / size[:, None]
            g[i, : len(S.b)] = S.b / size
        return F @ self.A, F @ self.B, g


def _times(M: Array, x: Array) -> Array:
    """M[i] @ x[i] for every i."""
    return np.einsum("nij,nj->ni", M, x)
