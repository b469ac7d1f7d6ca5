"""Every controller on the same disturbances and initial states."""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from ccdtools.arrays import Array
from ccdtools.co_design.objective import Objective, as_objective
from ccdtools.co_design.risk import Risk, as_risk, measure
from ccdtools.co_design.risk_intervals import summarise_in_risk
from ccdtools.comparison.budgets import TIMED_CALLS
from ccdtools.comparison.c_step_time import NONE, c_step_time
from ccdtools.comparison.metrics import Metrics, as_metrics, metrics_of
from ccdtools.comparison.pid_tuning import REFERENCE
from ccdtools.controllers.controllers import Controller
from ccdtools.controllers.filtered import Filtered
from ccdtools.controllers.observed import Observed
from ccdtools.controllers.signals import Driver, needs_of
from ccdtools.design_limits import Limits, set_at
from ccdtools.evidence.percent import nothing_done
from ccdtools.exceptions import InputError
from ccdtools.limits import Excursions, divergence_limit, further_outside, limits_in_words
from ccdtools.output_limits import OutputLimits
from ccdtools.pages import paragraphs
from ccdtools.progress import at
from ccdtools.scenario import Scenario
from ccdtools.statistics import PairedDifference, Summary, paired_returns, summarise_returns
from ccdtools.table import Table
from ccdtools.tolerances import SAME_RETURN
from ccdtools.trajectory import Trajectory
from ccdtools_ground.door import as_choice, as_count, as_flag, as_instance, as_mapping


@dataclass(frozen=True)
class Score:
    """One controller on one scenario.

    Attributes
    ----------
    controller : str
    summary : Summary
        Of the returns of the runs that did not diverge. Of a single long run `mean` is its return and `n` is 1; `std`,
        from run to run, and `ci95` come from its own autocorrelation, see `ccdtools.statistics.mean_interval`.
    paired_to_lqr : PairedDifference
        To the baseline, LQR by default, on the runs that both saw and where neither diverged.
    lqr_mean : float
        Mean return of the baseline on those same runs.
    diverged : float
        Fraction of runs.
    violations : float
        Fraction of the states outside X, or of the samples outside the limits where those of inputs or outputs count.
    depth_mean, depth_peak, depth_worst : float
        How far outside, in half-widths (`ccdtools.depth_outside`): averaged over all samples, the mean over the runs of
        the peak of each, and the largest of all; of the runs that did not diverge.
    exceeded : str
        The limit that is exceeded most; empty if none is.
    further_outside_than : tuple of str
        Controllers that leave the limits less deep, or less often, on the runs that both saw; see `further_outside`.
    step_time : float
        Median time of one call with one state [s], over the first states of the first run.
    c_step_time, c_step_time_99 : float
        Median and 99th percentile of calls of its exported C code [s], if asked for; NaN where there is none.
    metrics : dict of str to float
        What the metrics asked for say of the runs that did not diverge; NaN where all did.
    design_cost : float
        What every return holds for the design: the same for all controllers.
    in_risk : Summary or None
        The risk asked for, of the runs that did not diverge, with its interval; None where none was.
    runs : int
        That it was tried on.
    remark : str
        Why it is not to be compared with, such as a PID whose tuning found no gains; empty of most.
    """

    controller: str
    summary: Summary
    paired_to_lqr: PairedDifference
    lqr_mean: float
    diverged: float
    violations: float
    depth_mean: float
    depth_peak: float
    depth_worst: float
    exceeded: str
    further_outside_than: tuple[str, ...]
    step_time: float
    metrics: dict[str, float] = field(default_factory=dict)
    design_cost: float = 0.0
    in_risk: Summary | None = None
    runs: int = 0
    remark: str = ""
    c_step_time: float = float("nan")
    c_step_time_99: float = float("nan")


