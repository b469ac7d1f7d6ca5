"""Result of a co-design: design, controller, status, worth and history."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np

from ccdtools.arrays import Array, ArrayField, Immutable, Indices, jsonable
from ccdtools.co_design.tolerances import FEW_RUNS_DECIDE
from ccdtools_ground.door import as_vector
from ccdtools_ground.outcome import Outcome

if TYPE_CHECKING:
    from ccdtools.co_design.closed_loop import ClosedLoopReturns
    from ccdtools.co_design.limits import LimitsOutcome
    from ccdtools.controllers.controllers import Controller
    from ccdtools.statistics import PairedDifference

HistoryRow = tuple[int, int, Array, float, float, float]


class CoDesignStatus(Outcome):
    """Status of a co-design."""

    CONVERGED = "converged", "Nothing to do: more effort gained nothing that matters, and the design is level."
    AT_BOUND = (  # of the box, or an active constraint
        "converged, with the design at a bound",
        "Widen the named bounds, or relax the named constraints, if the plant allows it: the return still rises across "
        "them.",
    )
    EDGE_OF_TRUST = (
        "converged, with the design at the edge of the trust region",
        "Deploy it, and let another generation follow: where the prediction holds, the next redesign may go further.",
    )
    STILL_IMPROVING = (
        "still improving", "Raise CoDesignConfig.iterations: the last of them still gained significantly."
    )  # fmt: skip
    BUDGET_SPENT = (
        "budget spent before the design settled",
        "Raise the budget (CoDesignConfig.iterations of learning, Simultaneous.iterations, evaluations or starts of "
        "other methods): the return still rises along the design, or it was not seen that it does not.",
    )
    GRADIENT_UNTRUSTED = (
        "gradient untrusted",
        "Check that model and objective are differentiable, or raise the number of runs: the gradient through the "
        'model is not that of the return. Where the plant jumps or the policy saturates, take "ppo" or "search".',
    )
    DIVERGING = "runs diverge", "Check x0 and U: with this design and policy some runs cannot be recovered."
    LIMITS_BROKEN = "limits broken", "Raise the tolerance of the limits, or do what the note on them says."
    WORSE_THAN_BASELINE = (
        "worse than a baseline",
        "Deploy the named baseline, or start again from it: it is better on the same scenarios and keeps the limits.",
    )
    NOT_STATIONARY = (
        "not at an optimum of the policy",
        "Start again from another policy or with more iterations: a plain search over its last layer, or other inputs "
        "held from the start, are better.",
    )
    UNFORESEEN = (
        "worse in closed loop than the method foresaw",
        "The closed loop brings far less than the method's own objective: what was optimised is not what happens. Look "
        "for a design in closed loop (nested, search, learning), on more runs where a few cost far more than the rest.",
    )
    INFEASIBLE = (
        "no trajectory within the limits",
        'Widen X, take fewer runs, or set limit_tolerance="off": no inputs keep the named limits in all scenarios.',
    )

    @property
    def settled(self) -> bool:
        """Whether more effort is expected to gain nothing, see `Settling`."""
        return self in (CoDesignStatus.CONVERGED, CoDesignStatus.AT_BOUND, CoDesignStatus.EDGE_OF_TRUST)


@dataclass(frozen=True, eq=False, repr=False)
class History(Immutable):
    """Course of a co-design, one row per evaluation.

    Attributes
    ----------
    iteration, env_steps : (k,) arrays
    design : (k, np) array
    model_return, std, diverged : (k,) arrays
        Of the mean policy on the evaluation scenarios; mean over the runs that did not diverge.
    """

    iteration: Indices
    env_steps: Indices
    design: Array
    model_return: Array
    std: Array
    diverged: Array

    @classmethod
    def of(cls, rows: Sequence[HistoryRow]) -> History:
        """History of rows in the order of the attributes."""
        return cls(*(np.array(column) for column in zip(*rows)))

    def __repr__(self) -> str:
        first = self.model_return[0]
        last = self.model_return[-1]
        return f"History({len(self.iteration)} evaluations, return {first:.4g} → {last:.4g})"


@dataclass(frozen=True, eq=False, repr=False)
class Valley(Immutable):
    """Local optimum of J(p) by saturated LQR, with its co-design's end.

    Attributes
    ----------
    design : (np,) array
    lqr_return : float
        Of saturated LQR there, on the scenarios of the landscape.
    found : (np,) array or None
        Where the co-design from here ended, or the one from the given design if it lies on this hill: the better one of
        both. None where none was begun.
    found_return : float
        Its return on the evaluation scenarios; NaN where none was begun.
    given : bool
        Whether the given design lies on this hill of the landscape.
    """

    design: ArrayField
    lqr_return: float
    found: ArrayField = None
    found_return: float = float("nan")
    given: bool = False

    def __post_init__(self) -> None:
        self._set(design=as_vector("design", self.design))
        if self.found is not None:
            self._set(found=as_vector("found", self.found))

    def __repr__(self) -> str:
        ended = "" if self.found is None else f", co-design {self.found_return:.5g} at {_short(self.found)}"
        given = ", of the given design" if self.given else ""
        return f"Valley({_short(self.design)}{given}, LQR {self.lqr_return:.5g}{ended})"


@dataclass(frozen=True, eq=False, repr=False)
class Baseline(Immutable):
    """Baseline that a result is compared with before it is called settled.

    Attributes
    ----------
    name : str
    design : (np,) array
    gain : PairedDifference
        Of the baseline over the result on common scenarios, in parts of the return that control makes.
    measure : str
        What of the returns it is a gain in: "mean", or the problem's risk in words.
    """

    name: str
    design: ArrayField
    gain: PairedDifference
    measure: str = "mean"

    def __post_init__(self) -> None:
        self._set(design=as_vector("design", self.design))

    def __repr__(self) -> str:
        low, high = self.gain.ci95
        ends = f" [{100 * low:+.2f}, {100 * high:+.2f}]" if np.isfinite([low, high]).all() else ""
        return f"{self.name}: {100 * self.gain.mean:+.2f} %{ends} of what control costs" + (
            "" if self.measure == "mean" else f", in the {self.measure}")  # fmt: skip


@dataclass(frozen=True, eq=False, repr=False, kw_only=True)
class CoDesignResult(Immutable):
    """Design and controller that a method found.

    Attributes
    ----------
    design : (np,) array
    controller : callable
        States (nx,) or (n, nx) to inputs.
    method : str
    status : CoDesignStatus
    closed_loop : ClosedLoopReturns or None
        On fresh scenarios of the problem, the same for every method that is given the same seed.
    objective : float
        What the method itself brought to its largest, as a return; NaN where the limits were not kept.
    criterion : str
        What that is, in words.
    active_bounds : dict
        Design parameters at a bound, with "lower" or "upper".
    active_constraints : dict
        Values of the constraints on the design that hold it, by name.
    multipliers : dict
        By how much the objective would rise per unit of an active bound or constraint, by name.
    slope : float
        What is left of the objective's slope along the directions that bounds and constraints leave: relative to the
        part of the return that control makes, per length of the unit box. NaN where a method knows no slope.
    evaluations : int
        Of the criterion: closed loops on all its scenarios, trajectories, iterations of a program.
    seconds : float
    history : History
        Of the start that won.
    limits : LimitsOutcome or None
        How often and how far X is left, beside the tolerance; None where the limits were switched off.
    baselines : tuple of Baseline
        What it was compared with before it was called settled. LQR alone where the method of a policy did not settle.
    valleys : tuple of Valley
        The local optima of the landscape, best first; empty where it was not looked at.
    described : str
        The design in words, with names and units.
    notes : tuple of str
        What else is to be known of how it ended: limits that no inputs keep, what was never looked at, entries of the
        design that act only together.
    """

    design: Array
    controller: Controller | None = None
    method: str = "pathwise"
    status: CoDesignStatus = CoDesignStatus.BUDGET_SPENT
    closed_loop: ClosedLoopReturns | None = None
    objective: float = float("nan")
    criterion: str = ""
    active_bounds: dict[str, str] = field(default_factory=dict)
    active_constraints: dict[str, float] = field(default_factory=dict)
    multipliers: dict[str, float] = field(default_factory=dict)
    slope: float = float("nan")
    evaluations: int = 0
    seconds: float = float("nan")
    history: History = None  # type: ignore[assignment]  # by default one row, of the design and its objective
    limits: LimitsOutcome | None = None
    baselines: tuple[Baseline, ...] = ()
    valleys: tuple[Valley, ...] = ()
    described: str = ""
    notes: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.history is None:
            self._set(history=History.of([(1, 1, self.design, self.objective, 0.0, 0.0)]))

    def __repr__(self) -> str:
        bounds = ", ".join(f"{name} at its {side} bound" for name, side in self.active_bounds.items()) or "none"
        if self.active_constraints:
            bounds += f", active constraints: {', '.join(self.active_constraints)}"
        found = f"design {_short(self.design)}, {self.status.value}, active bounds: {bounds}"
        loop = "" if self.closed_loop is None else f", return {self.closed_loop.summary.mean:.5g}"
        return f"{type(self).__name__}({self.method}: {found}{loop}, {self.history!r})"

    @property
    def best_known_design(self) -> Array:
        """Design (np,) of the baseline that is ahead of the result, or its own."""
        if self.status is not CoDesignStatus.WORSE_THAN_BASELINE:
            return self.design
        return np.asarray(max(self.baselines, key=lambda one: one.gain.mean).design)

    def as_dict(self) -> dict[str, Any]:
        """Plain values for a file; JSON has null if not finite."""
        plain: dict[str, Any] = jsonable(self._values())
        return plain

    def _values(self) -> dict[str, Any]:
        """Status as plain values."""
        return {
            "status": self.status.name, "meaning": self.status.value, "advice": self.status.advice,
            "method": self.method, "valleys": [asdict(valley) for valley in self.valleys],
            "baselines": [asdict(baseline) for baseline in self.baselines],
            "active_constraints": dict(self.active_constraints), "multipliers": dict(self.multipliers),
            "criterion": self.criterion, "objective": self.objective, "evaluations": self.evaluations,
            "notes": self.notes,
        }  # fmt: skip

    def describe(self) -> list[str]:
        """Status, active constraints and other local optima, one line each."""
        lines = ([f"design: {self.described}"] if self.described else []) + self._ended()
        if self.active_constraints:
            values = (f"{name} = {value:.3g}" for name, value in self.active_constraints.items())
            lines.append(f"active constraints, each to be ≤ 0: {', '.join(values)}")
        lines += self._remarks()
        if len(self.valleys) > 1:
            lines += [f"local optimum: {valley!r}" for valley in self.valleys]
        return lines

    def _ended(self) -> list[str]:
        """Status and reason, one line each."""
        lines = [f"{self.method}: {self.status.value} after {self.evaluations} evaluations. {self.status.advice}"]
        if self.criterion and np.isfinite(self.objective):
            lines.append(f"{self.criterion}: {self.objective:.6g}")
        lines += self._of_loop()
        if self.multipliers:
            prices = (f"{name} {value:.3g}" for name, value in self.multipliers.items())
            lines.append(f"gain per unit of what holds the design: {', '.join(prices)}")
        return lines

    def _of_loop(self) -> list[str]:
        """Returns in closed loop, one line each."""
        if self.closed_loop is None:
            return []
        summary = self.closed_loop.summary
        told = f"in closed loop: {self.closed_loop}"
        if self.closed_loop.outside > 0 and (self.limits is None or not self.limits.kept):
            loop = self.closed_loop
            told += f"; {loop.outside:.2%} of the states outside the limits, {loop.depth:.2g} half-widths deep"
        few = "a few runs cost far more than the rest: they are nearly lost, and the interval says little"
        return [told, few] if summary.std > FEW_RUNS_DECIDE * abs(summary.mean) else [told]

    def _remarks(self) -> list[str]:
        """Other remarks, one line each."""
        return [*self.notes, *(f"beside it, {one!r}" for one in self.baselines)]


def _short(design: Array) -> str:
    """Design in few digits."""
    return "[" + ", ".join(f"{value:.5g}" for value in design) + "]"
