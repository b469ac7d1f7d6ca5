"""Loops of laws, with other inputs than theirs."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from ccdtools.arrays import Array, Mask
from ccdtools.co_design.design_controllers import saturated_lqr
from ccdtools.co_design.problem import CoDesignProblem
from ccdtools.co_design.tolerances import WORTH_A_START
from ccdtools.exceptions import InputError
from ccdtools.plants.linear_model import LinearModel
from ccdtools_ground.user_functions import at_step
from mpc import MPCError

Law = Callable[[Array], Array]


class Loops(NamedTuple):
    """Closed loops, samples first.

    States (T, n, nx), inputs that the law asks for (T, n, nu) and rewards (T, n).
    """

    states: Array
    inputs: Array
    rewards: Array
    kept: Mask  # (n,) whether the run ends within the divergence limit

    def samples(self, gamma: float = 0.99) -> tuple[Array, Array, Array]:
        """States (k, nx), inputs (k, nu) and values (k,) of kept runs."""
        values = self.rewards.copy()
        for k in range(len(values) - 2, -1, -1):
            values[k] += gamma * values[k + 1]
        states, inputs = (part[:, self.kept].reshape(-1, part.shape[2]) for part in (self.states, self.inputs))
        return states, inputs, values[:, self.kept].ravel()


def loops_of(
    problem: CoDesignProblem, law: Law, p: Array, x0: Array, w: Array,
    applied: Callable[[Array, Array], Array] | None = None,
) -> Loops:  # fmt: skip
    """Loops of a law (n, nx) → (n, nu) at a design (np,).

    What is applied is what the law asks for, or `applied` of it and the states: so the loops show what the law does
    after others' inputs.
    """
    step, x = problem.model.stepper(p, batch=len(x0)), x0
    states, inputs, rewards = [], [], []
    for k in range(problem.steps):
        seen = np.where((np.abs(x) <= problem.limit).all(axis=1, keepdims=True), x, 0.0)  # of a lost run nothing
        u = np.asarray(law(seen))
        moved = np.clip(u if applied is None else applied(seen, u), *problem.input_bounds_at(p))
        try:
            after = np.asarray(step(x, moved, w[:, k]))
        except InputError as error:
            raise at_step(k, error) from error
        states.append(x)
        inputs.append(u)
        rewards.append(np.asarray(problem.objective.rewards(after, moved, x, p)))
        x = after
    kept = (np.abs(x) <= problem.limit).all(axis=1)  # not where one is NaN
    return Loops(np.array(states), np.array(inputs), np.array(rewards), np.atleast_1d(kept))


def lqr_is_expert(problem: CoDesignProblem, design: Array, rng: np.random.Generator) -> bool:
    """Whether LQR keeps all runs and brings them nearer to rest.

    What their starts cost falls by a fifth or more from the first quarter of an episode to the last. Of a linear model
    it is taken for one, and where a learned error moves the state: a plan of the nominal model knows nothing of it.
    """
    if isinstance(problem.model, LinearModel) or problem.discrepancy is not None:
        return True
    try:
        lqr = saturated_lqr(problem, design)
    except (MPCError, InputError):
        return False
    x0, w = problem.scenarios.sample(16, problem.steps, rng)
    moved, rest = (loops_of(problem, lqr, design, x, w) for x in (x0, np.zeros_like(x0)))
    excess = (rest.rewards - moved.rewards).mean(axis=1)
    part = -(-len(excess) // 4)
    begun, ended = max(float(excess[:part].sum()), 0.0), float(excess[-part:].sum())
    return bool(moved.kept.all()) and ended <= (1.0 - WORTH_A_START) * begun