@dataclass(frozen=True, eq=False, repr=False)
class Comparison:
    """Scores of all controllers on one scenario, one row each.

    It is iterated like a list of scores, and indexed by number or by the name of a controller. `limits` says what
    violations are of: "X", or "the limits" where others count, too; `baseline` is the controller that the
    others are paired to; `compiled`, whether times are printed, of exported C too.
    """

    scores: tuple[Score, ...]
    limits: str = "X"
    baseline: str = REFERENCE
    compiled: bool = False

    @property
    def notes(self) -> list[str]:
        """Remarks, one line each, on fewer runs, lost runs and risks."""
        most = max(score.runs for score in self.scores)
        lines = ["µs a step: median; in C: median, 99th percentile of the exported code."] * self.compiled
        lines += [
            f"* {one.controller}: {_shown(one.summary.mean, '.5g')} on the first {one.runs} of {most} runs, where "
            f"{self.baseline} has {_shown(one.lqr_mean, '.5g')}" for one in self.scores if one.runs < most
        ]  # fmt: skip
        if any(one.diverged > 0 for one in self.scores):
            lines.append("Returns are of the runs that did not diverge.")
        few = [f"{s.controller}, risk: {s.in_risk.warning}" for s in self.scores if s.in_risk and s.in_risk.warning]
        return lines + few + [f"{one.controller}: {one.remark}" for one in self.scores if one.remark]

    def __iter__(self) -> Iterator[Score]:
        return iter(self.scores)

    def __len__(self) -> int:
        return len(self.scores)

    def __getitem__(self, key: int | str) -> Score:
        if isinstance(key, int):
            return self.scores[key]
        for score in self.scores:
            if score.controller == key:
                return score
        raise KeyError(f"{key!r}; the controllers are {', '.join(score.controller for score in self.scores)}")

    def rows(self) -> list[dict[str, Any]]:
        """One dictionary of plain values per controller."""
        base = "lqr" if self.baseline == REFERENCE else "baseline"
        return [
            {
                "controller": score.controller, "mean": score.summary.mean, "std": score.summary.std,
                "median": score.summary.median, "n": score.summary.n, "ci95_low": score.summary.ci95[0],
                "ci95_high": score.summary.ci95[1], f"minus_{base}": score.paired_to_lqr.mean,
                f"minus_{base}_low": score.paired_to_lqr.ci95[0], f"minus_{base}_high": score.paired_to_lqr.ci95[1],
                f"{base}_mean": score.lqr_mean, "diverged": score.diverged,
                "violations": score.violations, "depth_mean": score.depth_mean, "depth_peak": score.depth_peak,
                "depth_worst": score.depth_worst, "exceeded": score.exceeded,
                "further_outside_than": ", ".join(score.further_outside_than), "step_time_us": 1e6 * score.step_time,
                "c_step_time_us": 1e6 * score.c_step_time, "c_step_time_99_us": 1e6 * score.c_step_time_99,
                "runs": score.runs, "remark": score.remark, **score.metrics,
            }
            for score in self.scores
        ]  # fmt: skip

    def to_frame(self) -> Any:
        """Rows as a `pandas.DataFrame`. Without pandas, a dictionary of columns."""
        rows = self.rows()
        columns = {name: [row[name] for row in rows] for name in rows[0]}
        try:
            import pandas as pd
        except ImportError:
            return columns
        return pd.DataFrame(columns)

    def plot(self, ax: Any = None) -> Any:
        """Plot the mean returns with 95 % intervals and return the axes."""
        from ccdtools.comparison.plotting import plot_scores

        return plot_scores(self, ax=ax)

    @property
    def _table(self) -> Table:
        """Printed table, without the means of fewer runs."""
        head = ("controller", "return", "std", "n", f"minus {self.baseline}", "95 % interval", "diverged",
                f"outside {self.limits}", "depth", *("µs a step", "in C") * self.compiled)  # fmt: skip
        most = max(score.runs for score in self.scores)
        rows = [_text_cells(score, self, whole=score.runs == most) for score in self.scores]
        return Table(head, rows, right=frozenset(range(1, len(head))) - {5})

    def __repr__(self) -> str:
        return "\n".join([str(self._table), *self.notes])

    def _repr_html_(self) -> str:
        return self._table.html + paragraphs(self.notes)


