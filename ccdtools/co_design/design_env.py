"""A co-design problem as environments of Gymnasium, for any agent."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from numpy.typing import ArrayLike

from ccdtools.arrays import Array
from ccdtools.co_design.differentiable_model import Stepper, scenario_tensors
from ccdtools.co_design.environment import Observations, divergence_of, outcomes
from ccdtools.co_design.problem import CoDesignProblem
from ccdtools.co_design.risk import cases_of
from ccdtools.controllers.history import History
from ccdtools.exceptions import InputError
from ccdtools_ground.door import as_array, as_count, as_instance, shown

if TYPE_CHECKING:
    from gymnasium import Env, spaces
    from gymnasium.envs.registration import EnvSpec
    from gymnasium.utils.seeding import np_random
    from gymnasium.vector import AutoresetMode, VectorEnv
    from gymnasium.vector.utils import batch_space

    Base = Env[Any, Any]
    VectorBase = VectorEnv[Any, Any, Any]
    MODE = {"autoreset_mode": AutoresetMode.NEXT_STEP}
else:
    try:
        from gymnasium import Env as Base, spaces
        from gymnasium.envs.registration import EnvSpec
        from gymnasium.utils.seeding import np_random
        from gymnasium.vector import AutoresetMode, VectorEnv as VectorBase
        from gymnasium.vector.utils import batch_space

        MODE = {"autoreset_mode": AutoresetMode.NEXT_STEP}
    except ImportError:  # the names are there all the same, and say what is missing when they are called
        Base, VectorBase, spaces, MODE = object, object, None, {}


class DesignEnv(Base):
    """Problem as an environment of Gymnasium, for any agent.

    Actions lie in [−1, 1], the range of U, or of U(p). Observations are the states in units of the largest |x| in X, or
    with a history the last outputs, in units of the largest |y| there, and the inputs before them as actions;
    where the design is drawn, it follows, in [−1, 1] over its box. An episode is truncated after `problem.steps` steps,
    and terminated where the objective has a terminal cost or the states diverge. The sum of its rewards is its return
    without the cost of the design; where it diverges the last one is that of staying there.

    Parameters
    ----------
    problem : CoDesignProblem
    design : (np,) array_like, optional
        The design of every episode. By default every reset draws a feasible one from the box, and the observation
        shows it. `reset(options={"design": p})` has the last word on an episode.
    output, history, divergence
        As for `EpisodeEnv`.

    Raises
    ------
    InputError
        If an argument is of another kind, or a design lies outside its box or its constraints.
    """

    metadata = {"render_modes": []}  # noqa: RUF012  (the attribute that Gymnasium reads)

    def __init__(
        self, problem: CoDesignProblem, design: ArrayLike | None = None, *, output: Any = None, history: int = 0,
        divergence: float | None = None,
    ) -> None:  # fmt: skip
        options: dict[str, Any] = {"output": output, "history": history, "divergence": divergence}
        self._episodes = _Episodes("DesignEnv", problem, design, 1, **options)
        self.problem = problem
        self.observation_space, self.action_space = self._episodes.spaces()
        made: Any = type(self)
        self.spec = EnvSpec("ccdtools/Design-v0", made, kwargs={"problem": problem, "design": design} | options)

    @property
    def design(self) -> Array:
        """Design (np,) of the episode."""
        return np.array(self._episodes.designs[0])

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Array, dict[str, Any]]:
        """First observation of a new episode, and {"design", "state"}."""
        super().reset(seed=seed)
        self._episodes.begin([(0, self.np_random, _given(options))])
        return self._seen()

    def step(self, action: Array) -> tuple[Array, float, bool, bool, dict[str, Any]]:
        """Result of an action (nu,), with {"design", "state"}.

        Raises
        ------
        InputError
            If the action is no vector of nu finite numbers, or no episode goes on.
        """
        action = as_array("action", action, (self.problem.model.nu,))
        if self._episodes.over[0]:
            raise InputError("step", "no episode that goes on", "a reset before it")
        rewards, terminated, truncated = self._episodes.step(action[None])
        observation, info = self._seen()
        return observation, float(rewards[0]), bool(terminated[0]), bool(truncated[0]), info

    def controller(self, policy: Callable[[Array], Any], design: ArrayLike | None = None) -> Callable[[Array], Array]:
        """Controller by an agent that was trained here.

        With a history it is a `History`, which needs outputs: `Scenario(…, output=sensor)`.

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
        chosen = self._episodes.fixed if design is None else self.problem.design.check_feasible(design)
        if chosen is None:
            raise InputError("design", "none", "the design at which the controller acts")

        def controller(x: Array) -> Array:
            seen = self._episodes.observed(np.asarray(x, float)[..., self._episodes.observations.hidden :], chosen)
            with torch.no_grad():
                actions = policy(torch.from_numpy(seen)) if isinstance(policy, torch.nn.Module) else policy(seen)
            found = actions[0] if isinstance(actions, tuple) else actions
            return self._episodes.inputs(np.asarray(found, float), chosen)

        history = self._episodes.observations.history
        return History(controller, history) if history else controller

    def _seen(self) -> tuple[Array, dict[str, Any]]:
        """Observation and information."""
        known = self._episodes.known()[0]
        return self._episodes.observed(known, self.design), {"design": self.design, "state": self._episodes.states()[0]}


