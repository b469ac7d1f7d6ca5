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
from ccdtools.estimation.measurement import as_measurement, check_channels
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
        self._observations = Observations(problem, output, history, runs)
        self.history = self._observations.history
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
            own = zip(self._observations.bounds, (low, high))
            low, high = (np.r_[seen, end[len(end) - self.given :]] for seen, end in own)
            high = np.maximum(high, low + np.finfo(np.float32).eps)
        return ActorCritic(low, high, lower, upper, config=config, seed=seed, action_limits=limits)

    def move(self, p: Tensor) -> None:
        """Change the design, before a reset."""
        self._step = Stepper.at(self.problem, p.detach()).within(self.divergence)
        self._observations.move(np.tile(self._step.p.double().numpy(), (self.runs, 1)))

    def reset(self) -> Tensor:
        """Fresh scenarios; observations (runs, nx + np)."""
        self._x0, self._w = scenario_tensors(self.problem, self.runs, self._rng)
        self._x = self._x0
        self._e = torch.zeros_like(self._x0)
        self._k = 0
        self._observations.draw(slice(None), self._rng)
        return self._begun(slice(None))

    def state(self) -> dict[str, Any]:
        """Episodes where they stand, for `restore`."""
        tensors = {name: getattr(self, name) for name in ("_x0", "_w", "_x", "_e")}
        past = [torch.tensor(part) for part in self._observations.past]
        return {"tensors": tensors, "past": past, "k": self._k, "rng": self._rng.bit_generator.state,
                "told": self._told()}  # fmt: skip

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
        for part, kept in zip(self._observations.past, state["past"]):
            part[:] = kept.numpy()
        self._k = state["k"]
        self._rng.bit_generator.state = state["rng"]

    def _told(self) -> tuple[Any, ...]:
        """What tells environments apart."""
        return self.runs, self._step.p.tolist(), self.divergence, self.history, self._content, repr(self.problem)

    @cached_property
    def _content(self) -> str:
        """Digest of problem and sensors."""
        return content_of((self.problem, self._observations.measurement))

    def step(self, actions: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
        """Next observation, successor, reward, terminated and truncated, see `learning.VectorEnv`."""
        x, e, reward = self._step(self._x, self._e, actions, self._w[:, self._k])
        self._k += 1
        last = torch.tensor(self._k >= self.problem.steps)
        reward, terminated, truncated = outcomes(self._step, x, reward, last)
        self._observations.take(slice(None), x, actions, self._k)
        successor = self._seen(x)
        if self._k >= self.problem.steps:
            return self.reset(), successor, reward, terminated, truncated
        restart = terminated[:, None]
        self._x = torch.where(restart, self._x0.roll(self._k, 0), x)
        self._e = torch.where(restart, 0.0, e)
        following = self._begun(terminated.numpy()) if terminated.any() else successor
        return following, successor, reward, terminated, truncated

    def _begun(self, rows: Any) -> Tensor:
        """Observations (runs, ·) where `rows` begin anew."""
        self._observations.begin(rows, self._x, self._k)
        return self._seen(self._x)

    def _seen(self, x: Tensor) -> Tensor:
        """Observations (runs, ·) at states (runs, nx)."""
        return observe(self._observations.seen(x), self._step.p)


class Observations:
    """States, or last outputs and inputs, that an agent sees.

    Of n episodes that step together, each with the outputs of its design and noise of its own.
    """

    def __init__(self, problem: CoDesignProblem, output: Any, history: int, runs: int) -> None:
        self.problem = problem
        self.history = as_count("history", history, least=0)
        stated = problem.measurement if output is None else output
        if (output is not None and history == 0) or (history and stated is None):
            got = "a history without an output" if history else "an output without a history"
            raise InputError("output, history", got, "both, or neither")
        if history == 0 and stated is not None:
            cure = "Of replace(problem, measurement=None) an agent sees the state."
            raise InputError("history", 0, "at least 1, of a problem with a measurement", cure)
        self.measurement = as_measurement(stated) if history else None
        self.hidden = 0 if history else problem.hidden
        self.move(np.tile(problem.design.centre, (runs, 1)))
        nu = problem.model.nu
        ny = len(self.bounds[0]) // history - nu if history else 0
        sizes = ((history, ny), (history, nu), (problem.steps, ny))  # outputs and inputs, the latest first, and noise
        self.past = tuple(np.zeros((runs, *size), np.float32) for size in sizes)

    def move(self, designs: Array) -> None:
        """Measure at designs (n, np)."""
        model, sensor = self.problem.model, self.measurement
        self._outputs = [] if sensor is None else [
            ((designs == p).all(axis=1), sensor.at(model.nx, model.nu, p)) for p in np.unique(designs, axis=0)
        ]  # fmt: skip

    @property
    def bounds(self) -> tuple[Array, Array]:
        """Range seen, of outputs within X at the first design."""
        scale = self.problem.state_scale
        if not self.history:
            return -scale[self.hidden :], scale[self.hidden :]
        x = np.random.default_rng(0).uniform(-scale, scale, (RANGE_POINTS, len(scale)))
        y = np.abs(self._outputs[0][1].of(x, np.zeros((len(x), self.problem.model.nu)))).max(axis=0)
        y = np.where(y > 0, y, 1.0)
        low, high = (np.r_[np.tile(end, self.history), np.tile(u, self.history)]
                     for end, u in zip((-y, y), self.problem.input_bounds))  # fmt: skip
        return low, high

    def draw(self, rows: Any, rng: np.random.Generator) -> None:
        """Draw the noise of rows that begin."""
        kept, sensor, steps = self.past[2], self.measurement, self.problem.steps
        noise = None if sensor is None else sensor.drawn(len(kept[rows]), steps, rng).noise
        if noise is not None:
            check_channels(noise, kept.shape[2])
            kept[rows] = noise[:, :steps]

    def begin(self, rows: Any, x: Tensor, k: Any) -> None:
        """Begin rows at states (n, nx) anew."""
        for part in self.past[:2]:
            part[rows] = 0.0
        self.take(rows, x, x.new_zeros(len(x), self.problem.model.nu), k)

    def take(self, rows: Any, x: Tensor, u: Tensor, k: Any) -> None:
        """Measure rows of states (n, nx) after inputs (n, nu)."""
        if not self.history:
            return
        outputs, inputs, noise = self.past
        states, applied = x.double().numpy(), u.double().numpy()
        y = noise[np.arange(len(x)), k % self.problem.steps]
        with np.errstate(all="ignore"):  # of a run that is lost
            for at, output in self._outputs:
                y[at] += output.of(states[at], applied[at]).astype(np.float32)
        for part, latest in ((outputs, y), (inputs, applied)):
            part[rows] = np.concatenate([latest[rows, None], part[rows, :-1]], axis=1)

    def seen(self, x: Tensor) -> Tensor:
        """States (n, ·) not hidden, or histories (n, m (ny + nu))."""
        if not self.history:
            return x[:, self.hidden :]
        return torch.from_numpy(np.concatenate([part.reshape(len(x), -1) for part in self.past[:2]], axis=1))


def divergence_of(problem: CoDesignProblem, divergence: float | None) -> float:
    """Half-widths of X beyond which an episode ends."""
    return min(1.5, problem.divergence) if divergence is None else as_positive("divergence", divergence)


def outcomes(step: Stepper, x: Tensor, rewards: Tensor, last: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Rewards, terminated and truncated (n,) at states (n, nx).

    One that is lost stays there, by the default discount: a time limit is no end to what PPO raises, either. Where the
    objective has a terminal cost, the time limit terminates: what comes after is paid for, and no value stands for it.
    """
    lost, final = step.left(x), step.final_rewards(x)
    late, end = last & ~lost, rewards if final is None else rewards + final
    paid = torch.where(lost, torch.minimum(rewards, end / (1 - PPOConfig.gamma)), torch.where(late, end, rewards))
    return paid, lost | (late & (final is not None)), late & (final is None)


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