def compare(
    controllers: Mapping[str, Controller],
    scenario: Scenario,
    *,
    design: ArrayLike | None = None,
    objective: Objective,
    X: Limits | tuple[ArrayLike, ArrayLike],
    U: Limits | tuple[ArrayLike, ArrayLike] | None = None,
    limit: ArrayLike | None = None,
    few: Mapping[str, int] | None = None,
    output_limits: OutputLimits | None = None,
    metrics: Metrics | None = None,
    risk: Risk | None = None,
    baseline: str | None = None,
    compiled: bool = False,
) -> Comparison:
    """Scores of all controllers on one scenario, paired to a baseline.

    Parameters
    ----------
    controllers : mapping of name to controller
        Functions of the state, see `ccdtools.controllers.controllers`, or models with a ``predict`` in the plant's
        units, as of scikit-learn. Of an agent of Stable-Baselines3, the ``controller`` of its `DesignEnv`.
    scenario : Scenario
    design : (np,) array_like
        Required when the plant has design parameters.
    objective : QuadraticObjective or CustomObjective
    X : Polytope, bounds (lower, upper), or the X(p) of a problem
        State limits, whose violations are counted.
    U : the same of inputs, optional
        Its violations count with those of X. Nothing is clipped: without U any input counts as what the plant can do.
    limit : (nx,) array_like, optional
        Divergence limit on |x|, see `simulate`; a thousand times the largest |x| within X by default.
    few : mapping of name to int, optional
        Controllers that see only the first so many runs; MPC 100 by default.
    output_limits : OutputLimits, optional
        Limits of outputs, whose violations are counted with those of X.
    metrics : function, optional
        `Trajectory` → mapping of names, with units, to numbers: what the scores hold beside the returns. Such as a
        `Ride`.
    risk : Risk, optional
        Shown beside the metrics: its measure of the returns of the runs that did not diverge, such as ``problem.risk``
        of scenarios of the problem. Of a worst case it is the least mean, not rounded; NaN where a case has no run.
    baseline : str, optional
        The controller that the others are paired to; "LQR" by default, or the first where there is none.
    compiled : bool
        Whether the C code of learned policies, with memory or filter, and of explicit MPC is compiled and timed, too,
        where ``cc`` is found; the table then has columns of times.

    Raises
    ------
    InputError
        If an argument is of the wrong kind or size, or no controller has the name of the baseline.
    """
    controllers = as_mapping("controllers", controllers, "a mapping of names to controllers")
    if not controllers:
        raise InputError("controllers", "none", "at least one")
    if baseline is None:
        baseline = REFERENCE if REFERENCE in controllers else next(iter(controllers))
    as_choice("baseline", baseline, list(controllers))
    for controller in controllers.values():
        needs_of(controller)
    as_instance("scenario", scenario, Scenario, "a Scenario", "Use Scenario(plant, x0, disturbance).")
    as_objective("objective", objective)
    X = set_at(X, design, "X", scenario.plant.nx)
    U = None if U is None else set_at(U, design, "U", scenario.plant.nu)
    limit = divergence_limit(X) if limit is None else limit
    if output_limits is not None:
        as_instance("output_limits", output_limits, OutputLimits, "OutputLimits(h, lower, upper) or None")
    few = {"MPC": 100} if few is None else as_mapping("few", few, "a mapping of names to numbers of runs")
    runs = {name: min(as_count(f"few[{name!r}]", n), len(scenario.x0)) for name, n in few.items()}
    as_metrics(metrics)
    as_flag("compiled", compiled)
    if risk is not None:
        as_risk("risk", risk)
    reference = scenario.run(controllers[baseline], design=design, limit=limit)
    scores = []
    pieces = {}
    for name, controller in controllers.items():
        at(name)
        seen = scenario.first(runs.get(name, len(scenario.x0)))
        run = reference if name == baseline else seen.run(controller, design=design, limit=limit)
        whole, pieces[name] = Excursions.from_trajectory(run, X, scenario.plant, output_limits, U)
        score = _score(name, controller, run, reference, objective, whole, scenario, compiled=compiled)
        shown = {} if metrics is None else metrics_of(metrics, run)
        if risk is not None:
            measured = summarise_in_risk(risk, run.returns(objective), run.diverged)
            shown |= {f"return, {measure(risk)}": measured.mean}
            score = replace(score, in_risk=measured)
        scores.append(replace(score, metrics=shown) if shown else score)

    def further(own: Sequence[Excursions]) -> tuple[str, ...]:
        """Controllers that leave limits less than this one, of some kind."""
        return tuple(name for name, other in pieces.items() if any(map(further_outside, own, other)))

    found = (replace(one, further_outside_than=further(pieces[one.controller])) for one in scores)
    return Comparison(tuple(found), limits_in_words(output_limits, U), baseline, compiled)


