"""Co-design from one start.

Policy and design climb together, block by block, while it pays.

Along the gradient through the model, a block is a climb by L-BFGS-B on a fixed set of scenarios, on which the return is
a smooth function of policy and design; the next block draws another set, so that nothing is fitted to one. With PPO
beside it, while runs diverge, or while a state limit binds, Adam takes its steps on fresh scenarios instead, its rates
falling along a cosine. The gain of a block is measured on further scenarios, the same for all, and the next one starts
from the best iterate.

References
----------
Kim, Pasupathy and Henderson, "A guide to sample average approximation", Handbook of Simulation Optimization, 2015;
Byrd, Lu, Nocedal and Zhu, SIAM J. Sci. Comput. 16, 1995 (L-BFGS-B, in SciPy); Loshchilov and Hutter, "SGDR", ICLR 2017.
"""

from __future__ import annotations

import copy
from functools import cached_property

import numpy as np
import torch
from torch import Tensor
from tqdm import tqdm

from ccdtools.arrays import Array
from ccdtools.co_design.budgets import FEW_PARAMETERS, LITTLE_EXPLORATION, QUIET_BLOCKS, QUIET_BLOCKS_LIMITED, SEEN_RUNS
from ccdtools.co_design.climb import SampleAverage, climb
from ccdtools.co_design.design_gradients import Differences, Slope, check_gradients
from ccdtools.co_design.differentiable_model import (
    Episode,
    ScenarioTensors,
    Stepper,
    episode_at,
    fewer_runs,
    mean_law,
    observe,
    scenario_tensors,
    to_design,
    visited,
)
from ccdtools.co_design.environment import EpisodeEnv, loss_gradient
from ccdtools.co_design.feasible import DesignRegion, measured_slope
from ccdtools.co_design.iterate import Iterate, Task
from ccdtools.co_design.learned_result import Convergence
from ccdtools.co_design.limits import Prices
from ccdtools.co_design.result import CoDesignStatus, HistoryRow
from ccdtools.co_design.risk import of_kept_runs
from ccdtools.co_design.tolerances import FINER_STEPS, LEAST_FILL, SAME_PLACE, WORTHWHILE_VIOLATION
from ccdtools.progress import at
from ccdtools.statistics import PairedDifference, paired_difference
from learning.networks import ActorCritic
from learning.ppo import PPO, prepare
from learning.rollout import collect
from learning.training import decay_exploration, first_exploration


