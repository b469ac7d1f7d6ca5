"""Co-design with disturbances known ahead, as states of the model."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.linalg import block_diag

from ccdtools.arrays import Array, ArrayField, Immutable
from ccdtools.co_design.objective import Objective, QuadraticObjective, Weights, as_objective
from ccdtools.co_design.problem import CoDesignProblem, Scenarios
from ccdtools.co_design.tolerances import PREVIEW_ROOM
from ccdtools.design_limits import DesignLimits, Limits
from ccdtools.exceptions import InputError
from ccdtools.output_limits import OutputLimits
from ccdtools.plants.preview import as_channels, previewed_state, with_preview
from ccdtools_ground.door import as_array, as_count, as_instance, has_method
from invariant_sets import Polytope
from invariant_sets.system_checks import as_set


def previewed_problem(
    problem: CoDesignProblem, steps: int, *, channels: Sequence[int] | None = None, W: Any = None
) -> CoDesignProblem:
    """Problem with disturbances known ahead.

    LQR, MPC, the expert and the learned policy see them.

    Its state is (x, w_k, …, w_{k+N−1}), see `with_preview`; a policy found for it runs on the plant itself as
    `Previewing(policy, steps)`. X_fea of so many states is out of reach: `expert_dataset` falls back on the region that
    LQR keeps; say `sets="lqr"`, and it does not try.

    Parameters
    ----------
    problem : CoDesignProblem
        Without a learned discrepancy.
    steps : int
        N samples, the present one included.
    channels : sequence of int, optional
        Which disturbances are known ahead, from 0; all by default.
    W : Polytope, or bounds (lower, upper), optional
        Limits of those disturbances, beside X; by default three times the largest of 200 episodes: nothing
        can be done about what is coming, and limits of it must not bind.

    Raises
    ------
    InputError
        If an argument is of the wrong kind or size, or the problem has a discrepancy or a measurement.

    Examples
    --------
    >>> ahead = previewed_problem(problem, 10)
    >>> data = expert_dataset(ahead, samples=1000, sets="lqr", rng=rng)
    """
    as_instance("problem", problem, CoDesignProblem, "a CoDesignProblem")
    if problem.discrepancy is not None:
        got = "a problem with a discrepancy, whose disturbance is not known ahead"
        raise InputError("problem", got, "one without", "Learn the errors of the model with_preview gives.")
    if problem.measurement is not None:
        raise InputError("problem", "one with a measurement", "one without: what is known ahead is no state of a plant")
    steps = as_count("steps", steps)
    known = as_channels(channels, problem.model.nw)
    scenarios = PreviewedScenarios(problem.scenarios, steps, known)
    if W is None:
        W = _drawn_bounds(problem, known)
    return replace(
        problem, model=with_preview(problem.model, steps, channels=known), scenarios=scenarios,
        X=previewed_limits(problem.X, W, steps, channels=len(known)),
        objective=previewed_objective(problem.objective, steps, channels=len(known)),
        output_limits=previewed_output_limits(problem.output_limits, problem.model.nx),
    )  # fmt: skip


def previewed_limits(X: Any, W: Any, steps: int, *, channels: int = 1) -> Limits:
    """Limits of (x, w_k, …, w_{k+N−1}): X, and W of each sample.

    Parameters
    ----------
    X : Polytope, bounds (lower, upper) with one number per state, or the X(p) of a problem
    W : Polytope, or bounds (lower, upper)
        Of the disturbances known ahead; beside an X(p), their box.
    steps : int
        N.
    channels : int
        How many disturbances are known ahead.
    """
    W = as_set(W, "W", as_count("channels", channels))
    if isinstance(X, DesignLimits):
        lower, upper = W.bounding_box()
        return X.followed_by(*(np.tile(bound, as_count("steps", steps)) for bound in (lower, upper)))
    nx = X.dim if isinstance(X, Polytope) else np.size(X[0])
    limits: Polytope = as_set(X, "X", nx)
    for _ in range(as_count("steps", steps)):
        limits = limits.cartesian_product(W)
    return limits


def previewed_objective(objective: Objective, steps: int, *, channels: int = 1) -> Objective:
    """Objective of the state (x, w_k, …, w_{k+N−1}) that judges x alone."""
    length = as_count("steps", steps) * as_count("channels", channels)
    as_objective("objective", objective)
    if type(objective) is not QuadraticObjective:
        return PreviewedObjective(objective, length, design_cost=objective.design_cost, episode=objective.episode)
    return replace(objective, **_with_register(objective.weights(np.zeros(0), 0, 0), length).keywords())


@dataclass(frozen=True, eq=False, repr=False)
class PreviewedObjective(Objective):
    """Rewards of another objective, without the register's states."""

    own: Objective
    length: int  # of the register

    def __repr__(self) -> str:
        return f"{self.own!r} before a register of {self.length}"

    @property
    def looks_back(self) -> bool:
        """Whether the other does."""
        return self.own.looks_back

    def jump(self, X: tuple[Array, Array], *others: tuple[Array, Array]) -> str:
        """Where the other jumps."""
        return self.own.jump((self._own(X[0]), self._own(X[1])), *others)

    def rewards(self, x_next: Any, u: Any, x: Any = None, p: Any = None) -> Any:
        """Rewards (...,) of x (..., nx + register) and u (..., nu)."""
        return self.own.rewards(self._own(x_next), u, None if x is None else self._own(x), p)

    def final_rewards(self, x: Any, p: Any) -> Any:
        """Rewards of the end by `own`, without the register."""
        return self.own.final_rewards(self._own(x), p)

    def weights(self, p: Array, nx: int, nu: int) -> Weights:
        """Weights of `own`, with none on the register."""
        return _with_register(self.own.weights(p, nx - self.length, nu), self.length)

    def check(self, nx: int, nu: int, designs: int) -> None:
        """Raise an `InputError` unless `own` fits without the register."""
        self.own.check(nx - self.length, nu, designs)

    def describe(self) -> dict[str, Any]:
        """Description of `own`."""
        return self.own.describe()

    def _own(self, x: Any) -> Any:
        """States without the register."""
        return x[..., : x.shape[-1] - self.length]


