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

import numpy as np
import torch
from torch import Tensor
from tqdm import tqdm

from ccdtools.arrays import Array
from ccdtools.co_design.design_gradients import Differences, Slope, check_gradients
from ccdtools.co_design.differentiable_model import ScenarioTensors, scenario_tensors, to_design
from ccdtools.co_design.episodes import Episode, episode_at, fewer_runs
from ccdtools.co_design.feasible import DesignRegion, measured_slope
from ccdtools.co_design.learned_result import Convergence
from ccdtools.co_design.limits import Prices
from ccdtools.co_design.ppo_part import PPOPart
from ccdtools.co_design.result import History
from ccdtools.co_design.risk_intervals import of_kept_runs
from ccdtools.co_design.sample_average import Climb, SampleAverage
from ccdtools.co_design.status import CoDesignStatus
from ccdtools.co_design.task import Iterate, Task
from ccdtools.co_design.tolerances import (
    FEW_PARAMETERS,
    FINER_STEPS,
    QUIET_BLOCKS,
    QUIET_BLOCKS_LIMITED,
    WORTHWHILE_VIOLATION,
)
from ccdtools.progress import at
from ccdtools.statistics import PairedDifference, paired_difference
from learning.networks import ActorCritic
from learning.ppo import decay_exploration


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
        config = task.config
        self.task = task
        self.agent = agent
        self.rng = rng
        self.start = design
        self.evaluation = evaluation
        self.limits = task.limits
        self.region = DesignRegion(task.problem.design, task.problem.design.to_unit(design))
        self.v = torch.tensor(task.problem.design.to_unit(design), dtype=torch.float32).requires_grad_(True)
        asked = config.design_gradient == "network_input"
        self.check = (
            check_gradients(task.problem, agent, design, rng=rng, ppo=config.ppo, network_input=asked)
            if task.moving else None
        )  # fmt: skip
        self.ppo = PPOPart(task.problem, agent, self._p(), rng, config)
        self.first_std = agent.log_std.exp().mean().item()
        if task.smooth:  # nothing is explored, and the sampled policy is reported too
            decay_exploration(agent, self.first_std, config.ppo.final_std, 1.0)
        self.design_optimiser = torch.optim.Adam([self.v], lr=config.design_rate or 1.0, betas=(0.8, 0.9))
        self.policy_optimiser = torch.optim.Adam(agent.mean_network.parameters(), lr=config.policy_rate or 1.0)
        self.model_steps = 0
        self.iterations = 0
        self.blocks = 0
        self.quiet = 0
        self.longer = 1
        self.step = FINER_STEPS[0]  # of the finite differences, where the design follows them
        self.prices: Prices | None = None  # of leaving X, at the last cost
        self.rows: list[tuple[int, int, Array, float, float, float]] = []
        self.best = self.evaluated()
        self.gain = PairedDifference(float("nan"), (float("nan"), float("nan")))
        self.slope = Slope.none(len(self.v))
        self.status: CoDesignStatus | None = None

    @property
    def ended(self) -> bool:
        """True if the co-design has settled or spent its budget."""
        return self.status is not None

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
        """Run one block of iterations and return its gain."""
        config = self.task.config
        before = self.best
        length = min(self.longer * config.block, config.iterations - self.iterations)
        if self.by_differences and self.task.moving:
            self.step = self._differences(self.drawn(config.pathwise_runs)).step(self.v)
        if self.task.smooth and before.lost == 0 and not self.limited:
            self._climb(length, bar)
        else:
            self._follow(length, bar)
        self._return_to_best()
        self.blocks += 1
        self.gain = paired_difference(self.best.returns, before.returns)
        self._judge(before)

    def _judge(self, before: Iterate) -> None:
        """Set the status if this was the last block."""
        improving = self._improved(before)
        self.quiet = 0 if improving else self.quiet + 1
        spent = self.iterations >= self.task.config.iterations
        enough = QUIET_BLOCKS_LIMITED if self.limited else QUIET_BLOCKS[self.task.method]
        if not spent and self.quiet < enough:
            return
        climbing = self._climbs() if self.task.moving else False
        if climbing and not spent:
            self.quiet = 0
            self.longer *= 2  # a slope that the block was too short to follow
            return
        self.status = self._verdict(improving, climbing)

    def _verdict(self, improving: bool, climbing: bool) -> CoDesignStatus:
        """Status of the co-design, whatever its closed loop does."""
        if self.task.moving and self._untrusted():
            return CoDesignStatus.GRADIENT_UNTRUSTED
        if improving:
            return CoDesignStatus.STILL_IMPROVING
        if climbing:
            return CoDesignStatus.BUDGET_SPENT
        held = self.slope.rises_across_bounds(self._matters)
        return CoDesignStatus.AT_BOUND if held else CoDesignStatus.CONVERGED

    def _improved(self, before: Iterate) -> bool:
        """True if the block brought a worthwhile gain, fewer lost runs or violations."""
        best = self.best
        if best.lost < before.lost or best.violation < WORTHWHILE_VIOLATION * before.violation:
            return True
        return bool(self.gain.ci95[0] > 0 and self.gain.mean > self.task.config.tolerance * self._size)

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

    def _untrusted(self) -> bool:
        """Whether no estimate of the design gradient is trusted."""
        if self.check is None or self.check.trusted or self.task.config.design_gradient != "pathwise":
            return False
        return self.slope.unresolved(self._size) or not self.by_differences

    def drawn(self, runs: int) -> ScenarioTensors:
        """Fresh scenarios of the problem."""
        return scenario_tensors(self.task.problem, fewer_runs(runs, self.task.problem.steps), self.rng)

    def keep(self, iterate: Iterate) -> None:
        """Keep an iterate if it beats the best so far."""
        self.best = iterate if iterate.beats(self.best) else self.best

    def _return_to_best(self) -> None:
        """Go on from the best iterate."""
        self.agent.load_state_dict(self.best.agent.state_dict())
        with torch.no_grad():
            self.v.copy_(self.best.v)

    def _climb(self, length: int, bar: tqdm) -> None:
        """Climb by at most `length` evaluations of L-BFGS-B.

        All are on one set of scenarios.
        """
        scenarios = self.drawn(self.task.config.pathwise_runs)
        samples = scenarios[1].shape[0] * scenarios[1].shape[1]

        def counted() -> bool:
            self.count(bar)
            self.model_steps += samples
            return self.iterations % self.task.config.evaluate_every == 0

        paid = float(self.task.problem.cost_of_design(self._p()))  # a constant, beside which nothing would matter
        average = SampleAverage(
            lambda: self.cost(self.v, scenarios) - paid,
            weights=list(self.agent.mean_network.parameters()) if self.task.pathwise else [],
            v=self.v if self.task.moving else None,
            scale=self._size or 1.0,
            slope=(lambda: self._slope_by_differences(scenarios)) if self.by_differences else None,
            region=None if self.region.whole_box else self.region,
        )
        Climb(average, length, counted=counted, look=self._looked).run()

    def _looked(self) -> bool:
        """Score the present iterate; return whether leaving X costs anything now."""
        self.keep(self.evaluated())
        return self.limited

    def _follow(self, length: int, bar: tqdm) -> None:
        """Take steps of Adam, and of PPO if used, on fresh scenarios."""
        for k in range(length):
            self.iterate(k, length)
            self.count(bar)
            if (k + 1) % self.task.config.evaluate_every == 0 or k + 1 == length:
                self.keep(self.evaluated())

    def count(self, bar: tqdm) -> None:
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
        values = self.task.judge.risk.values(seen.total)
        mean, std, lost = of_kept_runs(self.task.judge.risk, seen.total.double().numpy(), seen.diverged.numpy())
        steps = self.model_steps + self.ppo.env_steps
        self.rows.append((self.iterations, steps, self.region.settled(self.v), mean, std, lost))
        violation = 0.0
        outcome = None
        if self.limits is not None:
            if lost == 0:  # of runs that are lost, neither MPC nor a multiplier says anything
                self.limits = self.limits.updated(seen, self.v.detach(), self.evaluation)
            violation = self.limits.violation(seen)
            outcome = self.limits.outcome(seen)
        return Iterate(self.v.detach().clone(), copy.deepcopy(self.agent), values.numpy(), violation, lost, outcome)

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
            rollout = self.ppo.collect(self._p())
            if by_network_input:
                gradient = self.ppo.network_input_gradient(rollout, self.v)
            if task.ppo:
                self.ppo.update(rollout, factor=factor, actor=self.iterations >= config.ppo.critic_only)
        if task.pathwise or (task.moving and not by_network_input):
            through_model = self._follow_model(factor)
            gradient = through_model if gradient is None else gradient
        if task.moving and gradient is not None:
            self._move_design(gradient, factor)

    def _follow_model(self, factor: float) -> Tensor:
        """Gradient of the relative return by the design through the dynamics.

        The policy takes a step on its own.
        """
        task = self.task
        scenarios = self.drawn(task.config.pathwise_runs)
        self.model_steps += scenarios[1].shape[0] * scenarios[1].shape[1]
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

    def history(self) -> History:
        """Evaluations so far."""
        return History(*(np.array(column) for column in zip(*self.rows)))

    def convergence(self) -> Convergence:
        """Evidence that the status rests on."""
        slope = self.slope
        return Convergence(self.gain, slope.mean, slope.error, self.by_differences, self.blocks, self.iterations)


def _set_rate(optimiser: torch.optim.Optimizer, rate: float) -> None:
    """Set the learning rate of an optimiser's groups."""
    for group in optimiser.param_groups:
        group["lr"] = rate
