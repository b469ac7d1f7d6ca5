"""Co-design by gradients through the model, PPO, or both."""

from __future__ import annotations

import copy
from dataclasses import dataclass, replace
from functools import partial
from types import NoneType
from typing import Any

import numpy as np
import torch

from ccdtools.arrays import Array
from ccdtools.co_design.agents import check_agent
from ccdtools.co_design.ascent import Ascent
from ccdtools.co_design.budgets import CLIMBED_COMBINATIONS, SETTLING_RUNS
from ccdtools.co_design.closed_loop import closed_loop_returns
from ccdtools.co_design.configuration import METHODS, CoDesignConfig
from ccdtools.co_design.design_controllers import saturated_lqr
from ccdtools.co_design.differentiable_model import episode_at, fewer_runs, scenario_tensors
from ccdtools.co_design.imitation import EXPERTS, best_expert, first_policy, policy_from_scratch
from ccdtools.co_design.iterate import Task
from ccdtools.co_design.landscape import combinations, valleys
from ccdtools.co_design.learned_result import GradientCheck, LearnedCoDesign
from ccdtools.co_design.least_depth import warn_of_unavoidable_depth
from ccdtools.co_design.limits import StateLimitPenalty
from ccdtools.co_design.loops import lqr_is_expert
from ccdtools.co_design.policy_check import gradient_of_policy
from ccdtools.co_design.problem import CoDesignProblem
from ccdtools.co_design.result import CoDesignResult, CoDesignStatus, History, Valley
from ccdtools.co_design.risk import Mean, check_followed, measure
from ccdtools.co_design.tolerances import SAME_PLACE, WORTH_A_START
from ccdtools.controllers.learned import LearnedPolicy
from ccdtools.exceptions import InputError
from ccdtools.plants.design_space import DesignSpace
from ccdtools.plants.models import for_long_work
from ccdtools.progress import at, bar
from ccdtools.statistics import paired_difference
from ccdtools_ground.door import as_choice, as_count, as_flag, as_instance, has_method
from learning.networks import ActorCritic
from mpc import MPCError

FROM_SCRATCH = "PPO learned from scratch what the policy began with"
LED_ASTRAY = (CoDesignStatus.GRADIENT_UNTRUSTED, CoDesignStatus.NOT_STATIONARY)


