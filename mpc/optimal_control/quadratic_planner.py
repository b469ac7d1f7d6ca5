"""Plans by quadratic programs near an optimum, by an interior-point solver far from it."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property, partial
from itertools import chain, islice
from typing import Any

import numpy as np

from mpc.checks import Array
from mpc.exceptions import NotStabilisableError
from mpc.halfspaces import box_of
from mpc.optimal_control.condensing import gains_along
from mpc.optimal_control.discrete_model import DiscreteModel
from mpc.optimal_control.loop_planner import LoopPlanner
from mpc.optimal_control.paths import CONVERGING, REAL_TIME, Path, contracted, programs
from mpc.optimal_control.planning import SHIFTED, Clock, aside, beginnings, shifted, told_of_inputs, until_most_agree
from mpc.optimal_control.quadratic_phase import quadratic_columns, quadratic_parameters
from mpc.optimal_control.quadratic_stages import QuadraticStages, rounding_of_cost, weights_along
from mpc.optimal_control.sqp import carried
from mpc.optimal_control.step_program import TINY
from mpc.plan import Plan, Residuals, Status
from mpc.problem import MPCProblem
from mpc.rollout import (
    Given,
    admissible,
    cost_of,
    disturbance,
    finite,
    for_each_state,
    references,
    relative_violations,
    spread_signals,
    violation_of,
)
from mpc.tolerances import COST_ROUNDING, FEASIBLE, NEGLIGIBLE, OPTIMAL, VIOLATION_PRICE

LINEAR_LAW, INTERIOR = "linear law", "Ipopt"
OPTIMA = (Status.SOLVED, Status.SOFTENED)


@dataclass(frozen=True, eq=False)
class _Sample:
    """Statement of one sample: state, signals, first path, price of what cannot be kept."""

    x: Array
    given: Given
    first: Path
    cost: float  # of the first path
    size: float  # of the cost
    dear: float
    clock: Clock

    @property
    def far(self) -> bool:
        """Whether the first path costs more than what cannot be kept."""
        return not self.cost <= self.dear


@dataclass(frozen=True, eq=False)
class QuadraticPlanner:
    """Plans for one set of parameters p (np,).

    A sample takes so many `iterations`, quadratic programs, or where that is None as many as it needs. A first one
    begins at so many `starts`. No program is begun that would probably end later than `time_limit` [s].
    """

    law: MPCProblem
    model: DiscreteModel
    p: Array
    iterations: int | None
    most: int
    starts: int
    time_limit: float

    def __post_init__(self) -> None:
        general = self._general((1.0, 1.0))
        _ = self.stages, self._gains, general.built(general.to_begin)  # and compiled, before a clock runs
        states, inputs, w = (np.zeros((self.law.horizon, self.model.step.numel_in(i))) for i in range(3))
        self.model.curvature(states, inputs, w, self.p, states)

    def _general(self, prices: tuple[float, float]) -> LoopPlanner:
        """Planner of the same statement as a phase."""
        loop = self.model.loop(self.law, self.p)
        assert loop.sizes is not None  # it has been given them
        p = quadratic_parameters(self.law, self.p, prices, loop.sizes[: self.law.nx])
        return LoopPlanner(loop, p, self.most, 1, self.time_limit)

    @cached_property
    def stages(self) -> QuadraticStages:
        """Statement along plans."""
        return QuadraticStages(self.law, self.model, self.p)

    @cached_property
    def _gains(self) -> Array:
        """Gains (N, nu, nx) of the linear law along a plan."""
        return np.tile(gain_at_rest(self.law), (self.law.horizon, 1, 1))

    @cached_property
    def _limits(self) -> tuple[Array, Array, Array] | None:
        """Least and largest input and its largest change, if U is a box."""
        box = box_of(*self.law.input_rows)
        rate = np.full(self.law.nu, np.inf) if self.law.rate_limit is None else self.law.rate_limit
        return None if box is None else (*box, rate)

    def signals(self, stated: dict[str, Any]) -> Given:
        """Signals of a sample, checked."""
        return spread_signals(self.law, stated)

    def each(self, stated: dict[str, Any], n: int) -> list[Given]:
        """Signals of n states, common or one entry for each."""
        return for_each_state(self.law, stated, n)

    def plan(self, x: Array, given: Given, before: Plan | None) -> Plan:
        """Plan from a state, begun at another or where it is best."""
        clock = Clock(self.time_limit)
        with np.errstate(over="ignore", invalid="ignore"):
            if before is None:
                first = self._linear_law(x, given)
                most = self._cost_to_stay(self._held(first, given), given)
            else:
                own = carried(before, self.stages.rows)
                first = Path(before.states, before.inputs, self._gains, SHIFTED, multipliers=own)
                most = np.inf
            cost = cost_of(self.law, first.inputs, first.states, given)
            size = max(min(cost, most), TINY)
            sample = _Sample(x, given, first, cost, size, VIOLATION_PRICE * size, clock)
            found = clock.stamped(self._found(sample))
            if found.status not in (Status.FOLLOWED, *OPTIMA):
                best = self._best(sample, found)
                found = replace(best, status=Status.LATE) if found.status is Status.LATE else best
        if self._limits is not None:
            found = told_of_inputs(found, self._limits[:2], self.law.rate_limit, given)
        return clock.stamped(found)

    def shifted(self, plan: Plan, given: Given) -> Plan:
        """Plan one sample later, with the linear law's last input."""
        end, (x_ref, u_ref) = plan.states[-1], references(self.law, given)
        with np.errstate(over="ignore", invalid="ignore"):  # of a model that escaped
            wanted = finite(u_ref[-1] - self._gains[-1] @ (end - x_ref[-1]))
        u = self._admissible(wanted, plan.inputs[-1])
        later = self.stages.rows.later
        return shifted(plan, u, finite(self.model.next(end, u, disturbance(self.law, given)[-1], self.p)), later)

    def _found(self, sample: _Sample) -> Plan:
        """Plan that programs lead to."""
        first, follow = sample.first, sample.first.name == SHIFTED
        if follow and self.iterations is not None:
            programs = self._programs(sample, replace(first, name=REAL_TIME, multipliers=None))
            done = list(islice(programs, self.iterations))
            cut_short = Status.LATE if sample.clock.stopped else Status.INACCURATE
            status = Status.FOLLOWED if len(done) == self.iterations else cut_short
            found = self._plan(sample, done[-1].moved, status) if done else None
            at_saddle = done and done[-1].solved and done[-1].falls
            if found and (found.status is Status.LATE or (not at_saddle and self._followable(sample, found))):
                return found
        at = replace(first, name=CONVERGING, last=None)
        if not sample.far:
            at = self._contracted(sample, at)
        if sample.clock.up:
            return self._plan(sample, first if at.last is None else at, Status.LATE)
        stayed = at.inputs is first.inputs
        saddle, at = at, self._past_saddles(sample, at)
        linear_law = self._linear_law(sample.x, sample.given)
        enough = at is saddle and (not self._cheaper(sample, linear_law, at) if follow else stayed)
        if at.solved and enough:
            return self._plan(sample, at)
        plans = [] if at.last is None else [self._plan(sample, at)]
        # a first path is the linear law's, which Ipopt need not solve again
        known = list(plans) if not follow and at.solved and at.last and at.last.strict else []
        tried = (self._plan(sample, one) for one in self._from_starts(sample, bool(known)) if one.last is not None)
        plans += until_most_agree(chain(known, tried), self.starts)
        best = min(plans, key=lambda plan: (plan.status not in OPTIMA, self._total(plan, sample.given, sample.dear)),
                   default=None)  # fmt: skip
        found = self._plan(sample, first, Status.REPLACED) if best is None else best
        return replace(found, status=Status.LATE) if sample.clock.stopped and found.status not in OPTIMA else found

    def _followable(self, sample: _Sample, found: Plan) -> bool:
        """Whether a real-time iteration may be followed, elsewhere the sample goes to the optimum."""
        if found.status is Status.SOFTENED or not np.isfinite(found.cost):
            return False
        # one that is no dearer than the plan before will do (Scokaert, Mayne and Rawlings, 1999)
        does = self._total(found, sample.given, sample.dear) <= sample.cost
        return does or self._best(sample, found) is found

    def _plan(self, sample: _Sample, at: Path, otherwise: Status = Status.INACCURATE) -> Plan:
        """Plan that follows a path, SOLVED or SOFTENED where the optimality conditions hold."""
        path = self._followed(sample.x, at, sample.given)
        cost, violation = cost_of(self.law, path.inputs, path.states, sample.given), violation_of(self.law, path.states)
        optimum = at.solved and not at.falls and self._kept(path, at, cost, sample.given)
        status = Status.SOLVED if optimum else otherwise
        residuals = Residuals(np.inf, np.inf, np.inf, np.inf)
        if at.last is not None:
            residuals = Residuals(at.last.stationarity, at.last.defects, 0.0, 0.0)
            softened = at.last.relaxed and status in (Status.SOLVED, Status.FOLLOWED)
            if softened and relative_violations(self.law, path.states).max() > FEASIBLE:
                status = Status.SOFTENED
        found = Plan(path.inputs, path.states, cost, status, residuals, violation, 0.0, path.name)
        on = at.balanced
        if on is None or at.last is None:
            return found
        hessian = at.last.hessian if status is Status.SOLVED else None
        return replace(found, costates=on.costates, pushes=on.pushes, hessian=hessian)

    def _kept(self, path: Path, at: Path, cost: float, given: Given) -> bool:
        """Whether the model itself goes along a path, or costs as much where it does not."""
        sizes = self.stages.sizes
        apart = ((path.states - at.states) / sizes[0], (path.inputs - at.inputs) / sizes[1])
        if max(float(np.abs(part).max()) for part in apart) <= OPTIMAL:
            return True
        return abs(cost_of(self.law, at.inputs, at.states, given) - cost) <= OPTIMAL * abs(cost)

    def _contracted(self, sample: _Sample, at: Path) -> Path:
        """Best path by programs from another."""
        first = replace(at, last=None)
        return contracted(self._programs(sample, first), self.most) or first

    def _past_saddles(self, sample: _Sample, at: Path) -> Path:
        """Itself, or where programs lead from what costs less than a saddle."""
        while at.solved and at.falls:
            aside = self._off(sample, at)
            further = at if aside is None else self._contracted(sample, aside)
            shot = None if further.solved or sample.clock.up else self._by_ipopt(sample, further)
            further = shot if shot and self._cheaper(sample, shot, further) else further
            if not self._cheaper(sample, further, at):
                break
            at = further
        return at

    def _off(self, sample: _Sample, at: Path) -> Path | None:
        """Path that costs less than a saddle, along what falls there."""
        states, inputs = at.falling
        for size in np.geomspace(1.0, NEGLIGIBLE**2, 41):
            for along in (size, -size):
                moved = replace(at, states=at.states + along * states, inputs=at.inputs + along * inputs)
                path = self._followed(sample.x, moved, sample.given)
                if self._cheaper(sample, path, at):
                    return path
        return None

    def _programs(self, sample: _Sample, at: Path) -> Iterator[Path]:
        """Paths of a sample, each moved by the program at the one before."""
        stated = partial(self.stages.at, sample.x, given=sample.given)
        return programs(at, stated, sample.clock, dear=sample.dear)

    def _by_ipopt(self, sample: _Sample, path: Path) -> Path | None:
        """Best path by programs from where Ipopt comes to."""
        general = self._general(self.law.soft or (sample.dear, sample.dear))
        more = quadratic_columns(self.law, sample.x, path.states, self._aside(path).inputs, sample.given)
        found = general.near(*more, sample.size, sample.clock)
        if found is None:
            return None
        states, inputs = found[0][:, : self.law.nx].copy(), found[1][:, : self.law.nu].copy()
        return self._contracted(sample, replace(path, states=states, inputs=inputs, name=INTERIOR))

    def _from_starts(self, sample: _Sample, known: bool) -> Iterator[Path]:
        """Paths that Ipopt comes to from starts; one where a plan leads to it."""
        for path in self._starting_paths(sample, known):
            near = None if sample.clock.up else self._by_ipopt(sample, path)
            if near is None:
                continue
            at = self._past_saddles(sample, near)
            yield at
            if path.name == SHIFTED and at.last and at.solved and not at.last.relaxed:
                return

    def _starting_paths(self, sample: _Sample, known: bool) -> Iterator[Path]:
        """Plan to follow, law unless known, straight way, state held, inputs by chance.

        A law that leads far away, from where Ipopt takes long, comes after the others.
        """
        law = sample.first
        if law.name == SHIFTED:
            yield law
            law = self._linear_law(sample.x, sample.given)
        held, size, rng = self._held(law, sample.given), self.stages.sizes[1], np.random.default_rng(0)
        end, _ = references(self.law, sample.given)
        free = replace(held, gains=None)

        def led_to(moves: Array) -> tuple[Array, Array]:
            """Admissible inputs by chance about the reference, and their states."""
            path = self._followed(sample.x, replace(free, inputs=held.inputs + moves), sample.given)
            return path.states, path.inputs

        others = beginnings((held.states, held.inputs), sample.x, end, led_to, rng, (-size, size))
        first, straight = islice(others, 2)
        begun = islice(chain((straight, first), others), self.starts - 1)
        paths = [replace(held, states=states, inputs=inputs) for states, inputs in begun]
        at = 2 if sample.far else 0
        paths[at:at] = [] if known else [law]
        yield from paths

    def _aside(self, path: Path) -> Path:
        """Path with inputs that break its symmetries."""
        return replace(path, inputs=aside(path.inputs, self.stages.sizes[1]))

    def _cheaper(self, sample: _Sample, other: Path, at: Path) -> bool:
        """Whether another path costs less, by more than rounding."""
        less, own = (self._total(one, sample.given, sample.dear) for one in (other, at))
        return less < own - COST_ROUNDING * abs(own) - rounding_of_cost(self.law, sample.given)

    def _total(self, path: Path | Plan, given: Given, price: float) -> float:
        """Cost with violations of hard limits at a price; infinite where it is no number."""
        total = path.cost if isinstance(path, Plan) else cost_of(self.law, path.inputs, path.states, given)
        if self.law.soft is None:
            over = relative_violations(self.law, path.states, self.law.price_units)
            total += price * float(over[over > FEASIBLE].sum())
        return total if np.isfinite(total) else np.inf

    def _linear_law(self, x: Array, given: Given) -> Path:
        """Path of the model under the linear law."""
        return self._followed(x, Path(*references(self.law, given), self._gains, LINEAR_LAW), given)

    def _held(self, path: Path, given: Given) -> Path:
        """Path that stays where another begins, inputs at their reference."""
        _, inputs = references(self.law, given)
        return replace(path, states=np.tile(path.states[0], (len(path.states), 1)), inputs=inputs)

    def _cost_to_stay(self, held: Path, given: Given) -> float:
        """Cost of staying, and of the drift in each sample."""
        after, _, _ = self.model.linearised(held.states[:-1], held.inputs, disturbance(self.law, given), self.p)
        drift = finite(after) - held.states[1:]
        staying = np.sum(drift @ (self.law.Q + self.law.P) * drift)
        return cost_of(self.law, held.inputs, held.states, given) + float(staying)

    def _followed(self, x: Array, path: Path, given: Given) -> Path:
        """Path on the model itself from x, within input limits; finite."""
        N = self.law.horizon
        last = given.get("u_prev", np.zeros(self.law.nu))
        w = disturbance(self.law, given)
        gains = np.zeros_like(self._gains) if path.gains is None else path.gains
        if self._limits is not None:
            states, inputs = self.model.followed(x, last, path.states, path.inputs, gains, self._limits, w, self.p)
        else:
            states, inputs = np.empty((N + 1, self.law.nx)), np.empty((N, self.law.nu))
            states[0] = x
            for k in range(N):
                wanted = path.inputs[k] - gains[k] @ (states[k] - path.states[k])
                inputs[k] = self._admissible(wanted, inputs[k - 1] if k else last)
                states[k + 1] = finite(self.model.next(states[k], inputs[k], w[k], self.p))
        return replace(path, states=finite(states), inputs=finite(inputs))

    def _admissible(self, wanted: Array, last: Array) -> Array:
        """Admissible input nearest to `wanted`, after `last`."""
        if self._limits is None:
            return np.asarray(admissible(self.law, wanted[None], {"u_prev": last})[0])
        low, high, rate = self._limits
        return np.clip(np.clip(wanted, low, high), last - rate, last + rate)

    def _best(self, sample: _Sample, found: Plan) -> Plan:
        """Cheapest of found plan, start and linear law.

        A real-time iteration is replaced only by one that costs far less: it may pay now for what comes.
        """
        first, given = sample.first, sample.given
        plans = [found, self._plan(sample, first, Status.REPLACED)]
        if found.solver != REAL_TIME:  # far from rest the gains at rest may do harm
            plans.append(self._plan(sample, replace(first, gains=None), Status.REPLACED))
        if first.name != LINEAR_LAW:
            plans.append(self._plan(sample, self._linear_law(sample.x, given), Status.REPLACED))
        price = VIOLATION_PRICE * max((plan.cost for plan in plans[1:] if np.isfinite(plan.cost)), default=1.0)
        total = [self._total(plan, given, price) for plan in plans]
        total[0] /= 2.0 if found.solver == REAL_TIME else 1.0
        return plans[int(np.argmin(total))]


def gain_at_rest(law: MPCProblem) -> Array:
    """Gain (nu, nx) of the regulator, else of the horizon's first step.

    Vehicles that cannot move sideways are such: at rest their linearisation cannot be stabilised.
    """
    try:
        return law.gain
    except NotStabilisableError:
        A, B = (np.tile(matrix, (law.horizon, 1, 1)) for matrix in (law.A, law.B))
        gains, *_ = gains_along(A, B, weights_along(law.horizon, law.Q, law.R, law.cross, law.P))
        return np.asarray(gains[0])
