"""Training by PPO, which can be resumed."""

from __future__ import annotations

import copy
import os
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from tqdm import trange

from ccdtools_ground.door import as_count, as_instance
from learning.budgets import EPISODES
from learning.checks import check_instance
from learning.exceptions import CheckpointError, DivergedError, InputError
from learning.networks import ActorCritic
from learning.ppo import PPO, PPOConfig, UpdateStatistics
from learning.rollout import Collector, VectorEnv


@dataclass(frozen=True)
class TrainingRow:
    """One update of a training.

    Attributes
    ----------
    iteration : int
        From zero.
    samples : int
        Steps of all environments so far.
    episodes : int
        Episodes that have ended so far.
    mean_return : float
        Of the last episodes while exploring: those that ended within so many steps that 20 of the longest of late
        could, so that short ones count by how often they occur. NaN where none did.
    judged : bool
        Whether so many steps have been made, and an episode has ended in each environment.
    discounted : float
        Mean discounted return of these episodes, which is what PPO raises.
    length : float
        Mean length of these episodes [steps].
    terminated : float
        Part of them that was terminated, not truncated: a plant lost, a task done, a terminal cost paid.
    update : UpdateStatistics
    """

    iteration: int
    samples: int
    episodes: int
    mean_return: float
    judged: bool
    discounted: float
    length: float
    terminated: float
    update: UpdateStatistics


@dataclass(frozen=True, eq=False, repr=False)
class Training:
    """Result of a training.

    Attributes
    ----------
    agent : ActorCritic
        The last one, which was trained in place.
    best : ActorCritic
        A copy of the one with the largest `discounted` return that is `judged`; the last one where none is.
    config : PPOConfig
    rows : tuple of TrainingRow
    """

    agent: ActorCritic
    best: ActorCritic
    config: PPOConfig
    rows: tuple[TrainingRow, ...] = ()

    def __repr__(self) -> str:
        return f"Training({self.describe()})"

    def describe(self) -> str:
        """How the training went, in one line."""
        how = "refined from a policy that imitates an expert" if self.agent.imitates else "learned from scratch"
        if not self.rows:
            return f"PPO, {how}: no update yet"
        last = self.rows[-1]
        critic = sum(np.isnan(row.update.gradient_norm) for row in self.rows)
        text = f"PPO, {how}: {last.samples} steps, {len(self.rows)} updates" + (
            f", {critic} of them of the critic alone" if critic else ""
        )
        judged = [row for row in self.rows if row.judged]
        if not judged:
            return f"{text}; {last.episodes} episodes ended, too few to say how good it is"
        best = max(judged, key=lambda row: row.discounted)
        share = f"; {last.terminated:.0%} of the last were terminated, their mean length is {last.length:.3g} steps"
        ends = share if last.terminated > 0 else ""
        return (
            f"{text}; mean return of recent episodes {last.mean_return:.5g} at the end,"
            f" {best.mean_return:.5g} at best (after {best.iteration} updates){ends}"
        )


def first_exploration(agent: ActorCritic, config: PPOConfig) -> float:
    """Standard deviation of the exploration at first, which is set where `config.first_std` says so."""
    if config.first_std is not None and agent.std_network is None:
        with torch.no_grad():
            agent.log_std.fill_(float(np.log(config.first_std)))
    return agent.log_std.exp().mean().item()


def decay_exploration(agent: ActorCritic, first: float, final: float | None, done: float) -> None:
    """Set the exploration between `first` and `final`.

    It is geometric in `done`, from 0 to 1. Nothing is set where `final` is None, or where the exploration is a
    network of its own.
    """
    if final is not None and agent.std_network is None:
        with torch.no_grad():
            agent.log_std.fill_(float(np.log(first) + done * np.log(final / first)))


def train(
    env: VectorEnv,
    agent: ActorCritic,
    *,
    iterations: int,
    steps: int,
    config: PPOConfig | None = None,
    generator: torch.Generator,
    device: str | torch.device | None = None,
    checkpoint: str | Path | None = None,
    callback: Callable[[TrainingRow], None] | None = None,
    progress: bool = False,
) -> Training:
    """Result of training an agent in place by PPO.

    There are `iterations` rollouts of `steps` steps. A rollout goes on where the last one ended. The rates fall
    linearly to `config.final_rate`, the exploration geometrically to `config.final_std`.
    Small networks are trained fastest by one thread, ``torch.set_num_threads(1)``.

    Parameters
    ----------
    env : VectorEnv
    agent : ActorCritic
    iterations, steps : int
    config : PPOConfig, optional
        By default `PPOConfig.warm()` for an agent that imitates an expert, else `PPOConfig()`.
    generator : torch.Generator
        Of the exploration and of the order of samples, on the CPU.
    device : str or torch.device, optional
        Where the networks are trained, "cuda" for instance; by default where they are. Afterwards they are back there.
    checkpoint : path, optional
        The training is kept in this file after every update. Where the file exists the training goes on from it, with
        the same numbers on a CPU as without a break. It is read by pickle: use files of your own only.
    callback : callable, optional
        Gets every `TrainingRow` when its update is done.
    progress : bool

    Returns
    -------
    Training

    Raises
    ------
    InputError
        If an argument is of another kind, the device is none of this machine, or the environment cannot be resumed or
        breaks its word, see `VectorEnv`.
    CheckpointError
        If the checkpoint cannot be read or written, or is of another training.
    DivergedError
        If an update makes weights or a policy that are not finite. Whatever is raised, agent and checkpoint are those
        of the last update that was completed.
    """
    check_instance(agent, "agent", ActorCritic)
    config = config if config is not None else PPOConfig.warm() if agent.imitates else PPOConfig()
    check_instance(config, "config", PPOConfig)
    as_count("iterations", iterations)
    as_count("steps", steps)
    if callback is not None and not callable(callback):
        raise InputError("callback", repr(callback)[:60], "a function of a TrainingRow")
    home = agent.log_std.device
    if device is not None:
        _move(agent, device)
    ppo = PPO(agent, config, given=getattr(env, "given", 0))
    collector = Collector(env, agent, generator=generator, gamma=config.gamma)
    run = _Run(ppo, collector, Training(agent, agent, config))
    try:
        file = None if checkpoint is None else Path(as_instance("checkpoint", checkpoint, (str, os.PathLike), "a path"))
        if file is not None and file.exists():
            run.load(file)
        elif file is not None:
            run.collector.state()  # raises before any work is lost
        for k in trange(len(run.result.rows), iterations, desc="PPO", disable=not progress, leave=False):
            done = k / max(iterations - 1, 1)
            row = run.iterate(k, steps, done)
            if file is not None:
                run.save(file)
            if callback is not None:
                callback(row)
    finally:
        for kept in (agent, run.result.best):
            kept.to(home)
    return run.result