class Ascent:
    """Moving parts of one co-design; the given agent is trained in place.

    Parameters
    ----------
    evaluation : tensors (n, nx) and (n, T, nw)
        Fixed scenarios of the judge that iterates are scored on.
    """

    def __init__(
        self, task: Task, agent: ActorCritic, design: Array, rng: np.random.Generator, evaluation: ScenarioTensors
    ) -> None:
        problem, config = task.problem, task.config
        self.task = task
        self.agent = agent
        self.rng = rng
        self.start = design
        self.evaluation = evaluation
        self.limits = task.limits
        self.region = DesignRegion(problem.design, problem.design.to_unit(design))
        self.v = torch.tensor(self.region.last, dtype=torch.float32).requires_grad_(True)
        asked = config.design_gradient == "network_input"
        self.check = (
            check_gradients(problem, agent, design, rng=rng, ppo=config.ppo, network_input=asked)
            if task.moving else None
        )  # fmt: skip
        self.generator = torch.Generator().manual_seed(int(rng.integers(2**31)))
        if task.pathwise:
            self._see(scenario_tensors(problem, fewer_runs(SEEN_RUNS, problem.steps), rng))
        runs = fewer_runs(config.runs, problem.steps)
        self.env = EpisodeEnv(problem, self._p(), runs=runs, rng=rng, divergence=problem.divergence)
        if task.smooth:  # nothing is explored, and the sampled policy is reported too
            decay_exploration(agent, 1.0, config.ppo.final_std or LITTLE_EXPLORATION, 1.0)
        self.first_std = first_exploration(agent, config.ppo) if task.ppo else agent.log_std.exp().mean().item()
        self.ppo = PPO(agent, config.ppo, given=problem.design.dim)
        self.samples = 0  # steps of the model and of the environment so far
        self.iterations = 0
        self.blocks = 0
        self.quiet = 0
        self.longer = 1
        self.reach = 1.0  # of the design in a block, in parts of the unit box
        self.gone = 0.0  # so far from the best design a climb has ended
        self.step = FINER_STEPS[0]  # of the finite differences, where the design follows them
        self.prices: Prices | None = None  # of leaving X, at the last cost
        self.rows: list[HistoryRow] = []
        self.best = self.evaluated()
        self.gain = PairedDifference(float("nan"), (float("nan"), float("nan")))
        self.slope = Slope.none(len(self.v))
        self.status: CoDesignStatus | None = None  # once it has settled or spent its budget

    @cached_property
    def design_optimiser(self) -> torch.optim.Optimizer:
        """Adam of the design; PyTorch loads a compiler with the first one, which a climb needs none of."""
        return torch.optim.Adam([self.v], lr=self.task.config.design_rate or 1.0, betas=(0.8, 0.9))

    @cached_property
    def policy_optimiser(self) -> torch.optim.Optimizer:
        """Adam of the policy."""
        return torch.optim.Adam(self.agent.mean_network.parameters(), lr=self.task.config.policy_rate or 1.0)

    def _see(self, scenarios: ScenarioTensors) -> None:
        """Normalise by the states that the policy visits; what it does stays.

        In the units of X, of which a loop may fill little, a climb can end early.
        """
        p = self._p()
        x, *_ = visited(Stepper.at(self.task.problem, p), mean_law(self.agent, p), scenarios)
        limit = torch.as_tensor(self.task.problem.limit, dtype=torch.float32)
        x = x[(x.abs() <= limit).all(dim=1)]  # of runs that are lost, what came before
        if len(x):
            seen = observe(x[:, self.task.problem.hidden :], p)
            fill = seen.std(dim=0, correction=0) / self.agent.observation_scale
            least = LEAST_FILL * fill[: seen.shape[1] - len(p)].max() * self.agent.observation_scale
            self.agent.see(seen, given=self.task.problem.design.dim, keep=True, least=least)

    @property
    def limited(self) -> bool:
        """Whether leaving X costs anything now."""
        return self.limits is not None and self.limits.active

    @property
    def by_differences(self) -> bool:
        """True if finite differences replace the design gradient through the model."""
        wrong = self.check is not None and not self.check.trusted
        return wrong and self.region.free.sum() <= FEW_PARAMETERS and self.task.config.design_gradient == "pathwise"

    def block(self, bar: tqdm) -> None:
        """Run one block of iterations from the best iterate, and set the status if it was the last."""
        config = self.task.config
        before, self.gone = self.best, 0.0
        length = min(self.longer * config.block, config.iterations - self.iterations)
        if self.by_differences and self.task.moving:
            self.step = self._differences(self._drawn()).step(self.v)
        if self.task.smooth and before.lost == 0 and not self.limited:
            self._climb(length, bar)
            self.gone = float(np.abs(self.v.detach().numpy() - self.best.v.numpy()).max(initial=0.0))
        else:  # steps of Adam, and of PPO if used, on fresh scenarios
            for k in range(length):
                self.iterate(k, length)
                self._count(bar)
                if (k + 1) % config.evaluate_every == 0 or k + 1 == length:
                    self._look()
        self.agent.load_state_dict(self.best.agent.state_dict())
        with torch.no_grad():
            self.v.copy_(self.best.v)
        self.blocks += 1
        self.gain = paired_difference(self.best.returns, before.returns)
        self._judge(before)

    def _judge(self, before: Iterate) -> None:
        """Set the status if this was the last block."""
        best = self.best
        worthwhile = bool(self.gain.ci95[0] > 0 and self.gain.mean > self.task.config.tolerance * self._size)
        fewer = best.lost < before.lost or best.violation < WORTHWHILE_VIOLATION * before.violation
        improving = fewer or worthwhile
        self.quiet = 0 if improving else self.quiet + 1
        self.reach = min(1.0, 2 * self.reach) if improving else self.reach
        spent = self.iterations >= self.task.config.iterations
        enough = QUIET_BLOCKS_LIMITED if self.limited else QUIET_BLOCKS[self.task.method]
        if not spent and self.quiet < enough:
            return
        climbing = self._climbs() if self.task.moving else False
        if climbing and not spent:
            self.quiet = 0
            if self.gone > SAME_PLACE:  # where the scenarios of the block led, others return less
                self.reach = self.gone / 2
            else:  # a slope that the block was too short to follow
                self.longer *= 2
            return
        self.status = self._verdict(improving, climbing)

    def _verdict(self, improving: bool, climbing: bool) -> CoDesignStatus:
        """Status of the co-design, whatever its closed loop does."""
        unknown = self.check is not None and not self.check.trusted and self.task.config.design_gradient == "pathwise"
        if self.task.moving and unknown and (self.slope.unresolved(self._size) or not self.by_differences):
            return CoDesignStatus.GRADIENT_UNTRUSTED
        if improving:
            return CoDesignStatus.STILL_IMPROVING
        if climbing:
            return CoDesignStatus.BUDGET_SPENT
        held = self.slope.rises_across_bounds(self._matters)
        return CoDesignStatus.AT_BOUND if held else CoDesignStatus.CONVERGED

    def _climbs(self) -> bool:
        """True if the scoring return still rises along the design inside the box."""
        best = self.best
        judge = self.task.judge
        scenarios = scenario_tensors(judge, fewer_runs(512, judge.steps), self.rng)
        prices = self.limits.prices(self._seen(best), best.v) if self.limits is not None and self.limited else None
        self.slope = measured_slope(Differences(judge, best.agent, scenarios, prices), best.v, self.region)
        return self.slope.promises(self._matters)

    @property
    def _matters(self) -> float:
        """Gain of a slope that is worth following or naming."""
        return 2 * self.task.config.tolerance * self._size

    @property
    def _size(self) -> float:
        """Size of the best return, without its design cost."""
        best = self.best
        return float(self.task.judge.made_by_control(best.score, to_design(self.task.judge, best.v)))

    def _differences(self, scenarios: ScenarioTensors) -> Differences:
        """Finite differences of the present policy's return."""
        return Differences(self.task.problem, self.agent, scenarios, self.prices)

    def _slope_by_differences(self, scenarios: ScenarioTensors) -> Tensor:
        """Gradient (np,) of the mean return by finite differences."""
        return self._differences(scenarios).about(self.v, self.step).mean(0)

    def _drawn(self) -> ScenarioTensors:
        """Fresh scenarios of the problem, for a gradient through the model."""
        problem = self.task.problem
        return scenario_tensors(problem, fewer_runs(self.task.config.pathwise_runs, problem.steps), self.rng)

    def _climb(self, length: int, bar: tqdm) -> None:
        """Climb on one set of scenarios, by at most `length` evaluations of L-BFGS-B."""
        scenarios = self._drawn()

        def counted() -> bool:
            self._count(bar)
            self.samples += scenarios[1].shape[0] * scenarios[1].shape[1]
            return self.iterations % self.task.config.evaluate_every == 0

        paid = float(self.task.problem.cost_of_design(self._p()))  # a constant, beside which nothing would matter
        average = SampleAverage(
            lambda: self.cost(self.v, scenarios) - paid,
            weights=list(self.agent.mean_network.parameters()) if self.task.pathwise else [],
            v=self.v if self.task.moving else None,
            scale=self._size or 1.0,
            slope=(lambda: self._slope_by_differences(scenarios)) if self.by_differences else None,
            region=None if self.region.whole_box else self.region,
            reach=self.reach,
        )
        climb(average, length, counted=counted, look=self._look)

    def _look(self) -> bool:
        """Score the present iterate, keep it if best; return whether leaving X costs anything now."""
        iterate = self.evaluated()
        self.best = iterate if iterate.beats(self.best) else self.best
        return self.limited

    def _count(self, bar: tqdm) -> None:
        """Count one more iteration."""
        self.iterations += 1
        most = self.task.config.iterations
        at(f"iteration {self.iterations} of at most {most}", self.iterations / most)
        bar.update()

    def cost(self, v: Tensor, scenarios: ScenarioTensors) -> Tensor:
        """Differentiable mean cost at a unit-box point, including the cost of leaving X."""
        seen = episode_at(self.task.problem, self.agent, v, scenarios, depths=self.limited)
        cost: Tensor = -self.task.problem.risk.values(seen.total).mean()
        if self.limits is None or not self.limited:
            self.prices = None
            return cost
        self.prices = self.limits.prices(seen, v)
        return cost + self.limits.cost(seen, v)

    @torch.no_grad()
    def _seen(self, iterate: Iterate | Ascent) -> Episode:
        """Iterate on the fixed scenarios."""
        v = iterate.v.detach()
        return episode_at(self.task.judge, iterate.agent, v, self.evaluation, depths=self.limits is not None)

    def evaluated(self) -> Iterate:
        """Present iterate on the fixed scenarios; a history row is added."""
        seen = self._seen(self)
        risk = self.task.judge.risk
        mean, std, lost = of_kept_runs(risk, seen.total.double().numpy(), seen.diverged.numpy())
        self.rows.append((self.iterations, self.samples, self.region.settled(self.v), mean, std, lost))
        violation = 0.0
        outcome = None
        if self.limits is not None:
            if lost == 0:  # of runs that are lost, neither MPC nor a multiplier says anything
                self.limits = self.limits.updated(seen, self.v.detach(), self.evaluation)
            violation = self.limits.violation(seen)
            outcome = self.limits.outcome(seen)
        returns = risk.values(seen.total).numpy()
        return Iterate(self.v.detach().clone(), copy.deepcopy(self.agent), returns, violation, lost, outcome)

    def iterate(self, k: int, length: int) -> None:
        """Take one step of policy and design at iteration k's rates."""
        task = self.task
        config = task.config
        factor = 1.0 if config.constant_rates else 0.5 * (1 + np.cos(np.pi * k / length))
        explored = 1.0 if self.blocks else k / max(length - 1, 1)
        decay_exploration(self.agent, self.first_std, config.ppo.final_std, explored)
        by_network_input = task.moving and config.design_gradient == "network_input"
        gradient: Tensor | None = None
        if task.ppo or by_network_input:
            self.env.move(self._p())
            self.samples += self.env.runs * task.problem.steps
            rollout = collect(self.env, self.agent, steps=task.problem.steps, generator=self.generator)
            if by_network_input:  # before the update
                batch = prepare(self.agent, rollout, config.ppo)
                gradient = loss_gradient(task.problem, self.agent, self.v, batch, config.ppo)
            if task.ppo:
                self.ppo.set_rates(factor)
                self.ppo.update(rollout, generator=self.generator, actor=self.iterations >= config.ppo.critic_only)
        if task.pathwise or (task.moving and not by_network_input):
            through_model = self._follow_model(factor)
            gradient = through_model if gradient is None else gradient
        if task.moving and gradient is not None:
            self._move_design(gradient, factor)

    def _follow_model(self, factor: float) -> Tensor:
        """Gradient of the relative return by the design through the dynamics, after a step of the policy on its own."""
        task = self.task
        scenarios = self._drawn()
        self.samples += scenarios[1].shape[0] * scenarios[1].shape[1]
        cost = self.cost(self.v, scenarios)
        paid: Tensor = task.problem.cost_of_design(self._p())
        size = (cost.detach() - paid).abs()  # relative, so that a lost run's 1e8 today does not drown tomorrow's steps
        parameters = list(self.agent.mean_network.parameters()) if task.pathwise else []
        *gradients, design_gradient = torch.autograd.grad(cost / size, [*parameters, self.v])
        for parameter, gradient in zip(parameters, gradients):
            parameter.grad = gradient
        if parameters and torch.nn.utils.clip_grad_norm_(parameters, 1.0).isfinite():
            _set_rate(self.policy_optimiser, task.config.policy_rate * factor)
            self.policy_optimiser.step()
        if self.by_differences and task.moving:
            return (self._slope_by_differences(scenarios) / size).to(design_gradient.dtype)
        return -design_gradient

    def _move_design(self, gradient: Tensor, factor: float) -> None:
        """Move the design by clipped Adam, then back into bounds and constraints."""
        gradient = self.region.masked(gradient)
        norm = gradient.norm()
        if not norm.isfinite():
            return
        rate = self.task.config.design_rate * factor
        if self.region.bounded:  # Adam's own scaling would lead a step along a constraint off its way
            point = self.v.detach().double().numpy()
            gradient = torch.tensor(self.region.step(point, gradient.double().numpy(), rate), dtype=gradient.dtype)
            norm = gradient.norm()
        self.v.grad = -gradient / norm.clamp(min=1.0)
        _set_rate(self.design_optimiser, rate)
        self.design_optimiser.step()
        with torch.no_grad():
            self.v.clamp_(0.0, 1.0)
            if self.region.bounded:
                found = self.region.nearest(self.v.double().numpy())
                self.v.copy_(torch.tensor(self.region.last if found is None else found))

    def _p(self) -> Tensor:
        """Present design (np,), without its gradient."""
        return to_design(self.task.problem, self.v.detach())

    def convergence(self) -> Convergence:
        """Evidence that the status rests on."""
        slope = self.slope
        return Convergence(self.gain, slope.mean, slope.error, self.by_differences, self.blocks, self.iterations)


def _set_rate(optimiser: torch.optim.Optimizer, rate: float) -> None:
    """Set the learning rate of an optimiser's groups."""
    for group in optimiser.param_groups:
        group["lr"] = rate