def _with_register(own: Weights, length: int) -> Weights:
    """Weights with none on the register."""
    S = None if own.S is None else np.vstack([own.S, np.zeros((length, len(own.R)))])
    return Weights(block_diag(own.Q, np.zeros((length, length))), own.R, S)


def previewed_output_limits(limits: OutputLimits | None, nx: int) -> OutputLimits | None:
    """Limits of outputs of the first nx states, if there are any."""
    if limits is None:
        return None
    own = limits.outputs

    def outputs(x: Any, u: Any, p: Any) -> Any:
        """Outputs of CasADi columns, without the register."""
        return own.function(nx, u.numel(), p.numel())(x[:nx], u, p)

    return replace(limits, outputs=outputs)


@dataclass(frozen=True, eq=False)
class PreviewedScenarios(Immutable):
    """Scenarios of a model with register: its content, then its disturbance."""

    own: Scenarios  # of the model without the register; they must draw N samples more than an episode has
    steps: int  # N
    channels: tuple[int, ...]  # disturbances that are known ahead

    def __post_init__(self) -> None:
        has_method("own", self.own, "sample", "scenarios, such as FixedStart(x0, disturbance)")

    @property
    def disturbance(self) -> Any:
        """Disturbance of the model without register, None without one."""
        return getattr(self.own, "disturbance", None)

    def sample(self, runs: int, steps: int, rng: np.random.Generator) -> tuple[Array, Array]:
        """Initial states (runs, nx + N·channels), disturbances (runs, steps, nw)."""
        x0, w = self.own.sample(runs, steps + self.steps, rng)
        return previewed_state(x0, w[:, : self.steps], self.channels), shifted(w, self.steps, self.channels)


def shifted(w: Array, steps: int, channels: Sequence[int]) -> Array:
    """Disturbances (n, T, nw) that enter a register of `steps` samples.

    They stand in place of disturbances (n, T + steps, nw).
    """
    later = np.array(w[:, : w.shape[1] - steps])
    later[..., list(channels)] = w[:, steps:, list(channels)]
    return later


def _drawn_bounds(problem: CoDesignProblem, known: tuple[int, ...]) -> tuple[ArrayField, ArrayField]:
    """Symmetric bounds of the previewed disturbances, from a few episodes."""
    _, w = problem.scenarios.sample(200, problem.steps, np.random.default_rng(0))
    largest = PREVIEW_ROOM * np.abs(as_array("scenarios, disturbances", w)).max(axis=(0, 1))[list(known)]
    if not (largest > 0).all():
        cure = "Give their bounds W, or name other channels."
        raise InputError("problem", "a disturbance known ahead that is always zero", "one that is not", cure)
    return -largest, largest