@dataclass(frozen=True, kw_only=True)
class Learned:
    """Policy and design that climb together, from an expert's imitation.

    Attributes
    ----------
    by : {"pathwise", "ppo", "pathwise+ppo"}
        What moves the policy: its gradient through the model, PPO, or both. Where `codesign` finds at the end of a
        climb that the policy has no gradient, or not that of its return, or that a plain search is better, PPO goes on
        from there, with one from scratch beside it; behind a baseline a climb goes on at its design.
        `config.design_gradient` says what moves the design.
    agent : ActorCritic, optional
        Warm start, from `learning.fit_actor_critic`; copied, not changed. By default one that imitates saturated LQR
        is made, or, where LQR brings nothing to rest, as in a swing-up, LQR of the secant or MPC of the model; without
        any expert PPO learns one from scratch. One is made, too, beside one that is far worse than this expert at the
        first design: a policy that saturates wherever it is has no gradient. The best end is handed out.
    config : CoDesignConfig
    judge : CoDesignProblem, optional
        What the iterates are scored on, if not the problem itself: for example replays of what was logged, where
        the problem holds a learned model whose errors an optimiser may exploit.
    limits : optional
        What leaving X costs, see `StateLimitPenalty`; by default what `judge.limit_tolerance` asks for.
    history : int, optional
        Of a problem with a `measurement` the policy sees the estimate of a Kalman filter of its design, by cubature
        where the model has expressions; it begins by imitating LQR, behind it LQG. With a number it sees so many last
        outputs and inputs instead, and begins by imitating LQG.
    from_scratch : bool
        Whether a policy that PPO learns from nothing, at the first design, climbs beside it, along its own gradient
        where that is the one of its return, else as `by` says. It may find what no small change of an expert's
        imitation reaches, such as the use of a wall. One is taken, too, where LQR does nothing at the first design, as
        of a damper whose damping is the input, and where `codesign` goes on from a climb.
    continued : bool
        Whether the agent was handed out by a former co-design: its gradient is not looked at before it moves.
    """

    by: str = "pathwise"
    agent: ActorCritic | None = None
    config: CoDesignConfig | None = None
    judge: CoDesignProblem | None = None
    limits: StateLimitPenalty | None = None
    history: int | None = None
    from_scratch: bool = False
    continued: bool = False

    def __post_init__(self) -> None:
        as_choice("method", self.by, METHODS)
        kinds = (ActorCritic, NoneType)
        as_instance("agent", self.agent, kinds, "an ActorCritic", "fit_actor_critic makes one.")
        config = CoDesignConfig() if self.config is None else self.config
        object.__setattr__(self, "config", as_instance("config", config, CoDesignConfig, "a CoDesignConfig"))
        if self.history is not None:
            as_count("history", self.history, least=0)
        as_flag("from_scratch", self.from_scratch)
        as_flag("continued", self.continued)
        if self.judge is not None:
            as_instance("judge", self.judge, CoDesignProblem, "a CoDesignProblem or None")
        if self.limits is not None:
            has_method("limits", self.limits, "prices", "a StateLimitPenalty or None")

    @property
    def name(self) -> str:
        """Name of the method in tables."""
        return self.by

    def run(
        self, problem: CoDesignProblem, design: Array, rng: np.random.Generator, *, progress: bool = False
    ) -> LearnedCoDesign:
        """Best design and policy from a feasible design (np,)."""
        known = problem
        if known.hidden:
            expected = "the problem with a measurement that it was made of"
            raise InputError("problem", "one whose states are outputs and inputs", expected, "Learned(history=m).")
        if self.judge is not None and not known.measurement is self.judge.measurement is None:
            raise InputError("judge", "a problem to score by, beside a measurement", "nothing")
        problem = self._seen(known)
        config: Any = self.config
        work = config.iterations * config.pathwise_runs * problem.steps
        problem = replace(problem, model=for_long_work(problem.model, work))
        judge = problem if self.judge is None else self.judge
        check_followed(problem.risk, self.by, config.design_gradient)
        _check_judge(problem, judge)
        _check_objective(problem)
        task = Task(problem, judge, self.by, config, self.limits)
        first = partial(_first_agent, task, known, design, self.history, rng, progress=progress)
        task, agent = first() if self.agent is None else (task, self.agent)
        check_agent(problem, agent)
        given = agent
        limits = self.limits
        if limits is None and judge.limit_tolerance != "off":
            limits = StateLimitPenalty(judge)
            warn_of_unavoidable_depth(judge, design)
        task = replace(task, limits=limits)
        at("landscape of saturated LQR")
        found = chosen_valleys(replace(task, problem=known), design, rng)
        agents = [(task, agent)]
        if task.moves_policy and self.agent is not None and not problem.hidden and _spoilt(judge, agent, design, rng):
            agents.append((task, first()[1]))
        if self.from_scratch or (task.moves_policy and self._alone(known) and _does_nothing(known, design)):
            learned = policy_from_scratch(problem, design, rng)
            agents.append((_on_from_scratch(task, learned, design, rng), learned))
        begun = LearnedPolicy(agent, design)
        checked = task.pathwise and not self.continued
        before = _gradients(problem, begun, rng, SETTLING_RUNS // 2) if checked else None
        ascents = race(agents, start_designs(task, design, found), rng, progress=progress)
        result = replace(_result(ascents, given, design, found), first_policy_gradients=before)
        if known.measurement is None:
            return result
        from ccdtools.co_design.output_filter import memory_at

        return replace(result, memory=memory_at(known, result.design, self.history or None))

    def following(self, agent: ActorCritic) -> Learned:
        """Method that goes on from an agent."""
        return replace(self, agent=agent, continued=True)

    def instead(self, result: CoDesignResult, problem: CoDesignProblem) -> Learned | None:
        """What goes on from a climb that led to no optimum of the policy; else None.

        Behind a baseline the climb itself, where the policy's gradient leads; else PPO, with a policy from scratch.
        """
        known = getattr(result, "policy_gradients", None) is not None and result.status in LED_ASTRAY
        behind = result.status is CoDesignStatus.WORSE_THAN_BASELINE
        config: Any = self.config
        if self.by == "ppo" or config.policy_rate == 0 or not (known or behind):
            return None
        if not isinstance(problem.risk, Mean) or not isinstance(result, LearnedCoDesign):
            return None
        if behind and _leads(self._seen(problem), result.policy, np.random.default_rng(0)):
            return replace(self, agent=result.agent, from_scratch=False)
        scratch = self.from_scratch or self._alone(problem)
        return replace(self, by="ppo", agent=result.agent, from_scratch=scratch)

    def _alone(self, problem: CoDesignProblem) -> bool:
        """Whether nothing is given that a policy from scratch would not know of."""
        given = (self.agent, self.judge, problem.measurement, problem.discrepancy)
        return all(one is None for one in given)

    def _seen(self, problem: CoDesignProblem) -> CoDesignProblem:
        """Problem of what the policy sees."""
        if problem.measurement is None:
            return problem
        if self.history == 0:
            return replace(problem, measurement=None)
        from ccdtools.co_design.output_filter import measured_problem

        return measured_problem(problem, self.history)


def _does_nothing(problem: CoDesignProblem, design: Array) -> bool:
    """Whether LQR has no gain, so that there is nothing to imitate."""
    try:
        return not saturated_lqr(problem, design).K.any()
    except (MPCError, InputError):
        return False


def _on_from_scratch(task: Task, agent: ActorCritic, design: Array, rng: np.random.Generator) -> Task:
    """Task of a policy from scratch, by its gradient where this leads."""
    task = replace(task, begun=FROM_SCRATCH)
    own = replace(task, method="pathwise")
    return own if own.pathwise and _leads(task.problem, LearnedPolicy(agent, design), rng) else task


def _leads(problem: CoDesignProblem, policy: LearnedPolicy, rng: np.random.Generator) -> bool:
    """Whether the gradient of a policy is that of its return."""
    return not problem.jump and not _gradients(problem, policy, rng, 2 * SETTLING_RUNS).astray


def _gradients(
    problem: CoDesignProblem, policy: LearnedPolicy, rng: np.random.Generator, runs: int
) -> GradientCheck:  # fmt: skip
    """Gradients of a policy beside differences, on fresh scenarios."""
    drawn = scenario_tensors(problem, fewer_runs(runs, problem.steps), copy.deepcopy(rng))
    return gradient_of_policy(problem, policy, drawn)


def _first_agent(
    task: Task, known: CoDesignProblem, design: Array, history: int | None, rng: np.random.Generator, *,
    progress: bool,
) -> tuple[Task, ActorCritic]:  # fmt: skip
    """Task, and agent that it begins with."""
    problem = replace(known, measurement=None)
    if known.measurement is not None and history:
        from ccdtools.co_design.output_history import warm_start_of_outputs

        return task, warm_start_of_outputs(task.problem, known, rng)
    expert = "auto" if task.moves_policy else "lqr"
    first = first_policy(problem, design, rng, expert=expert, all_over=task.designing, progress=progress)
    return task if first.samples else replace(task, begun=FROM_SCRATCH), first.agent


def _spoilt(problem: CoDesignProblem, agent: ActorCritic, design: Array, rng: np.random.Generator) -> bool:
    """True if a policy is far worse than the expert.

    It loses runs that LQR, or what stands in its place, keeps, or a fifth of its return.
    """
    near = lqr_is_expert(problem, design, copy.deepcopy(rng))
    name = "LQR" if near else best_expert(problem, design, copy.deepcopy(rng))
    if name is None:
        return False
    try:
        expert = EXPERTS[name](problem, design)
    except MPCError:
        return False
    own, other = (
        closed_loop_returns(problem, controller, design, copy.deepcopy(rng), runs=64 if name == "LQR" else 8)
        for controller in (LearnedPolicy(agent, design), expert)
    )
    if own.lost.any() or other.lost.any():
        return own.lost_share > other.lost_share
    size = float(problem.made_by_control(other.summary.mean, design))
    return other.summary.mean - own.summary.mean > WORTH_A_START * size


def _result(ascents: list[Ascent], agent: ActorCritic, design: Array, found: tuple[Valley, ...]) -> LearnedCoDesign:
    """Winner of the race, with the others' outcomes."""
    winner = ascents[0]
    task = winner.task
    best = winner.region.settled(winner.best.v)
    assert winner.status is not None
    return LearnedCoDesign(
        design=best, agent=winner.best.agent, method=task.method, status=winner.status,
        objective=winner.best.score, criterion=f"{measure(task.judge.risk)} return of the policy on fixed scenarios",
        evaluations=sum(ascent.iterations for ascent in ascents), history=History.of(winner.rows),
        limits=winner.best.limits, valleys=_with_ends(found, ascents, design), gradients=winner.check,
        gains=_gains(task, winner, agent, design), convergence=winner.convergence(),
        notes=(task.begun,) if task.begun else (),
    )  # fmt: skip


@torch.no_grad()
def _gains(task: Task, winner: Ascent, agent: ActorCritic, design: Array) -> dict[str, float]:
    """Gains by design, then policy, on the evaluation scenarios."""
    first = torch.tensor(task.problem.design.to_unit(design), dtype=torch.float32)
    before, moved = (
        task.judge.risk.values(episode_at(task.judge, agent, v, winner.evaluation).total).mean().item()
        for v in (first, winner.best.v)
    )
    by_design = {"design": moved - before} if task.designing else {}
    return by_design | {"policy": winner.best.score - moved}


def _with_ends(found: tuple[Valley, ...], ascents: list[Ascent], design: Array) -> tuple[Valley, ...]:
    """Local optima with the best co-design's end from each."""
    named = []
    for valley in found:
        places = [valley.design, design] if valley.given else [valley.design]
        begun = [one for one in ascents if any(np.array_equal(one.start, place) for place in places)]
        if begun:
            first = leader(begun)
            end = first.region.settled(first.best.v)
            valley = replace(valley, found=end, found_return=first.best.score)
        named.append(valley)
    return tuple(named)


def _check_judge(problem: CoDesignProblem, judge: CoDesignProblem) -> None:
    """Raise an `InputError` unless the judge has the problem's states, inputs and box."""
    own = problem.design
    other = judge.design
    same_box = own.names == other.names and np.array_equal([own.lower, own.upper], [other.lower, other.upper])
    if not same_box or (judge.model.nx, judge.model.nu) != (problem.model.nx, problem.model.nu):
        raise InputError("judge", repr(judge), "the states, inputs and box of designs of the problem")


def _check_objective(problem: CoDesignProblem) -> None:
    """Raise an `InputError` unless rewards are differentiable, one per torch row."""
    x = torch.zeros(2, problem.model.nx, requires_grad=True)
    u = torch.zeros(2, problem.model.nu, requires_grad=True)
    try:
        rewards = problem.objective.rewards(x, u, x, torch.tensor(problem.design.centre, dtype=x.dtype))
        fits = torch.is_tensor(rewards) and rewards.shape == (2,) and rewards.requires_grad
    except (TypeError, ValueError, RuntimeError, AttributeError):
        fits = False
    if not fits:
        raise InputError(
            "objective", f"a {type(problem.objective).__name__} whose rewards do not take torch tensors",
            "rewards (n,) of states (n, nx) and inputs (n, nu), NumPy arrays and torch tensors alike",
        )  # fmt: skip


def chosen_valleys(task: Task, design: Array, rng: np.random.Generator) -> tuple[Valley, ...]:
    """Local optima of the landscape; none for a frozen design or single start."""
    if not task.designing or task.config.starts == 1:
        return ()
    return valleys(task.problem, design, rng=rng)


def start_designs(task: Task, design: Array, found: tuple[Valley, ...]) -> list[Array]:
    """Given design, and the bottoms of the best other valleys."""
    space = task.problem.design
    if space.integer:  # all of few combinations, and the best of many
        number = combinations(space)
        most = 1 + int(number) if number <= CLIMBED_COMBINATIONS else 4
    else:
        most = 3 if space.free.sum() <= 3 else 2  # a second local optimum is climbed from in up to 3
    most = task.config.starts or most
    starts = [np.asarray(design, dtype=float)]
    for valley in found:
        best = found[0].lqr_return
        hopeful = valley.lqr_return >= best - WORTH_A_START * task.problem.made_by_control(best, found[0].design)
        elsewhere = all(_apart(space, space.to_unit(valley.design), space.to_unit(one)) for one in starts)
        if len(starts) < most and hopeful and elsewhere:
            starts.append(valley.design)
    return starts


def race(
    agents: list[tuple[Task, ActorCritic]], starts: list[Array], rng: np.random.Generator, *, progress: bool
) -> list[Ascent]:
    """Ascents of every agent, with its task, from every start, best first.

    They climb a block at a time. One is given up when it has come to the place of a better one, loses runs that a
    better one keeps, or is behind it by more than its last block gained and than chance explains. Each draws from a
    generator of its own, and all are scored on the same scenarios.
    """
    at("first look at every start")
    config, judge = agents[0][0].config, agents[0][0].judge
    evaluation = scenario_tensors(judge, fewer_runs(config.evaluation_runs, judge.steps), rng)
    ascents = [
        Ascent(task, copy.deepcopy(agent), design, np.random.default_rng(rng.integers(2**63, size=4)), evaluation)
        for task, agent in agents
        for design in starts
    ]
    climbing = list(ascents)
    with bar(label="co-design", total=config.iterations, progress=progress) as shown:
        while climbing:
            for ascent in climbing:
                ascent.block(shown)
            first = leader(ascents)
            climbing = [one for one in climbing if one.status is None and (one is first or _hopeful(one, first))]
    first = leader(ascents)
    return [first, *(one for one in ascents if one is not first)]


def leader(ascents: list[Ascent]) -> Ascent:
    """Ascent with the best iterate."""
    first = ascents[0]
    for one in ascents[1:]:
        first = one if one.best.beats(first.best) else first
    return first


def _hopeful(one: Ascent, first: Ascent) -> bool:
    """True if an ascent may overtake the first without more lost runs."""
    if one.best.lost > first.best.lost:
        return False
    if not _apart(one.task.problem.design, one.best.v.numpy(), first.best.v.numpy()):
        return False
    behind = paired_difference(first.best.returns, one.best.returns)
    gained = one.gain.mean if np.isfinite(one.gain.mean) else 0.0
    return not (behind.ci95[0] > 0 and behind.mean > gained)


def _apart(space: DesignSpace, v: Array, other: Array) -> bool:
    """True if two points differ, as other whole numbers always do."""
    away = np.abs(v - other)
    return bool(away.max() > SAME_PLACE or (away * space.allowed.width)[space.whole].max(initial=0.0) > 0.5)
