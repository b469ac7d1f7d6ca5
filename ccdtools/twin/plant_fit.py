"""Plant that logs tell, by prediction errors."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import casadi as ca
import numpy as np
from scipy.stats import norm, t

from ccdtools.arrays import Array, Immutable, Mask
from ccdtools.co_design.measured import kalman_filter
from ccdtools.co_design.problem import CoDesignProblem
from ccdtools.estimation.innovations import Innovations
from ccdtools.exceptions import InputError
from ccdtools.plants.models import as_model
from ccdtools.plants.plant import Plant
from ccdtools.trajectory import Trajectory
from ccdtools.twin.likelihood import Likelihood, information_rows
from ccdtools.twin.lost_outputs import inputs_answered
from ccdtools.twin.output_log import OutputLog, as_output_log, output_names
from ccdtools.twin.residuals import errors_in, residuals
from ccdtools.twin.state_errors import StateErrors
from ccdtools.twin.stuck_sensors import warn_of_spikes
from ccdtools.twin.tolerances import FEWEST_FITTED
from ccdtools.twin.unknown_plant import UnknownPlant, changed_plant, mean_disturbance, stated_plant
from ccdtools_ground.door import as_choice, as_count, as_generator, as_instance, as_share, shown
from ccdtools_ground.outcome import Outcome
from mpc.optimal_control.estimation.experiment import whitened
from mpc.optimal_control.estimation.information import Information
from mpc.optimal_control.estimation.parameter_estimate import in_words
from mpc.tolerances import NEGLIGIBLE

NOISE = ("log factor of the variance of w", "log factor of the variance of the sensors")


class FitStatus(Outcome):
    """Outcome of a fit; the value is the advice."""

    SOLVED = "Solved: nothing near is likelier, and the log tells every combination of the parameters."
    OPEN = (
        "The log leaves combinations of parameters open, see `open`. State a plant with fewer of them, measure another "
        "output, or excite what distinguishes them: `plan_experiment` says by what."
    )
    LASTING = (
        "Errors last: they have a mean, or one tells the next. So the log may mistake a disturbance for dynamics. "
        "Excite the inputs more, or state a constant part, a friction or a state of the disturbance as well. States "
        "logged with noise show the same: state their sensors, Measurement(np.eye(nx), noise=…), and log outputs."
    )
    ANSWERED = (
        "Inputs seem to have answered outputs that the log lost: beside what was told they tell the innovation after "
        "a gap. A fit takes that for dynamics. Log what the controller sees, or leave out runs with gaps."
    )
    FEW = (
        "Too few values are measured: with fewer than twenty for each unknown, noise and correlations counted, "
        "intervals do not hold. Log longer, or state a plant with fewer unknown entries."
    )
    AT_BOUND = "A parameter is held by a bound of the stated plant: widen it, or doubt the plant."
    UNSOLVED = "The likelihood could not be maximised: narrow the bounds of the stated plant, or log longer."


@dataclass(frozen=True, eq=False, repr=False)
class PlantFit(Immutable):
    """Parameters that logs tell.

    Attributes
    ----------
    names : tuple of str
    values : (m,) array
        The likeliest; of a change of the nominal model 0 is none.
    covariance : (m, m) array
        Inverse of Fisher's information; infinite variances where the log tells nothing.
    status : FitStatus
    open : tuple of dict
        Combinations that the log does not tell: changes by name, each in its own size.
    innovation_variance : float
        Mean square of the innovations beside what is expected of them.
        1 by definition of a fit to states, whose errors are measured by their own size.
    unknown : UnknownPlant
    freedom : float
        Degrees of freedom of the intervals.
    left_out : (int, int)
        Runs that diverged and are not in the fit, of how many.
    """

    names: tuple[str, ...]
    values: Array
    covariance: Array
    status: FitStatus
    open: tuple[dict[str, float], ...]
    innovation_variance: float
    unknown: UnknownPlant
    freedom: float = np.inf
    left_out: tuple[int, int] = (0, 0)
    information: Information = field(repr=False, kw_only=True)  # of which `covariance` is what the errors leave
    errors: tuple[Array, Array, Array] | None = field(default=None, repr=False, kw_only=True)
    # of states: their sizes (nx,), second moments in these (nx, nx), and moments (m, m) of the slopes of the criterion

    def __repr__(self) -> str:
        rows = zip(self.names, self.values, self.deviations)
        said = ", ".join(f"{one}={at:.6g}{f'±{off:.2g}' if off > 0 else ' at its bound'}" for one, at, off in rows)
        left_out = ", {} of {} runs left out".format(*self.left_out) if self.left_out[0] else ""
        return (
            f"PlantFit({said}, status={self.status.name}, innovation_variance={self.innovation_variance:.4g}{left_out})"
        )

    @property
    def deviations(self) -> Array:
        """Standard deviations (m,)."""
        return np.sqrt(np.diag(self.covariance))

    def updated(self, problem: CoDesignProblem) -> CoDesignProblem:
        """Problem on the plant that was found; see `updated_problem`."""
        self._check_known()
        return self.likeliest(problem)

    def likeliest(self, problem: CoDesignProblem) -> CoDesignProblem:
        """Problem on the likeliest plant, whatever the status: what is made for it the real plant must judge."""
        return self.unknown.known(problem, self.values[: len(self.unknown.free)])

    def _check_known(self, *doubtful: FitStatus) -> None:
        if self.status not in (FitStatus.SOLVED, FitStatus.AT_BOUND, *doubtful):
            raise InputError("twin", f"a fit that is {self.status.name}", "one that is SOLVED", self.advice)

    def drawn(self, problem: CoDesignProblem, draws: int, rng: np.random.Generator) -> list[CoDesignProblem]:
        """Problems on plants drawn from what is known of them; parameters that are left open stay at the likeliest."""
        self._check_known(FitStatus.LASTING, FitStatus.OPEN, FitStatus.FEW, FitStatus.ANSWERED)
        m = len(self.unknown.free)
        known = _inverse(self.covariance)[:m, :m]
        units = np.where(np.diag(known) > 0, np.sqrt(np.diag(known)), 1.0)
        scaled = known / units / units[:, None]
        away = as_generator("rng", rng).multivariate_normal(0 * units, scaled, as_count("draws", draws))
        drawn = self.values[:m] + units * away
        inside = drawn if self.unknown.constants else np.clip(drawn, *self.unknown.bounds)
        return [self.unknown.known(problem, values) for values in inside]

    @property
    def advice(self) -> str:
        """Advice, with the combinations that stay open."""
        lost = "{} of {} runs diverged and are left out: the fit does not know what they met.".format(*self.left_out)
        left_out = [lost] if self.left_out[0] else []
        return " ".join([self.status.advice, *(f"Open: {in_words(one)}." for one in self.open), *left_out])

    def with_each(self, problem: CoDesignProblem, logs: Sequence[Trajectory]) -> Iterator[PlantFit]:
        """Fits with one more log each, all of one design."""
        functions = self.unknown.functions(problem, logs[0].design)
        if self.errors is None:
            scaled = len(self.names) > len(self.unknown.free)
            given = [OutputLog(log.outputs, log.inputs, log.design) for log in logs]
            parts: Any = (_innovations(problem, functions, log, scaled) for log in given)
        else:
            told = StateErrors.of(functions[0], mean_disturbance(problem), self.errors[0])
            parts = (told.along(log.states, log.inputs) for log in logs)
        return (self._with(problem, part) for part in parts)

    def _with(self, problem: CoDesignProblem, part: Any) -> PlantFit:
        """Fit with the errors of one more log."""
        errors = self.errors
        more = information_rows(*part.at(self.values)) * self.information.units
        known = replace(self.information, slopes=np.vstack([self.information.slopes, more]))
        covariance = known.covariance(1.0)
        if errors is not None:
            J = part.predicted(self.values)[1].reshape(-1, len(errors[0]), len(self.values))
            errors = (*errors[:2], errors[2] + np.einsum("nim,ij,njk->mk", J, errors[1], J))
            covariance = _left_by(errors, covariance, problem.state_scale)
        return replace(self, covariance=covariance, open=_open(known, self.unknown), information=known, errors=errors)

    def intervals(self, level: float = 0.95) -> Array:
        """Confidence intervals (m, 2), by Student's distribution; of no width where a bound holds a parameter.

        With 20 to 160 values for each unknown those of 95 % held 87 to 98 % of the truths.
        """
        factor = t.ppf((1 + as_share("level", level)) / 2, self.freedom)
        return np.asarray(self.values[:, None] + factor * self.deviations[:, None] * np.array([-1.0, 1.0]))


def fit_plant(
    problem: CoDesignProblem, logs: Any, *, plant: Plant | None = None, noise: str = "fitted"
) -> PlantFit:  # fmt: skip
    """Likeliest parameters of a plant, by logged outputs or states.

    With sensors prediction errors are the innovations of a cubature Kalman filter at each value of the parameters, so
    inputs that follow the errors of the filter in the loop mislead nothing. Of states they are the errors of one step,
    less the part of the last one that a fitted correlation carries on; each state's are weighed by their size. States
    count as exact: noise on them is for sensors, `Measurement(np.eye(nx), noise=…)`.
    Without a `plant` a change of the nominal model is fitted that enters where w does: w + Θx x + Θu u + θ in its
    place, at every design.

    Parameters
    ----------
    problem : CoDesignProblem
        Gives model, sensors if there are any, and mean and covariance of starts and disturbance, which counts as white.
        A start that is stated as known and was another one misleads a fit to outputs.
    logs : Trajectory or OutputLog, or a sequence of them
        Runs that diverged are left out. States are logged by a Trajectory.
    plant : Plant, optional
        With the problem's design and unknown entries besides, such as a mass or a gain, within their bounds.
    noise : {"fitted", "known"}
        Of outputs, whether factors of the variances of w and of the sensors are fitted besides, or both are as the
        problem states. Where they are not, "known" noise misleads the other parameters, often without a trace in the
        innovations.

    Returns
    -------
    PlantFit
        Never SOLVED where the log leaves a combination open, but for factors of noise alone, or has fewer than
        twenty values for each unknown; where a bound holds one of the plant's, inputs are seen to have answered
        outputs that the log lost, or the errors of states last beyond what a correlation below one explains. They
        count as no smaller than a millionth of a state's size. Names that follow those of the plant are of noise.

    Raises
    ------
    InputError
        If the problem has a function as outputs; a log is of other sizes or designs, or has fewer measured values than
        there are unknowns.

    References
    ----------
    Ljung, *System Identification*, 2nd ed., 1999, sections 7.2 and 9.2; Åström, "Maximum likelihood and prediction
    error methods", Automatica 16, 1980.

    Examples
    --------
    >>> log = deploy(real, law, design, w, x0=x0)  # doctest: +SKIP
    >>> fit = fit_plant(problem, log, plant=plant)  # doctest: +SKIP
    >>> again = codesign(updated_problem(problem, fit), method="nested", rng=rng)  # doctest: +SKIP
    """
    as_instance("problem", problem, CoDesignProblem, "a CoDesignProblem")
    as_model("problem.model", problem.model)
    output = None if problem.measurement is None else problem.measurement.output
    if not isinstance(output, Plant | np.ndarray | None):
        expected = "Measurement(output, noise=…) of a matrix or a Plant, which can be differentiated"
        raise InputError("problem.measurement", shown(problem.measurement), expected)
    several = _several(logs)
    scaled = as_choice("noise", noise, ("fitted", "known")) == "fitted" and output is not None
    if output is None:
        seen = errors_in(
            problem, [residuals(problem.model, log, argument=f"logs[{i}]") for i, log in enumerate(several)]
        )
        p, measured = seen[-1].p, sum(log.e_next[:, 1:].size for log in seen)
    else:
        given = [as_output_log(f"logs[{i}]", log, problem) for i, log in enumerate(several)]
        p, measured = given[-1].design, sum(int(np.isfinite(log.outputs).sum()) for log in given)
    unknown = changed_plant(problem, p) if plant is None else stated_plant(problem, plant)
    noises = NOISE * scaled if output is not None else tuple(f"correlation of {x}" for x in problem.state_names)
    names = unknown.free + noises
    if measured < len(names):
        got = f"{measured} measured values for {len(names)} unknowns, {', '.join(names)}"
        raise InputError("logs", got, f"at least {len(names)}", "Log longer, or state a plant with fewer of them.")
    errors: Any = None
    with np.errstate(all="ignore"):  # a filter may diverge
        if output is None:
            found, z, left, size = _of_states(problem, unknown, several)
        else:
            each = [unknown.functions(problem, log.design) for log in given]
            parts = [_innovations(problem, functions, log, scaled) for functions, log in zip(each, given)]
            found = Likelihood(unknown, parts, len(noises))
            z = found.largest()
        values, held, (_, _, slopes, squares) = found.values(z), found.held(z), found.at(z)
    told = slopes if np.isfinite(slopes).all() else np.zeros_like(slopes)
    known = Information(np.arange(len(z)), names, values, found.units, np.eye(len(z))[:, ~held], told)
    covariance, freedom = known.covariance(1.0), max(measured - len(names), 1)
    if output is None:
        scores = np.concatenate([part.scores(values, _inverse(covariance)) for part in found.parts])
        flat = np.concatenate([one.reshape(-1, len(size)) for one in left])
        errors = (size, flat.T @ flat / len(flat), scores.T @ scores)
        covariance = _left_by(errors, covariance, problem.state_scale)
        freedom = max(len(scores) - len(names), 1)
        m = len(unknown.free)
        answered, lasting = False, _lasting(left) or _carried_whole(found.parts, values[:m], held[m:])
    else:
        innovations = [part.normalised(values)[0] for part in found.parts]
        warn_of_spikes("logs", innovations, output_names(problem))
        lasting = _lasting(innovations, lags=(1, 2, 4, 8))
        answered = inputs_answered(found.parts, [log.outputs for log in given], values)
    open_ = _open(known, unknown)
    status = (
        FitStatus.UNSOLVED if not found.rise(z) <= NEGLIGIBLE
        else FitStatus.OPEN if open_
        else FitStatus.ANSWERED if answered
        else FitStatus.LASTING if lasting
        else FitStatus.FEW if measured < FEWEST_FITTED * len(names)
        else FitStatus.AT_BOUND if held[: len(unknown.free)].any()
        else FitStatus.SOLVED
    )  # fmt: skip
    return PlantFit(
        names, values, covariance, status, open_, squares / measured, unknown, freedom, _left_out(several),
        information=known, errors=errors,
    )  # fmt: skip


def _several(logs: Any) -> list[Any]:
    """Logs, of which there is at least one."""
    several = list(logs) if isinstance(logs, list | tuple) else [logs]
    if not several:
        raise InputError("logs", shown(logs), "at least one log")
    return several


def _open(known: Information, unknown: UnknownPlant) -> tuple[dict[str, float], ...]:
    """Open combinations, but for those of noise alone."""
    return tuple(one for one in known.named(1.0) if set(one) & set(unknown.free))


def _carried_whole(parts: Sequence[StateErrors], theta: Array, held: Mask) -> bool:
    """Whether an error of more than rounding is all carried on."""
    once = np.concatenate([part.of_one_step(theta)[0].reshape(-1, len(held)) for part in parts])
    return bool((held & ((once**2).mean(axis=0) > 1.0)).any())


def _left_by(errors: tuple[Array, Array, Array], covariance: Array, scale: Array) -> Array:
    """Covariance (m, m) that errors of states leave."""
    inverse = _inverse(covariance)
    rounding = (NEGLIGIBLE * scale / errors[0]).max() ** 2 * inverse
    return np.where(np.isfinite(covariance), inverse @ errors[2] @ inverse + rounding, covariance)


def _inverse(covariance: Array) -> Array:
    """Covariance (m, m) with 0 where nothing is told."""
    return np.where(np.isfinite(covariance), covariance, 0.0)


def _left_out(logs: list[Any]) -> tuple[int, int]:
    """Runs that diverged, and all runs."""
    return sum(int(np.sum(getattr(log, "diverged", 0))) for log in logs), sum(len(log.inputs) for log in logs)


def _lasting(
    runs: Sequence[Array], lags: Sequence[int] = (1,), level: float = 1e-3, size: float = 0.1
) -> bool:  # fmt: skip
    """Whether errors (n, T, m), in units of their size, have a mean, or tell those to come; not those of rounding."""
    e = np.concatenate([run.reshape(-1, run.shape[2]) for run in runs])
    square = np.maximum((e**2).mean(axis=0), 1.0)
    means, counts = [e.mean(axis=0) / np.sqrt(square)], [len(e)]
    for lag in lags:
        pairs = np.concatenate([(run[:, lag:] * run[:, :-lag]).reshape(-1, run.shape[2]) for run in runs])
        counts.append(max(len(pairs), 1))
        means.append(pairs.sum(axis=0) / counts[-1] / square)
    found = np.abs(means)
    chance = norm.isf(level / found.size / 2) / np.sqrt(counts)[:, None]
    return bool((found > np.maximum(chance, size)).any())


def _of_states(
    problem: CoDesignProblem, unknown: UnknownPlant, logs: list[Trajectory], rounds: int = 3
) -> tuple[Likelihood, Array, list[Array], Array]:
    """Criterion, its least point, the errors left there, and their size (nx,).

    Each state's errors count by their own size at the former parameters. What noise does not reach, some combination of
    states, would tell the parameters exactly, if a model was exact: so correlations are left to the intervals.
    """
    mean = mean_disturbance(problem)
    steps = [unknown.functions(problem, log.design)[0] for log in logs]
    kept = [(log.states[~log.diverged], log.inputs[~log.diverged]) for log in logs]
    size = problem.state_scale
    for _ in range(rounds):
        parts = [StateErrors.of(step, mean, size).along(*log) for step, log in zip(steps, kept)]
        found = Likelihood(unknown, parts, problem.model.nx, end_of_noise=1.0)
        z = found.largest()
        left = [part.predicted(found.values(z))[0] for part in parts]
        square = np.concatenate([(size * e).reshape(-1, len(size)) ** 2 for e in left]).mean(axis=0)
        last, size = size, np.sqrt(square + (NEGLIGIBLE * problem.state_scale) ** 2)
    return found, z, left, last


def _innovations(
    problem: CoDesignProblem, functions: tuple[ca.Function, ca.Function], log: OutputLog, scaled: bool
) -> Innovations:  # fmt: skip
    """Innovations of a log, by the problem's filter."""
    known = kalman_filter(problem, log.design)
    mean = mean_disturbance(problem)
    unstated = mean - problem.mean_disturbance
    disturbance = (mean, problem.moments[2] - np.outer(unstated, unstated))
    rows = whitened(log.outputs.reshape(-1, known.ny), known.V).reshape(*log.outputs.shape[:2], -1)
    return Innovations(*functions, disturbance, (known.x0, known.P0), rows, log.inputs, scaled)
