"""Environment of PPO in a co-design, and its design gradient."""

from __future__ import annotations

from dataclasses import replace
from functools import cached_property
from typing import Any

import numpy as np
import torch
from numpy.typing import ArrayLike
from torch import Tensor

from ccdtools.arrays import Array
from ccdtools.co_design.budgets import RANGE_POINTS
from ccdtools.co_design.differentiable_model import Stepper, observe, scenario_tensors, to_design
from ccdtools.co_design.problem import CoDesignProblem
from ccdtools.design_limits import DesignLimits
from ccdtools.estimation.measurement import Measurement, as_measurement
from ccdtools.estimation.outputs import Output
from ccdtools.exceptions import InputError
from ccdtools_ground.content import content_of
from ccdtools_ground.door import as_count, as_generator, as_instance, as_positive
from learning.networks import ActorCritic, NetworkConfig
from learning.ppo import Batch, PPOConfig, ppo_losses, prepare
from learning.rollout import collect


class EpisodeEnv:
    """Episodes of a problem that step together, for `learning.train`.

    Observations are (x, p), actions u, each (runs, ·) tensors. Episodes end together at the problem's time limit:
    truncated, or terminated where the objective has a terminal cost. One that diverges terminates and restarts from
    another's initial state. It costs what staying where it was lost would, so that no end pays.

    Parameters
    ----------
    problem : CoDesignProblem
    design : (np,) array_like or tensor
        May be moved between rollouts with `move`.
    runs : int
    rng : numpy.random.Generator
        Draws fresh scenarios at each reset.
    output : Measurement or what it takes, optional
        What is measured, with its noise; by default the measurement of the problem. Recorded noise needs a sample for
        each step: the observation after the last one, on which nobody acts, has the first again.
    history : int
        An agent sees so many last outputs and inputs in the place of x, as `History` hands them over; 0 for the state,
        where the problem states no measurement.
    divergence : float, optional
        Half-widths of X beyond which an episode has diverged; by default 1.5, or those of the problem if they are
        fewer. Of runs that go far, an agent that knows nothing yet would learn little else than how far they went.

    Attributes
    ----------
    given : int
        Number of the last entries of observations that are given, those of the design.

    Raises
    ------
    InputError
        If an argument is of another kind, or the design is not allowed.

    Examples
    --------
    >>> env = EpisodeEnv(problem, design, rng=np.random.default_rng(0))
    >>> trained = train(env, env.agent(), iterations=100, steps=problem.steps, generator=torch.Generator())
    >>> policy = LearnedPolicy(trained.agent, design)
    """

    def __init__(
        self, problem: CoDesignProblem, design: ArrayLike | Tensor, *, runs: int = 32, rng: np.random.Generator,
        output: Any = None, history: int = 0, divergence: float | None = None,
    ) -> None:  # fmt: skip
        self.problem = as_instance("problem", problem, CoDesignProblem, "a CoDesignProblem")
        self.divergence = divergence_of(problem, divergence)
        self.runs = as_count("runs", runs)
        self.given = problem.design.dim
        self._rng = as_generator("rng", rng)
        self.history, self._measurement = remembered(problem, output, history)
        self._past: Tensor | None = None  # (runs, history, ny + nu), the latest first
        if not isinstance(design, Tensor):
            design = torch.tensor(problem.design.check_feasible(design), dtype=torch.float32)
        self.move(design)

    def agent(self, *, config: NetworkConfig | None = None, seed: int = 0) -> ActorCritic:
        """Untrained agent for this problem, at any of its designs."""
        low, high = self.problem.observation_bounds
        bounds = self.problem.action_bounds
        limits = bounds if isinstance(bounds, DesignLimits) else None
        lower, upper = limits.box if limits is not None else self.problem.input_bounds
        if self.history:
            nx, extent = self.problem.model.nx, output_extent(self.problem, self._output)
            most, least = (np.concatenate([np.tile(sign * extent, self.history), np.tile(bound, self.history), end])
                           for sign, bound, end in ((1, upper, high[nx:]), (-1, lower, low[nx:])))  # fmt: skip
            low, high = least, np.maximum(most, least + np.finfo(np.float32).eps)
        return ActorCritic(low, high, lower, upper, config=config, seed=seed, action_limits=limits)

    def move(self, p: Tensor) -> None:
        """Change the design, before a reset."""
        self._step = Stepper.at(self.problem, p.detach()).within(self.divergence)
        model = self.problem.model
        if self._measurement is not None:
            self._output = self._measurement.at(model.nx, model.nu, self._step.p.double().numpy())

    def reset(self) -> Tensor:
        """Fresh scenarios; observations (runs, nx + np)."""
        self._x0, self._w = scenario_tensors(self.problem, self.runs, self._rng)
        self._x = self._x0
        self._e = torch.zeros_like(self._x0)
        self._k = 0
        if self._measurement is not None:
            noise = self._measurement.drawn(self.runs, self.problem.steps, self._rng).noise
            self._v = torch.zeros(1, self.problem.steps, 1) if noise is None else torch.tensor(noise).float()
        return self._begun(self._x0)

    def state(self) -> dict[str, Any]:
        """Episodes where they stand, for `restore`."""
        kept = ("_x0", "_w", "_x", "_e", *(("_v", "_past") if self.history else ()))
        tensors = {name: getattr(self, name) for name in kept}
        return {"tensors": tensors, "k": self._k, "rng": self._rng.bit_generator.state, "told": self._told()}

    def restore(self, state: dict[str, Any]) -> None:
        """Go on from a `state`.

        Raises
        ------
        InputError
            If it is of another number of runs, at another design, of another divergence or history, or of a problem or
            sensors of other content.
        """
        if state["told"] != self._told():
            words = "{} runs at the design {}, lost beyond {:g}, {} seen, of the content {}: {}"
            raise InputError("state", words.format(*state["told"]), words.format(*self._told()))
        for name, tensor in state["tensors"].items():
            setattr(self, name, tensor)
        self._k = state["k"]
        self._rng.bit_generator.state = state["rng"]

    def _told(self) -> tuple[Any, ...]:
        """What tells environments apart."""
        return self.runs, self._step.p.tolist(), self.divergence, self.history, self._content, repr(self.problem)

    @cached_property
    def _content(self) -> str:
        """Digest of problem and sensors."""
        return content_of((self.problem, self._measurement))

    def step(self, actions: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
        """Next observation, successor, reward, terminated and truncated, see `learning.VectorEnv`."""
        x, e, reward = self._step(self._x, self._e, actions, self._w[:, self._k])
        reward, terminated, final = paid(self._step, x, reward)
        self._k += 1
        truncated = torch.full_like(terminated, self._k >= self.problem.steps) & ~terminated
        if final is not None:  # what comes after the end is paid for: no value stands for it
            reward = reward + torch.where(truncated, final, 0.0)
            terminated, truncated = terminated | truncated, torch.zeros_like(truncated)
        successor = self._seen(x, actions)
        if self._k >= self.problem.steps:
            return self.reset(), successor, reward, terminated, truncated
        restart, again = terminated[:, None], self._x0.roll(self._k, 0)
        self._x = torch.where(restart, again, x)
        self._e = torch.where(restart, 0.0, e)
        if not terminated.any():
            return successor, successor, reward, terminated, truncated
        past = self._past
        following = torch.where(restart, self._begun(again), successor)
        if past is not None and self._past is not None:
            self._past = torch.where(restart[:, None], self._past, past)
        return following, successor, reward, terminated, truncated

    def _begun(self, x: Tensor) -> Tensor:
        """Observations of states (runs, nx) with nothing before them."""
        self._past = None
        return self._seen(x, torch.zeros(self.runs, self.problem.model.nu))

    def _seen(self, x: Tensor, u: Tensor) -> Tensor:
        """Observations of states (runs, nx) after inputs (runs, nu), which a history takes in."""
        if not self.history:
            return observe(x[:, self.problem.hidden :], self._step.p)
        y = torch.tensor(self._output.of(x.double().numpy(), u.double().numpy())).float()
        y = y + self._v[:, self._k % self.problem.steps]
        latest = torch.cat([y, u], dim=1)[:, None]
        before = latest.new_zeros(self.runs, self.history, latest.shape[2]) if self._past is None else self._past
        self._past = torch.cat([latest, before[:, :-1]], dim=1)
        outputs, inputs = self._past.split([y.shape[1], u.shape[1]], dim=2)
        return observe(torch.cat([outputs.flatten(1), inputs.flatten(1)], dim=1), self._step.p)


def remembered(problem: CoDesignProblem, output: Any, history: int) -> tuple[int, Measurement | None]:
    """Length of the history, and its measurement."""
    history = as_count("history", history, least=0)
    if history == 0 and output is not None:
        raise InputError("output, history", "an output without a history", "both, or neither")
    stated = problem.measurement if output is None else output
    if history == 0 and stated is not None:
        cure = "Of replace(problem, measurement=None) an agent sees the state."
        raise InputError("history", 0, "at least 1, of a problem with a measurement", cure)
    if history and stated is None:
        raise InputError("output, history", "a history without an output", "both, or neither")
    return history, as_measurement(stated) if history else None


def output_extent(problem: CoDesignProblem, output: Output) -> Array:
    """Largest |y| (ny,) at states within X; 1 where it is 0."""
    nx, (low, high) = problem.model.nx, problem.observation_bounds
    x = np.random.default_rng(0).uniform(low[:nx], high[:nx], (RANGE_POINTS, nx))
    largest = np.abs(output.of(x, np.zeros((len(x), problem.model.nu)))).max(axis=0)
    return np.where(largest > 0, largest, 1.0)


def divergence_of(problem: CoDesignProblem, divergence: float | None) -> float:
    """Half-widths of X beyond which an episode ends."""
    return min(1.5, problem.divergence) if divergence is None else as_positive("divergence", divergence)


def paid(step: Stepper, x: Tensor, rewards: Tensor) -> tuple[Tensor, Tensor, Tensor | None]:
    """Rewards (n,) at states (n, nx), which runs are lost, and what an end there is rewarded with.

    One that is lost stays there, by the default discount: a time limit is no end to what PPO raises, either.
    """
    lost, final = step.left(x), step.final_rewards(x)
    staying = (rewards if final is None else rewards + final) / (1 - PPOConfig.gamma)
    return torch.where(lost, torch.minimum(rewards, staying), rewards), lost, final


def network_input_gradient(
    problem: CoDesignProblem, agent: ActorCritic, v: Tensor, *, rng: np.random.Generator, runs: int, config: PPOConfig
) -> Tensor:
    """−∂/∂v (np,) of the PPO loss through design inputs, with constant states."""
    env = EpisodeEnv(problem, to_design(problem, v), runs=runs, rng=rng, divergence=problem.divergence)
    generator = torch.Generator().manual_seed(int(rng.integers(2**31)))
    rollout = collect(env, agent, steps=problem.steps, generator=generator)
    return loss_gradient(problem, agent, v, prepare(agent, rollout, config), config)


def loss_gradient(problem: CoDesignProblem, agent: ActorCritic, v: Tensor, batch: Batch, config: PPOConfig) -> Tensor:
    """−∂/∂v of a batch's PPO loss, through its design columns."""
    v = v.detach().clone().requires_grad_(True)
    x = batch.observations[:, : problem.model.nx - problem.hidden]
    losses = ppo_losses(agent, replace(batch, observations=observe(x, to_design(problem, v))), config)
    with torch.no_grad():  # the surrogate is that of one step, in standard deviations of the advantages
        size = problem.steps * ((batch.targets - agent.value(batch.observations)).std() + 1e-8)
    paid = problem.objective.cost_of_design(to_design(problem, v), problem.steps) / size
    (gradient,) = torch.autograd.grad(losses.surrogate + losses.value + paid, v)
    return -gradient
