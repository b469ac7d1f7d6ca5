"""Check that a co-design has settled.

It is made once, of the controller handed out, after its closed loop was measured.

What a method claims of its own search is kept only where, on fresh scenarios, it foresaw the return, no run is lost,
the limits are kept as far as was asked for, saturated LQR of the same design and nested LQR from there are not better,
and, of a policy, MPC of its design and one gain tuned from there neither, its gradient is that of the closed loop, and
neither a plain search over its last layer nor other inputs that are held from the start are better. Where LQR brings
nothing to rest that MPC is of the model itself, and looks ahead over an episode.
"""

from __future__ import annotations

import copy
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import torch

from ccdtools.arrays import Array, Indices
from ccdtools.co_design.budgets import MPC_RUNS, SETTLING_RUNS
from ccdtools.co_design.closed_loop import RUNS as LOOP_RUNS, ClosedLoopReturns, closed_loop_returns, stretches
from ccdtools.co_design.design_controllers import linear_mpc, saturated_lqr
from ccdtools.co_design.differentiable_model import fewer_runs, scenario_tensors
from ccdtools.co_design.landscape import start_points
from ccdtools.co_design.learned_result import LearnedCoDesign
from ccdtools.co_design.limits import BY_MPC, NOTHING, UNTIL_LEFT, LimitsOutcome, Pair, tolerance_at
from ccdtools.co_design.methods.nested import Nested
from ccdtools.co_design.objective import QuadraticObjective
from ccdtools.co_design.policy_check import better_by_search, gradient_of_policy
from ccdtools.co_design.problem import CoDesignProblem
from ccdtools.co_design.result import Baseline, CoDesignResult, CoDesignStatus
from ccdtools.co_design.risk import Mean, measure, of_kept_runs
from ccdtools.co_design.risk_intervals import difference_of_parts, too_few
from ccdtools.co_design.secant import fitted, visited
from ccdtools.co_design.tolerances import LEAST_TOLERANCE, UNFORESEEN
from ccdtools.controllers.controllers import LinearFeedback
from ccdtools.controllers.learned import LearnedPolicy
from ccdtools.exceptions import InputError
from ccdtools.plants.linear_model import LinearModel
from ccdtools.progress import at
from ccdtools.statistics import PairedDifference
from ccdtools.tolerances import NOT_WORSE
from mpc import MPCError