class _Run:
    """A training in progress."""

    def __init__(self, ppo: PPO, collector: Collector, result: Training) -> None:
        self.ppo = ppo
        self.collector = collector
        self.result = result
        self.first_std = first_exploration(result.agent, result.config)

    def iterate(self, k: int, steps: int, done: float) -> TrainingRow:
        """Row of one more rollout and update."""
        result = self.result
        agent, config = result.agent, result.config
        self.ppo.set_rates(1 - (1 - config.final_rate) * done)
        decay_exploration(agent, self.first_std, config.final_std, done)
        rollout = self.collector.rollout(steps)
        ended, ages, now = self.collector.ended, self.collector.ages, self.collector.steps
        longest = max([int(ages.max()) + 1, *(row[2] for row in ended[-max(EPISODES, len(ages)) :])])
        window = longest * -(-EPISODES // len(ages))
        recent = [row[:4] for row in ended if row[4] > now - window]
        mean_return, discounted, length, lost = np.mean(recent or [(np.nan,) * 4], axis=0).tolist()
        judged = now >= window and bool((ages < now).all()) and bool(recent)
        before = max((row.discounted for row in result.rows if row.judged), default=-np.inf)
        kept = copy.deepcopy(agent)
        try:
            update = self.ppo.update(rollout, generator=self.collector.generator, actor=k >= config.critic_only)
            finite = (tensor.isfinite().all() for tensor in agent.state_dict().values())
            if not (np.isfinite(update.kl) and all(finite)):
                raise DivergedError(k)
        except BaseException:  # an interrupt, too
            agent.load_state_dict(kept.state_dict())
            raise
        samples = rollout.rewards.numel() + (result.rows[-1].samples if result.rows else 0)
        row = TrainingRow(k, samples, len(ended), mean_return, judged, discounted, length, lost, update)
        best = kept if judged and discounted > before else result.best
        self.result = replace(result, best=best, rows=(*result.rows, row))
        return row

    def save(self, file: Path) -> None:
        """Keep the training; a file is there whole or not at all."""
        result = self.result
        weights = {"agent": result.agent.state_dict(), "best": result.best.state_dict()}
        own = {"config": result.config, "rows": result.rows, "first_std": self.first_std}
        part = file.with_name(file.name + ".part")
        try:
            file.parent.mkdir(parents=True, exist_ok=True)
            torch.save({**weights, **own, "ppo": self.ppo.state(), "collector": self.collector.state()}, part)
            os.replace(part, file)
        except (OSError, RuntimeError) as error:  # torch turns a full disk into the second
            raise CheckpointError(file, str(error).partition("\n")[0], "a file that can be written") from None

    def load(self, file: Path) -> None:
        """Go on from a file."""
        agent = self.result.agent
        try:
            kept = torch.load(file, weights_only=False, map_location="cpu")
            if kept["config"] != self.result.config:
                raise CheckpointError(file, f"a training with {kept['config']}", f"{self.result.config}")
            last, best = copy.deepcopy(agent), copy.deepcopy(agent)
            last.load_state_dict(kept["agent"])
            best.load_state_dict(kept["best"])
            other, own = ((net.action_offset.tolist(), net.action_scale.tolist()) for net in (last, agent))
            if other != own:  # middle and half-width
                raise CheckpointError(file, f"an agent with actions {other[0]} ± {other[1]}", f"{own[0]} ± {own[1]}")
            self.collector.restore(kept["collector"])
            self.ppo.restore(kept["ppo"])
        except CheckpointError:
            raise
        except Exception as error:  # whatever a file of another kind, of other code or of another agent raises
            first = str(error).partition("\n")[0]
            raise CheckpointError(file, first, "a checkpoint of a training of this agent") from None
        agent.load_state_dict(last.state_dict())
        best = best if any(row.judged for row in kept["rows"]) else agent
        self.first_std = kept["first_std"]
        self.result = replace(self.result, best=best, rows=kept["rows"])


def _move(agent: ActorCritic, device: str | torch.device) -> None:
    """Move an agent to a device of this machine."""
    try:
        agent.to(torch.device(device))
    except (RuntimeError, AssertionError, TypeError) as error:
        got = f"{device!r}: {str(error).splitlines()[0]}"
        known = "cpu" + (", cuda" if torch.cuda.is_available() else "")
        raise InputError("device", got, f"one of this machine: {known}") from None
