"""A co-design problem as an environment of Gymnasium, for any agent."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from numpy.typing import ArrayLike

from ccdtools.arrays import Array
from ccdtools.co_design.differentiable_model import Stepper, scenario_tensors
from ccdtools.co_design.problem import CoDesignProblem
from ccdtools.co_design.risk import cases_of
from ccdtools.exceptions import InputError
from ccdtools_ground.door import as_instance, as_vector, shown

if TYPE_CHECKING:
    from gymnasium import Env, spaces

    Base = Env[Any, Any]
else:
    try:
        from gymnasium import Env as Base, spaces
    except ImportError:  # the name is there all the same, and says what is missing when it is called
        Base, spaces = object, None


class DesignEnv(Base):
    """Problem as an environment of Gymnasium, for any agent.

    Actions lie in [−1, 1], the range of U, or of U(p). Observations are the states in units of the largest |x| in X;
    where the design is drawn, it follows, in [−1, 1] over its box. An episode is truncated after `problem.steps` steps,
    and terminated where the objective has a terminal cost or the states leave `problem.divergence` times X. The sum of
    its rewards is its return without the cost of the design.

    Parameters
    ----------
    problem : CoDesignProblem
    design : (np,) array_like, optional
        The design of every episode. By default every reset draws a feasible one from the box, and the observation
        shows it. `reset(options={"design": p})` has the last word on an episode.

    Raises
    ------
    InputError
        If an argument is of another kind, or a design lies outside its box or its constraints.
    """

    metadata = {"render_modes": []}  # noqa: RUF012  (the attribute that Gymnasium reads)

    def __init__(self, problem: CoDesignProblem, design: ArrayLike | None = None) -> None:
        if spaces is None:
            raise InputError("DesignEnv", "no Gymnasium", "it installed: pip install ccdtools[gymnasium]")
        self.problem = as_instance("problem", problem, CoDesignProblem, "a CoDesignProblem")
        self._fixed = None if design is None else problem.design.check_feasible(design)
        n = problem.model.nx
        largest = np.full(n, problem.divergence, np.float32)
        if self._fixed is None:
            largest = np.r_[largest, np.ones(problem.design.dim, np.float32)]
        self.observation_space = spaces.Box(-largest, largest, dtype=np.float32)
        self.action_space = spaces.Box(-1.0, 1.0, (problem.model.nu,), np.float32)
        self._k = problem.steps  # no episode goes on before the first reset

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Array, dict[str, Any]]:
        """First observation of a new episode, and {"design", "state"}."""
        super().reset(seed=seed)
        options = {} if options is None else options
        if not isinstance(options, dict) or set(options) - {"design"}:
            raise InputError("options", shown(options), '{"design": p}, or nothing')
        given = options.get("design")
        design = self._fixed if given is None else self.problem.design.check_feasible(given)
        self.design = self._drawn() if design is None else design
        self._stepper = Stepper.at(self.problem, torch.tensor(self.design, dtype=torch.float32))
        x0, w = scenario_tensors(self.problem, cases_of(self.problem.scenarios), self.np_random)
        i = [int(self.np_random.integers(len(x0)))]  # any of the cases, which runs meet in turn
        self._x, self._w = x0[i], w[i]
        self._e = torch.zeros_like(self._x)
        self._k = 0
        return self._seen()

    def step(self, action: Array) -> tuple[Array, float, bool, bool, dict[str, Any]]:
        """Result of an action (nu,), with {"design", "state"}.

        Raises
        ------
        InputError
            If the action is no vector of nu finite numbers, or no episode goes on.
        """
        action = as_vector("action", action, self.problem.model.nu)
        if not self._k < self.problem.steps:
            raise InputError("step", "no episode that goes on", "a reset before it")
        inputs = torch.tensor(self._inputs(action, self.design), dtype=torch.float32)[None]
        with torch.no_grad():
            self._x, self._e, rewards = self._stepper(self._x, self._e, inputs, self._w[:, self._k])
            terminated = bool(self._stepper.left(self._x))
            self._k += 1
            truncated = self._k >= self.problem.steps and not terminated
            reward = float(rewards)
            final = self._stepper.final_rewards(self._x)
        if terminated:
            self._k = self.problem.steps
        if truncated and final is not None:  # what comes after is paid for
            reward += float(final)
            terminated, truncated = True, False
        observation, info = self._seen()
        return observation, reward, terminated, truncated, info

    def controller(self, policy: Callable[[Array], Any], design: ArrayLike | None = None) -> Callable[[Array], Array]:
        """Controller by an agent that was trained here.

        Parameters
        ----------
        policy : callable
            Actions (n, nu) of observations (n, n_obs), such as an `ActorCritic`; of a pair, as Stable-Baselines3
            returns, the first: `lambda seen: model.predict(seen, deterministic=True)`.
        design : (np,) array_like, optional
            By default the design of every episode.

        Raises
        ------
        InputError
            If the policy cannot be called, or the design is missing or not allowed.
        """
        if not callable(policy):
            raise InputError("policy", repr(policy)[:60], "a function of observations")
        chosen = self._fixed if design is None else self.problem.design.check_feasible(design)
        if chosen is None:
            raise InputError("design", "none", "the design at which the controller acts")

        def controller(states: Array) -> Array:
            seen = self._observation(np.asarray(states, float), chosen)
            with torch.no_grad():
                actions = policy(torch.from_numpy(seen)) if isinstance(policy, torch.nn.Module) else policy(seen)
            return self._inputs(np.asarray(actions[0] if isinstance(actions, tuple) else actions, float), chosen)

        return controller

    def _inputs(self, actions: Array, design: Array) -> Array:
        """Inputs (..., nu) in the units of the plant."""
        lower, upper = self.problem.input_bounds_at(design)
        return np.asarray((lower + upper) / 2 + (upper - lower) / 2 * np.clip(actions, -1.0, 1.0))

    def _observation(self, states: Array, design: Array) -> Array:
        """Observations (..., n_obs) of states (..., nx)."""
        limit = self.problem.divergence
        seen = np.clip(np.nan_to_num(states / self.problem.state_scale, nan=limit), -limit, limit)
        if self._fixed is None:
            unit = np.broadcast_to(2 * self.problem.design.to_unit(design) - 1, (*seen.shape[:-1], len(design)))
            seen = np.concatenate([seen, unit], axis=-1)
        return np.asarray(seen, np.float32)

    def _drawn(self) -> Array:
        """A feasible design (np,) by chance."""
        space = self.problem.design
        return np.asarray(space.project(space.from_unit(self.np_random.random(space.dim))))

    def _seen(self) -> tuple[Array, dict[str, Any]]:
        """Observation and information."""
        state = self._x[0].double().numpy()
        return self._observation(state, self.design), {"design": self.design.copy(), "state": state}