@dataclass(frozen=True, eq=False)
class Settling:
    """Check of results on one set of fresh scenarios."""

    problem: CoDesignProblem  # what results are measured on
    scenarios: np.random.Generator  # draws the scenarios; it is copied, so that all controllers meet the same
    designing: bool = True  # whether another design might be handed out, so that nested LQR is a baseline
    foreseen: bool = True  # whether the objective of a method is a return of this problem
    by_mpc: dict[bytes, tuple[str, ClosedLoopReturns]] = field(default_factory=dict)  # at each design, as it takes long

    def checked(self, result: CoDesignResult) -> CoDesignResult:
        """Result with closed loop, limits, baselines and the status they leave."""
        at("closed loop of what was found, and its baselines")
        loop = self._loop(result.controller, result.design)
        notes = (*result.notes, *self.problem.notes)
        priced = result.limits is not None
        result = replace(result, closed_loop=loop, notes=notes, limits=self._limits(loop, result.design, result.limits))
        unforeseen = self._unforeseen(result, loop)
        if result.status is not CoDesignStatus.INFEASIBLE:
            result = _unless_broken(result, loop, priced=priced)
        if result.status.settled:
            result = replace(result, baselines=tuple(self._baselines(result, loop)))
            if any(map(_better, result.baselines)):
                result = replace(result, status=CoDesignStatus.WORSE_THAN_BASELINE)
            elif unforeseen:
                return replace(result, status=CoDesignStatus.UNFORESEEN)
        elif _learned(result.controller) and not loop.lost.any():
            result = replace(result, baselines=tuple(self._linear(result, loop)))
        if unforeseen:
            result = replace(result, notes=(*result.notes, CoDesignStatus.UNFORESEEN.advice))
        if not result.status.settled:
            return result
        return self._policy_checked(result, loop) if _learned(result.controller) else result

    def _unforeseen(self, result: CoDesignResult, loop: ClosedLoopReturns) -> bool:
        """Whether a method promises more than its closed loop, beyond chance and half of what control costs."""
        mean, *_ = of_kept_runs(self.problem.risk, loop.values, loop.lost)
        size = float(self.problem.made_by_control(mean, result.design))
        promised = self.foreseen and result.objective - mean > UNFORESEEN * size
        return bool(promised and not result.objective <= loop.summary.ci95[1])

    def continued(self, first: CoDesignResult, further: CoDesignResult) -> CoDesignResult:
        """The result that went on from a first one, or the first.

        It gained beyond chance, or it is settled, the first is not, and neither is better.
        """
        assert first.closed_loop is not None
        assert further.closed_loop is not None
        before, after = first.closed_loop, further.closed_loop
        pairs = np.arange(min(len(before.values), len(after.values)))
        gain = difference_of_parts(self.problem.risk, after.parts(pairs) - before.parts(pairs), pairs)
        named = self._in_parts(f"{further.method}, begun after it", further.design, gain, before)
        worse = further.status in (CoDesignStatus.DIVERGING, CoDesignStatus.LIMITS_BROKEN)
        settles = further.status.settled and not first.status.settled and named.gain.ci95[0] > -NOT_WORSE
        if worse or not (named.gain.ci95[0] > 0 or settles):
            return replace(first, baselines=(*first.baselines, named))
        low, high = (100 * end for end in named.gain.ci95)
        gained = f"{100 * named.gain.mean:.2f} % [{low:.2f}, {high:.2f}]"
        did = "gained" if named.gain.ci95[0] > 0 else "settled beside it,"
        note = f"{first.method} ended with {first.status.value}; {further.method} went on and {did} {gained}"
        both = first.method if first.method == further.method else f"{first.method}, then {further.method}"
        count = first.evaluations + further.evaluations
        further = replace(further, method=both, notes=(*further.notes, note), evaluations=count)
        if isinstance(first, LearnedCoDesign) and isinstance(further, LearnedCoDesign):
            gains = {part: gain + first.gains.get(part, 0.0) for part, gain in further.gains.items()}
            further = replace(further, gains=gains, first_policy_gradients=first.first_policy_gradients)
        return further

    def _loop(self, controller: Any, design: Array, runs: int | None = None) -> ClosedLoopReturns:
        """Returns of a controller on the fresh scenarios."""
        return closed_loop_returns(self.problem, controller, design, copy.deepcopy(self.scenarios), runs=runs)

    def _limits(self, loop: ClosedLoopReturns, design: Array, own: LimitsOutcome | None) -> LimitsOutcome | None:
        """Violations of a closed loop beside the tolerance, a method's `own` if X was left; None without one."""
        seen, errors = Pair(loop.outside, loop.depth), Pair(*loop.limit_errors)
        if own is not None and own.source != UNTIL_LEFT.source:
            return replace(own, achieved=seen, errors=errors)
        asked = self.problem.limit_tolerance
        if asked == "off":
            return None
        if not isinstance(asked, str):
            allowed, source = Pair(*asked), "asked for"
        elif not max(seen.values()) > LEAST_TOLERANCE:
            allowed, source = UNTIL_LEFT.allowed, UNTIL_LEFT.source
        else:
            v = torch.tensor(self.problem.design.to_unit(design))
            allowed, of_mpc = tolerance_at(self.problem, v, self._drawn(0, LOOP_RUNS))
            source = BY_MPC
            errors = Pair(*np.hypot(errors.values(), of_mpc.values()).tolist())
        return LimitsOutcome(seen, allowed, source, NOTHING, self.problem.output_limits is not None, errors)

    def _drawn(self, number: int, runs: int = SETTLING_RUNS) -> tuple[torch.Tensor, torch.Tensor]:
        """Scenarios of the checks, other ones per number."""
        return scenario_tensors(self.problem, fewer_runs(runs, self.problem.steps), self._generator(number))

    def _logged(self, number: int) -> Indices | None:
        """What was logged of each of these scenarios, if they are of a log."""
        return stretches(self.problem, fewer_runs(SETTLING_RUNS, self.problem.steps), self._generator(number))

    def _generator(self, number: int) -> np.random.Generator:
        """Generator of these scenarios."""
        rng = copy.deepcopy(self.scenarios)
        for _ in range(number):
            rng = np.random.default_rng(rng.integers(2**63, size=4))
        return rng

    def _baselines(self, result: CoDesignResult, loop: ClosedLoopReturns) -> list[Baseline]:
        """LQR of the design, MPC beside a policy where its few runs decide, and nested LQR, within limits."""
        found: list[Baseline | None] = [*self._linear(result, loop), *self._constant(result.design, loop)]
        runs = fewer_runs(MPC_RUNS, self.problem.steps)
        if _learned(result.controller) and not too_few(self.problem.risk, np.arange(runs)):
            with suppress(MPCError, InputError):
                if result.design.tobytes() not in self.by_mpc:
                    name, planned = self._mpc(result.design)
                    self.by_mpc[result.design.tobytes()] = name, self._loop(planned, result.design, runs)
                name, other = self.by_mpc[result.design.tobytes()]
                found.append(self._beside(f"{name} of the same design{self._behind}", other, result.design, loop, None))
        if self.designing:
            space = self.problem.design
            starts = [space.settled(v) for v in start_points(space, result.design, result.valleys[:1], 2)]
            others = [one for one in self._references(result) if one.name != result.method]
            found += [self._nested(other, start, loop) for other in others for start in starts]
        return [one for one in found if one is not None]

    def _linear(self, result: CoDesignResult, loop: ClosedLoopReturns) -> Iterator[Baseline]:
        """LQR of the design, but for the controller itself."""
        for name, lqr in self._linear_laws(result.design):
            if not (isinstance(result.controller, LinearFeedback) and np.array_equal(result.controller.K, lqr.K)):
                kept = self._baseline(name, lqr, result.design, loop, None)
                yield from [] if kept is None else [kept]

    def _constant(self, design: Array, loop: ClosedLoopReturns) -> list[Baseline]:
        """Best constant inputs, if they return more.

        The tangent knows of no product of an input with a state.
        """
        if isinstance(self.problem.model, LinearModel):
            return []
        no_gain = np.zeros((self.problem.model.nu, self.problem.model.nx))
        low, high = self.problem.input_bounds_at(design)
        held = (LinearFeedback(no_gain, offset=u) for u in (low, (low + high) / 2, high))
        tried = [
            self._baseline(f"a constant input of the same design{self._behind}", law, design, loop, None)
            for law in held
        ]
        better = [one for one in tried if one is not None and one.gain.mean > 0]
        return sorted(better, key=lambda one: one.gain.mean)[-1:]

    def _mpc(self, design: Array) -> tuple[str, Any]:
        """Name and MPC that a policy is held against.

        It is that of the tangent, or, where LQR is no expert, the one of the model that is better than LQR.
        """
        from ccdtools.co_design.imitation import EXPERTS, best_expert  # loaded where a policy is judged
        from ccdtools.co_design.loops import lqr_is_expert

        if not lqr_is_expert(self.problem, design, copy.deepcopy(self.scenarios)):
            name = best_expert(self.problem, design, copy.deepcopy(self.scenarios))
            if name not in (None, "LQR"):
                return name, EXPERTS[name](self.problem, design)
        return "MPC", linear_mpc(self.problem, design)

    def _linear_laws(self, design: Array) -> Iterator[tuple[str, LinearFeedback]]:
        """LQR of the tangent at rest, if any, and of a better secant."""
        with suppress(MPCError, InputError):
            yield f"LQR of the same design{self._behind}", saturated_lqr(self.problem, design)
        if not isinstance(self.problem.model, LinearModel):
            with suppress(MPCError, InputError):
                secant = fitted(self.problem, design, visited(self.problem, copy.deepcopy(self.scenarios)))
                if secant.better:
                    yield f"LQR of the same design, of its secant{self._behind}", secant.controller

    @property
    def _behind(self) -> str:
        """Where controllers of the state stand, if it is measured."""
        return "" if self.problem.measurement is None else ", behind the filter"

    def _references(self, result: CoDesignResult) -> list[Nested]:
        """Nested co-designs that results are held against.

        One knows that inputs saturate, one the sensors; a policy should do more than one tuned gain.
        """
        inner = ["lqr"]
        if self.problem.measurement is not None:
            inner.append("lqg")
        elif _learned(result.controller):
            inner.append("gain")
        return [Nested(kind, runs=SETTLING_RUNS, starts=1, evaluations=20) for kind in inner]

    def _nested(self, method: Nested, start: Array, loop: ClosedLoopReturns) -> Baseline | None:
        """Result of a short nested co-design from a design."""
        try:
            best = method.run(self.problem, start, copy.deepcopy(self.scenarios))
        except (MPCError, InputError):
            return None
        kept = self._at(method.name, best.controller, best.design, loop, best.limits)
        if kept is None or best.limits is None:
            return kept
        return self._nearer(kept, best.history.design[np.nanargmax(best.history.model_return)], loop, best.limits)

    def _nearer(self, kept: Baseline, beyond: Array, loop: ClosedLoopReturns, limits: LimitsOutcome) -> Baseline:
        """Best LQR within the limits on the way to a design beyond."""
        space = self.problem.design
        begin, end = space.to_unit(kept.design), space.to_unit(beyond)
        near, far = 0.0, 1.0
        for _ in range(4):  # halvings of the way
            share = (near + far) / 2
            design = space.project(space.from_unit(begin + share * (end - begin)))
            other = None
            with suppress(MPCError, InputError):
                other = self._at("LQR", saturated_lqr(self.problem, design), design, loop, limits)
            if other is not None and other.gain.mean > kept.gain.mean:
                kept, near = other, share
            else:
                far = share
        return kept

    def _at(
        self, name: str, controller: Any, design: Array, loop: ClosedLoopReturns, limits: LimitsOutcome | None
    ) -> Baseline | None:  # fmt: skip
        """Baseline of a controller at another design, which it names."""
        place = self.problem.design.describe(design)
        return self._baseline(f"{name}{self._behind}, at {place}", controller, design, loop, limits)

    def _baseline(
        self, name: str, controller: Any, design: Array, loop: ClosedLoopReturns, limits: LimitsOutcome | None
    ) -> Baseline | None:
        """Baseline of a controller at a design."""
        return self._beside(name, self._loop(controller, design), design, loop, limits)

    def _beside(
        self, name: str, other: ClosedLoopReturns, design: Array, loop: ClosedLoopReturns, limits: LimitsOutcome | None
    ) -> Baseline | None:
        """Baseline of a closed loop, None if it loses runs or leaves limits."""
        limits = self._limits(other, design, limits)
        if other.lost.any() or not (limits is None or limits.kept):
            return None
        both = np.arange(min(len(loop.values), len(other.values)))
        gain = difference_of_parts(self.problem.risk, other.parts(both) - loop.parts(both), both)
        return self._in_parts(name, design, gain, loop)

    def _in_parts(self, name: str, design: Array, gain: PairedDifference, loop: ClosedLoopReturns) -> Baseline:
        """Baseline of a gain, relative to the return made by control."""
        size = float(self.problem.made_by_control(loop.summary.mean, design)) or 1.0
        low, high = gain.ci95
        relative = PairedDifference(gain.mean / size, (low / size, high / size))
        return Baseline(name, design, relative, measure(self.problem.risk))

    def _policy_checked(self, result: CoDesignResult, loop: ClosedLoopReturns) -> CoDesignResult:
        """Result of a policy, settled if its gradient and a search confirm it."""
        policy: Any = result.controller
        if isinstance(policy, LearnedPolicy):
            return self.confirmed(result, policy, loop)
        from ccdtools.co_design.output_filter import measured_problem

        of_memory = measured_problem(self.problem, getattr(policy, "length", None))
        return replace(self, problem=of_memory).confirmed(result, policy.controller, loop)

    def confirmed(self, result: CoDesignResult, policy: LearnedPolicy, loop: ClosedLoopReturns) -> CoDesignResult:
        """Result with the status that gradient and search leave its policy."""
        if isinstance(result, LearnedCoDesign) and "pathwise" in result.method.rpartition(", then ")[2]:
            check = gradient_of_policy(self.problem, policy, self._drawn(1, 2 * SETTLING_RUNS))
            result = replace(result, policy_gradients=check)
            wrong = check.astray
            if not wrong and self.problem.jump:
                wrong = f"no gradient of the policy sees that {self.problem.jump}"
            if wrong:
                return replace(result, status=CoDesignStatus.GRADIENT_UNTRUSTED, notes=(*result.notes, wrong))
        found = better_by_search(self.problem, policy, self._drawn(1), self._drawn(2), self._logged(2))
        retuned = self._in_parts("its last layer retuned", result.design, found, loop)
        result = replace(result, baselines=(*result.baselines, retuned))
        if not _better(retuned) and self._may_have_other_optima:
            from ccdtools.co_design.held_inputs import better_by_holding  # loaded where a policy is judged

            ahead = better_by_holding(self.problem, policy, copy.deepcopy(self.scenarios))
            retuned = self._in_parts("other inputs held from the start", result.design, ahead, loop)
            result = replace(result, baselines=(*result.baselines, retuned))
        return replace(result, status=CoDesignStatus.NOT_STATIONARY) if _better(retuned) else result

    @property
    def _may_have_other_optima(self) -> bool:
        """Whether plans are to be tried.

        Of a linear model with quadratic costs MPC, a baseline, has the best ones. Behind sensors they would know the
        state, and errors that were logged or learned are not judged by what a search finds in them.
        """
        problem = self.problem
        plain = isinstance(problem.model, LinearModel) and isinstance(problem.objective, QuadraticObjective)
        logged = hasattr(problem.scenarios, "stretches")
        known = not problem.hidden and not logged and problem.discrepancy is None
        return isinstance(problem.risk, Mean) and known and not plain


