"""Policies that imitate an expert where they themselves lead."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ccdtools.arrays import Array
from ccdtools.co_design.objective import Objective, as_objective
from ccdtools.controllers.controllers import Controller
from ccdtools.controllers.history import History, histories
from ccdtools.controllers.learned import LearnedPolicy
from ccdtools.controllers.signals import Driver, needs_of
from ccdtools.exceptions import InputError
from ccdtools.scenario import Scenario
from ccdtools.trajectory import Trajectory
from ccdtools_ground.door import as_count, as_floats, as_generator, as_instance, as_number, as_vector, shown
from learning.networks import ActorCritic, NetworkConfig
from learning.warm_start import CloningConfig, fit_actor_critic

LOST = ("one that loses every run", "one that keeps some", "Draw starts that it can keep.")


@dataclass(frozen=True, eq=False)
class Imitation:
    """Policy that imitates an expert, and how it came to it.

    Attributes
    ----------
    controller : LearnedPolicy or History
        That of the round with the highest return.
    agent : ActorCritic
        Of the same round; PPO may go on from it.
    samples : tuple of int
        Labelled samples of every round, all rounds before included.
    returns : tuple of float
        Mean return of the policy of every round, on runs that no round was fitted to and that all meet; minus infinity
        where it loses a run that the expert does not.
    expert : float
        Mean return of the expert on them.
    left_out : (int, int)
        Runs that were lost and that no round was fitted to, of how many.
    """

    controller: Controller
    agent: ActorCritic
    samples: tuple[int, ...]
    returns: tuple[float, ...]
    expert: float
    left_out: tuple[int, int] = (0, 0)

    def __repr__(self) -> str:
        returns = f"return {max(self.returns):.5g}, expert {self.expert:.5g}"
        if self.left_out[0]:
            returns += ", {} of {} runs lost and left out".format(*self.left_out)
        return f"Imitation({returns}, {len(self.returns)} rounds, {self.controller!r})"


def imitate(
    expert: Controller,
    scenario: Callable[[np.random.Generator], Scenario],
    *,
    objective: Objective,
    limits: tuple[ArrayLike, ArrayLike],
    rng: np.random.Generator,
    design: ArrayLike = (),
    history: int = 0,
    rounds: int = 4,
    gamma: float = 0.99,
    limit: ArrayLike | None = None,
    network: NetworkConfig | None = None,
    config: CloningConfig | None = None,
) -> Imitation:
    """Policy that imitates an expert on the states, or the measured histories, that it meets itself.

    The first round is fitted to runs of the expert, each further one also to runs of the policy before, which the
    expert labels along the way: with its own memory, an estimator's too, and the inputs that were applied.
    Lost runs are left out.

    Parameters
    ----------
    expert : callable
        Any controller, such as `linear_mpc`, `nonlinear_mpc`, or `Observed(lqr, kalman_filter)`.
    scenario : function of rng → Scenario
        Draws the runs of a round; with `output=` where outputs are measured.
    objective : QuadraticObjective or CustomObjective
        Of the returns that the rounds are told by, and that the critic learns.
    limits : (lower, upper), each (nu,)
        Of the inputs.
    rng : numpy.random.Generator
    design : (np,) array_like
        Required when the plant has design parameters.
    history : int
        The policy sees that many last outputs and inputs in place of the state; 0 for the state.
    rounds : int
    gamma : float
        Discount of the returns that the critic learns.
    limit : (nx,) array_like, optional
        Divergence limit on |x|, see `simulate`.
    network, config : optional
        Shape and fit of the networks.

    Raises
    ------
    InputError
        If an argument is of the wrong kind or size, a history is asked for where nothing is measured, or the expert
        loses all runs.

    References
    ----------
    Ross, Gordon, Bagnell, A reduction of imitation learning and structured prediction to no-regret online learning,
    AISTATS 2011.
    """
    as_objective("objective", objective)
    as_generator("rng", rng)
    p = as_vector("design", design) if np.size(design) else np.zeros(0)
    length = as_count("history", history, least=0)
    needs_of(expert)
    gamma = as_number("gamma", gamma, expected="a discount from 0 to 1", low=0.0, high=1.0)
    held_out = _drawn(scenario, rng, length)
    lower, upper = _as_limits(limits, int(held_out.plant.nu))
    own = _run(held_out, expert, p, limit)
    if own.diverged.all():
        raise InputError("expert", *LOST)
    data: list[tuple[Array, Array, Array]] = []
    lost: list[NDArray[np.bool_]] = []
    found: list[tuple[float, Controller, ActorCritic]] = []
    acting = expert
    for _ in range(as_count("rounds", rounds)):
        runs = _drawn(scenario, rng, length)
        met = _run(runs, acting, p, limit)
        lost.append(met.diverged)
        data.append(_labelled(expert, runs, met, objective, length, gamma))
        seen, actions, values = (np.concatenate(part) for part in zip(*data))
        if not len(seen):
            raise InputError("expert", *LOST)
        observed = np.hstack([seen, np.tile(p, (len(seen), 1))])
        agent = fit_actor_critic(
            observed, np.clip(actions, lower, upper), values, action_bounds=(lower, upper),
            input_bounds=_extent(observed), rng=rng, network=network, config=config,
        )  # fmt: skip
        policy = LearnedPolicy(agent, p)
        acting = History(policy, length) if length else policy
        found.append((_return(_run(held_out, acting, p, limit), own, objective), acting, agent))
    _, controller, agent = max(found, key=lambda one: one[0])
    counts = np.cumsum([len(part[0]) for part in data])
    kept = own.returns(objective)[~own.diverged]
    left_out = int(np.concatenate(lost).sum()), sum(map(len, lost))
    returns = tuple(one[0] for one in found)
    return Imitation(controller, agent, tuple(map(int, counts)), returns, float(kept.mean()), left_out)


def _as_limits(limits: Any, nu: int) -> tuple[Array, Array]:
    """Limits (lower, upper), each (nu,)."""
    if not isinstance(limits, Sequence) or len(limits) != 2:
        raise InputError("limits", shown(limits), "(lower, upper)")
    lower, upper = (
        as_vector("limits", np.atleast_1d(as_floats("limits", end)), nu, of="one per input") for end in limits
    )
    if not (lower < upper).all():
        raise InputError("limits", f"{lower.tolist()} and {upper.tolist()}", "(lower, upper) of all inputs")
    return lower, upper


def _extent(columns: Array) -> tuple[Array, Array]:
    """Least and largest of each column (n, k), a hundredth apart where single precision tells none."""
    lower, upper = columns.min(axis=0), columns.max(axis=0)
    size = np.maximum(np.abs(lower), np.abs(upper))
    room = np.where(upper - lower > np.finfo(np.float32).eps * size, 0.0, 0.01 * np.where(size > 0.0, size, 1.0))
    return lower - room, upper + room


def _drawn(scenario: Any, rng: np.random.Generator, length: int) -> Scenario:
    """Runs of a round."""
    if not callable(scenario):
        raise InputError("scenario", f"a {type(scenario).__name__}", "a function rng -> Scenario")
    found: Scenario = as_instance("scenario", scenario(rng), Scenario, "a function rng -> Scenario")
    if length and found.output is None:
        raise InputError("scenario", "one without output", "one with output=Measurement(…), which a history is of")
    return found


def _run(scenario: Scenario, controller: Controller, p: Array, limit: ArrayLike | None) -> Trajectory:
    return scenario.run(controller, design=p if len(p) else None, limit=limit)


def _labelled(
    expert: Controller, scenario: Scenario, run: Trajectory, objective: Objective, length: int, gamma: float
) -> tuple[Array, Array, Array]:
    """What the policy sees (k, ·), what the expert does there (k, nu), and what comes after (k,)."""
    runs, steps, nu = run.inputs.shape
    sensor = None
    if scenario.output is not None:
        sensor = scenario.output.first(runs, steps).sensor(scenario.plant, run.design, runs, steps, None)
    driver = Driver(
        expert, runs, nu, disturbances=scenario.disturbance, reference=scenario.reference, output=sensor
    )  # fmt: skip
    last = np.zeros((runs, nu))
    actions, outputs = np.empty(run.inputs.shape), []
    for k in range(steps):
        if length and sensor is not None:
            outputs.append(sensor(k, run.states[:, k], last))
        actions[:, k] = driver(k, run.states[:, k])
        last = run.inputs[:, k]
        driver.remember(last)
    seen = histories(np.stack(outputs, axis=1), run.inputs, length) if length else run.states[:, :-1]
    values = run.rewards(objective)
    for k in range(steps - 2, -1, -1):
        values[:, k] += gamma * values[:, k + 1]
    kept = np.isfinite(actions).all(axis=2) & ~run.diverged[:, None]
    return seen[kept], actions[kept], values[kept]


def _return(run: Trajectory, expert: Trajectory, objective: Objective) -> float:
    """Mean return on the runs that the expert keeps; minus infinity if one of them is lost."""
    kept = ~expert.diverged
    return float("-inf") if run.diverged[kept].any() else float(run.returns(objective)[kept].mean())