def _score(
    name: str, controller: Controller, run: Trajectory, reference: Trajectory, objective: Objective,
    outside: Excursions, scenario: Scenario, *, compiled: bool,
) -> Score:  # fmt: skip
    n = len(run.states)
    kept = ~(run.diverged | reference.diverged[:n])
    own = run.rewards(objective)
    other = reference.rewards(objective)[:n]
    shared = other[kept].sum(axis=1)
    median, most = c_step_time(controller, run) if compiled else NONE
    idle = run is reference and not run.inputs.any()
    return Score(
        controller=name,
        summary=summarise_returns(own[~run.diverged], runs=n),
        paired_to_lqr=paired_returns(own[kept], other[kept], runs=n),
        lqr_mean=float(shared.mean()) if len(shared) else float("nan"),
        diverged=float(run.diverged.mean()),
        violations=_mean(outside.fraction),
        depth_mean=_mean(outside.mean),
        depth_peak=_mean(outside.peak),
        depth_worst=float(outside.peak.max()) if len(outside.peak) else float("nan"),
        exceeded=outside.exceeded,
        further_outside_than=(),
        step_time=float(np.median(step_times(controller, run.states[0], scenario, run.design))),
        design_cost=float(objective.cost_of_design(run.design, scenario.steps)),
        runs=n,
        remark=getattr(controller, "remark", "") or nothing_done("the scenario") * idle,
        c_step_time=median,
        c_step_time_99=most,
    )


def _mean(values: Array) -> float:
    """Mean of the values; NaN without any."""
    return float(values.mean()) if len(values) else float("nan")


def step_times(controller: Controller, states: Array, scenario: Scenario, p: ArrayLike = ()) -> Array:
    """Times [s] of single calls at a run's first states (T, nx)."""
    if isinstance(controller, Filtered | Observed):
        controller = controller.uncounted()
    driver = Driver(
        controller, 1, scenario.plant.nu, disturbances=scenario.disturbance[:1], reference=scenario.reference,
        output=scenario.sensor(p),
    )  # fmt: skip
    times = []
    for k, x in enumerate(states[: min(TIMED_CALLS, scenario.steps)]):
        start = time.perf_counter()
        u = driver(k, x[None])
        times.append(time.perf_counter() - start)
        driver.remember(np.asarray(u, dtype=float))
    return np.array(times)


def _text_cells(score: Score, table: Comparison, *, whole: bool) -> tuple[str, ...]:
    """Cells of a printed row; `whole` if it is of all runs."""
    floor = SAME_RETURN * abs(score.lqr_mean)
    paired = score.paired_to_lqr
    compared = score.controller != table.baseline and np.isfinite(paired.mean) and not score.remark
    difference = _shown(paired.mean, ".4g", floor) if compared else "-"
    interval = f"[{', '.join(_shown(end, '.4g', floor) for end in paired.ci95)}]" if compared else "-"
    mean = _shown(score.summary.mean, ".5g") if whole else "*"
    std = _shown(score.summary.std, ".3g") if whole else "*"
    in_c = (score.c_step_time, score.c_step_time_99)
    times = [", ".join(_shown(1e6 * one, ".3g") for one in kind) for kind in ((score.step_time,), in_c)]
    return (
        score.controller, mean, std, str(score.summary.n), difference, interval, f"{score.diverged:.1%}",
        _shown(score.violations, ".1%"), _shown(score.depth_peak, ".2g"), *times * table.compiled,
    )  # fmt: skip


def _shown(value: float, form: str, floor: float = 0.0) -> str:
    """Printed number: 0 within rounding, a dash if not finite."""
    if not np.isfinite(value):
        return "-"
    return "0" if abs(value) < floor else format(value, form)