def _unless_broken(result: CoDesignResult, loop: ClosedLoopReturns, *, priced: bool) -> CoDesignResult:
    """Result, with another status if its closed loop was lost or left the limits."""
    if loop.lost.any():
        return replace(result, status=CoDesignStatus.DIVERGING)
    if loop.beyond_inputs > LEAST_TOLERANCE:
        cure = f"inputs are asked for up to {loop.beyond_inputs:.3g} half-widths beyond U: clip them to U"
    elif result.limits is None or result.limits.kept:
        return result
    elif priced:
        cure = f"{result.method} prices the limits: a larger budget may keep them"
    else:
        cure = f"{result.method} does not price the limits: Nested('gain'), Nested('mpc') and learning do"
    return replace(result, status=CoDesignStatus.LIMITS_BROKEN, notes=(*result.notes, cure))


def _learned(controller: Any) -> bool:
    """Whether a controller is a policy, or one of outputs has it behind a memory."""
    policy = controller.controller if "output" in getattr(controller, "needs", ()) else controller
    return isinstance(policy, LearnedPolicy)


def _better(baseline: Baseline) -> bool:
    """True if a baseline gains more than the allowed loss, beyond chance if known."""
    return baseline.gain.mean > NOT_WORSE and not baseline.gain.ci95[0] <= 0