class DesignVectorEnv(VectorBase):
    """Problem as many environments of Gymnasium that step together.

    Row i is what `DesignEnv` gives after a reset with the seed of row i. An episode that has ended begins anew in the
    next step, whose action is not looked at and whose reward is 0 (`AutoresetMode.NEXT_STEP`).

    Parameters
    ----------
    problem : CoDesignProblem
    num_envs : int
    design : (np,) array_like, optional
    output, history, divergence
        All as for `DesignEnv`.

    Raises
    ------
    InputError
        If an argument is of another kind, or a design lies outside its box or its constraints.
    """

    metadata = MODE

    def __init__(
        self, problem: CoDesignProblem, num_envs: int, design: ArrayLike | None = None, *, output: Any = None,
        history: int = 0, divergence: float | None = None,
    ) -> None:  # fmt: skip
        self.num_envs = as_count("num_envs", num_envs)
        self._episodes = _Episodes(
            "DesignVectorEnv", problem, design, self.num_envs, output=output, history=history, divergence=divergence
        )
        self.single_observation_space, self.single_action_space = self._episodes.spaces()
        self.observation_space = batch_space(self.single_observation_space, self.num_envs)
        self.action_space = batch_space(self.single_action_space, self.num_envs)
        self._generators: list[np.random.Generator] = []

    def reset(
        self, *, seed: int | list[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Array, dict[str, Any]]:
        """First observations (n, ·) of new episodes, and {"design", "state"}.

        Parameters
        ----------
        seed : int or list of int, optional
            Of the rows: seed, seed + 1, and so on, or one for each.
        options : dict, optional
            {"design": p} with p (np,) for all rows, or (n, np).

        Raises
        ------
        InputError
            If there are not as many seeds or designs as rows, or a design is not allowed.
        """
        n = self.num_envs
        each = (
            seed if isinstance(seed, list) or seed is None else [as_count("seed", seed, least=0) + i for i in range(n)]
        )
        seeds = [None] * n if each is None else each
        if len(seeds) != n:
            raise InputError("seed", f"{len(seeds)} seeds", f"{n}, one for each environment")
        given = _given(options)
        size = self._episodes.designs.shape
        designs = [None] * n if given is None else np.broadcast_to(as_array("design", given, size, size[1:]), size)
        known = self._generators or [np_random()[0] for _ in seeds]
        generators = [
            old if one is None else np_random(as_count("seed", one, least=0))[0] for old, one in zip(known, seeds)
        ]
        self._episodes.begin(zip(range(n), generators, designs))
        self._generators = generators
        return self._seen()

    def step(self, actions: Array) -> tuple[Array, Array, Array, Array, dict[str, Any]]:
        """Results (n,) of actions (n, nu), with {"design", "state"}.

        Raises
        ------
        InputError
            If actions are no (n, nu) finite numbers, or nothing was reset before.
        """
        actions = as_array("actions", actions, (self.num_envs, self._episodes.problem.model.nu))
        if not self._generators:
            raise InputError("step", "no episodes that go on", "a reset before it")
        ended = self._episodes.over.copy()
        rewards, terminated, truncated = self._episodes.step(actions)
        if ended.any():
            self._episodes.begin((int(i), self._generators[i], None) for i in np.flatnonzero(ended))
        observations, infos = self._seen()
        return observations, np.where(ended, 0.0, rewards), terminated & ~ended, truncated & ~ended, infos

    def _seen(self) -> tuple[Array, dict[str, Any]]:
        """Observations and information, as Gymnasium marks it."""
        states, designs = self._episodes.states(), self._episodes.designs.copy()
        all_of = np.ones(self.num_envs, bool)
        infos = {"design": designs, "_design": all_of, "state": states, "_state": all_of.copy()}
        return self._episodes.observed(self._episodes.known(), designs), infos


class _Episodes:
    """Episodes (n,) of a problem that step together, each at a design of its own."""

    def __init__(
        self, name: str, problem: CoDesignProblem, design: ArrayLike | None, runs: int, *, output: Any, history: int,
        divergence: float | None,
    ) -> None:  # fmt: skip
        if spaces is None:
            raise InputError(name, "no Gymnasium", "it installed: pip install ccdtools[gymnasium]")
        self.problem = as_instance("problem", problem, CoDesignProblem, "a CoDesignProblem")
        self.divergence = divergence_of(self.problem, divergence)
        self.fixed = None if design is None else problem.design.check_feasible(design)
        first = np.full(problem.design.dim, np.nan) if self.fixed is None else self.fixed
        self.designs = np.array(np.tile(first, (runs, 1)))  # of an empty design it would be read-only
        self.over = np.ones(runs, bool)  # no episode goes on before the first reset
        self._k = np.zeros(runs, int)
        self._x = self._e = torch.zeros(runs, problem.model.nx)
        self._w = torch.zeros(0)
        self.observations = Observations(problem, output, history, runs)
        if self.fixed is not None:
            self.observations.move(self.designs)
        low, high = self.observations.bounds
        self._middle, self._half = (high + low) / 2, (high - low) / 2

    def spaces(self) -> tuple[Any, Any]:
        """Spaces of observations and of actions."""
        largest = np.full(len(self._middle), self.problem.divergence, np.float32)
        if self.fixed is None:
            largest = np.r_[largest, np.ones(self.problem.design.dim, np.float32)]
        actions = spaces.Box(-1.0, 1.0, (self.problem.model.nu,), np.float32)
        return spaces.Box(-largest, largest, dtype=np.float32), actions

    def begin(self, rows: Iterable[tuple[int, np.random.Generator, Any]]) -> None:
        """Begin episodes anew, by rows with a generator and a design, or None."""
        x, e = self._x.clone(), self._e.clone()
        begun = [(row, rng, self._design(rng, given)) for row, rng, given in rows]  # all are checked before one changes
        for row, rng, design in begun:
            self.designs[row] = design
            x0, w = scenario_tensors(self.problem, cases_of(self.problem.scenarios), rng)
            case = int(rng.integers(len(x0)))  # any of the cases, which runs meet in turn
            if not len(self._w):
                self._w = torch.zeros(len(x), *w.shape[1:])
            self._w[row] = w[case]
            x[row], e[row] = x0[case], 0.0
            self._k[row], self.over[row] = 0, False
            self.observations.draw([row], rng)
        self._x, self._e = x, e
        self.observations.move(self.designs)
        self.observations.begin([row for row, _, _ in begun], x, self._k)
        alike = (self.designs == self.designs[0]).all()
        at = self.designs[0] if alike else self.designs
        stepper = Stepper.at(self.problem, torch.tensor(at, dtype=torch.float32))
        self._stepper = stepper.within(self.divergence)

    def step(self, actions: Array) -> tuple[Array, Array, Array]:
        """Rewards, terminated and truncated (n,) of actions (n, nu)."""
        inputs = torch.tensor(self.inputs(actions, self.designs), dtype=torch.float32)
        now = torch.from_numpy(np.minimum(self._k, self.problem.steps - 1))
        with torch.no_grad():
            self._x, self._e, rewards = self._stepper(self._x, self._e, inputs, self._w[torch.arange(len(now)), now])
            self._k += 1
            last = torch.from_numpy(self._k >= self.problem.steps)
            parts = outcomes(self._stepper, self._x, rewards, last)
        self.observations.take(slice(None), self._x, inputs, self._k)
        earned, terminated, truncated = (part.numpy() for part in parts)
        self.over = terminated | truncated
        return earned.astype(float), terminated, truncated

    def inputs(self, actions: Array, design: Array) -> Array:
        """Inputs (..., nu) in the units of the plant, at designs (..., np)."""
        lower, upper = self.problem.input_bounds_at(design)
        return np.asarray((lower + upper) / 2 + (upper - lower) / 2 * np.clip(actions, -1.0, 1.0))

    def states(self) -> Array:
        """States (n, nx)."""
        return self._x.double().numpy()

    def known(self) -> Array:
        """States (n, ·), or histories (n, m (ny + nu))."""
        return self.observations.seen(self._x).double().numpy()

    def observed(self, known: Array, design: Array) -> Array:
        """Observations (..., n_obs) of what is `known`, at designs (..., np)."""
        limit = self.problem.divergence
        seen = np.clip(np.nan_to_num((known - self._middle) / self._half, nan=limit), -limit, limit)
        if self.fixed is None:
            unit = 2 * self.problem.design.to_unit(design) - 1
            seen = np.concatenate([seen, np.broadcast_to(unit, (*seen.shape[:-1], unit.shape[-1]))], axis=-1)
        return np.asarray(seen, np.float32)

    def _design(self, rng: np.random.Generator, given: Any) -> Array:
        """Design (np,) that is given, or of every episode, or feasible by chance."""
        space = self.problem.design
        if given is not None:
            return np.asarray(space.check_feasible(given))
        return np.asarray(space.project(space.from_unit(rng.random(space.dim)))) if self.fixed is None else self.fixed


def _given(options: Any) -> Any:
    """Design in the options of a reset, or None."""
    options = {} if options is None else options
    if not isinstance(options, dict) or set(options) - {"design"}:
        raise InputError("options", shown(options), '{"design": p}, or nothing')
    return options.get("design")
