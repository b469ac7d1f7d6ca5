"""Redesign now, log longer or stop: what each is worth."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from scipy import stats

from ccdtools.arrays import Array
from ccdtools.evidence.percent import number, with_minus
from ccdtools.exceptions import InputError
from ccdtools.studies.budgets import LONGEST_LOG
from ccdtools.tolerances import NOT_WORSE
from ccdtools_ground.door import as_array, as_floats, as_instance, as_number, as_positive, shown
from ccdtools_ground.outcome import Outcome

NORMAL_95 = float(stats.norm.ppf(0.975))  # Half a 95 % interval, in standard deviations.


class RedesignAction(Outcome):
    """What to do about a redesign."""

    REDESIGN = "redesign now", "Build the redesign."
    LOG = "log longer", "Deploy once more as it is: what it tells is worth more than what it costs."
    STOP = "stop", "What is deployed stays: neither a redesign nor another log is worth what it costs."


@dataclass(frozen=True)
class RedesignCost:
    """What a redesign costs, and what it is worth.

    Attributes
    ----------
    cost : float
        Of a redesign, built and put in place [unit].
    serves : float
        How many evaluations a generation serves.
    unit : str
        "EUR", or "return": of an evaluation.
    worth : float, optional
        Of one unit of return [unit]; 1 if that is the return itself.
    logging : float
        Cost of one more deployment, beside the evaluations that it takes from `serves` [unit].

    Raises
    ------
    InputError
        If there is no unit, no worth of a return in money, or a number is not finite or not positive.
    """

    cost: float
    serves: float
    unit: str
    worth: float | None = None
    logging: float = 0.0

    def __post_init__(self) -> None:
        for name in ("cost", "serves", "worth", "logging"):
            _check_size(name, getattr(self, name))
        if not isinstance(self.unit, str) or not self.unit.strip():
            raise InputError("unit", shown(self.unit), 'the unit of the costs, such as "EUR" or "return"')
        if self.worth is None and self.unit != "return":
            cure = 'The unit of returns is called "return".' if self.unit.lower().startswith("return") else ""
            raise InputError("worth", "nothing", f"what one unit of return is worth in {self.unit}", cure)
        if self.worth not in (None, 1) and self.unit == "return":
            raise InputError("worth", shown(self.worth), "none where costs are in units of the return")
        object.__setattr__(self, "worth", as_positive("worth", 1.0 if self.worth is None else self.worth))
        as_positive("serves", self.serves)
        for name in ("cost", "logging"):
            as_number(name, getattr(self, name), expected="a number of at least 0", low=0.0)

    @classmethod
    def parse(cls, text: Any, argument: str = "redesign_cost") -> RedesignCost:
        """Cost stated by a text such as "500 EUR, serves 2000, worth 0.3, logging 20".

        Raises
        ------
        InputError
            As the class; or if the text is not of that kind.
        """
        expected = 'a text like "500 EUR, serves 2000, worth 0.3, logging 20", or "12 return, serves 200"'
        first, *others = [part.split() for part in text.split(",")] if isinstance(text, str) else [[]]
        names = [part[0] if part else "" for part in others]
        known = sorted({"serves", "worth", "logging"} & {*names})
        if {len(part) for part in (first, *others)} != {2} or sorted(names) != known:
            raise InputError(argument, shown(text), expected)
        try:
            amounts = {name: float(amount) for name, amount in [("cost", first[0]), *map(tuple, others)]}
            return cls(**({"unit": first[1]} | amounts))  # type: ignore[arg-type]  # names are checked above
        except (ValueError, TypeError) as error:
            said = f"{shown(text)} ({error})" if isinstance(error, InputError) else shown(text)
            raise InputError(argument, said, expected) from None

    @property
    def needed(self) -> float:
        """Gain of an evaluation that pays for a redesign."""
        return self.cost / (self.serves * float(self.worth or 1.0))


@dataclass(frozen=True)
class RedesignDecision:
    """Decision on a redesign, with its alternative.

    Attributes
    ----------
    status : RedesignAction
    worth : float
        Expected worth of that, beside what is deployed for as long [unit].
    alternative : RedesignAction
        The next best.
    alternative_worth : float
    redesign : (float, float)
        95 % interval of the worth of a redesign now [unit].
    logs : int
        Deployments that are worth logging before the decision; 0 but for "log longer".
    unit : str
    """

    status: RedesignAction
    worth: float
    alternative: RedesignAction
    alternative_worth: float
    redesign: tuple[float, float]
    logs: int
    unit: str

    def __str__(self) -> str:
        low, high = (number(end) for end in self.redesign)
        logs = f" ({self.logs} deployment{'s' * (self.logs > 1)})" if self.logs else ""
        best = f"{self.status.value}{logs}, worth {number(self.worth)} {self.unit} beside what is deployed"
        least = 1e-9 * max(map(abs, self.redesign))  # less is nothing beside what a redesign moves
        other = f"{self.alternative.value}, {number(self.alternative_worth * (abs(self.alternative_worth) > least))}"
        return with_minus(f"{best}; next best: {other}; now it is worth [{low}, {high}] {self.unit}")

    def as_dict(self) -> dict[str, Any]:
        """Plain values, for results.json."""
        return vars(self) | {"status": self.status.value, "alternative": self.alternative.value,
                             "advice": self.status.advice, "text": str(self)}  # fmt: skip


def _check_size(name: str, value: Any) -> None:
    """Raise an `InputError` where squares and products overflow."""
    largest = np.finfo(float).max ** 0.25
    size = np.abs(as_floats(name, 0.0 if value is None else value))
    if (size > largest).any() or ((size > 0) & (size < 1 / largest)).any():
        expected = f"0, or numbers of {1 / largest:.0e} to {largest:.0e} in size"
        raise InputError(name, shown(value), expected, "State it in another unit.")


def decide_redesign(
    gains: ArrayLike, terms: RedesignCost, *, noise: float | None = None, prior: tuple[float, float] | None = None,
    deployment: float = 1.0,
) -> RedesignDecision:  # fmt: skip
    """Decision from the gains that deployments have measured.

    Parameters
    ----------
    gains : (n,) array_like
        Gain of the redesign over what is deployed, one measurement a deployment [return of an evaluation].
    terms : RedesignCost
    noise : float, optional
        Standard deviation of a measurement; by default that of the gains, widened as Student's t asks for so few.
    prior : (float, float), optional
        Mean and standard deviation of the gain before any measurement; by default nothing was known.
    deployment : float
        Evaluations that a deployment takes.

    Raises
    ------
    InputError
        If a gain is not finite, or there are too few: two, or one with `noise`, or none with a `prior` besides.
    """
    as_instance("terms", terms, RedesignCost, "a RedesignCost")
    for name, value in (("gains", gains), ("noise", noise), ("prior", prior), ("deployment", deployment)):
        _check_size(name, value)
    deployment = as_positive("deployment", deployment)
    measured = as_floats("gains", gains)
    fewest = (2, 1 - (prior is not None))[noise is not None]
    if measured.shape != (0,):
        measured = as_array("gains", measured, ("n",))
    if len(measured) < fewest:
        raise InputError("gains", f"{len(measured)} of them", f"at least {fewest}, or `noise` and `prior`")
    spread = (
        float(measured.std(ddof=1))
        if noise is None
        else as_number("noise", noise, expected="a number of at least 0", low=0.0)
    )
    precision, mean = 0.0, 0.0
    if prior is not None:
        mean, before = as_array("prior", prior, (2,))
        precision = as_positive("prior", before) ** -2
    wide = 1.0 if noise is not None else float(stats.t.ppf(0.975, len(measured) - 1)) / NORMAL_95
    each = max(wide * spread, np.finfo(float).tiny ** 0.25) ** -2
    known = precision + each * len(measured)
    return of_normal(
        (precision * mean + each * float(measured.sum())) / known, known**-0.5, spread, terms, deployment=deployment
    )


def of_normal(
    mean: float, error: float, noise: float, terms: RedesignCost, *, deployment: float = 1.0, allowed: bool = True
) -> RedesignDecision:
    """Decision on a gain that is known as normal.

    A redesign now is worth its mean gain over all that it serves, less its cost. After k more deployments the mean will
    be normal about today's, and is acted upon if it pays in the time that is left: the preposterior worth of k logs, of
    which the best k counts. Logs have to be worth half a per cent of the cost of a redesign more than what else there
    is. `allowed` says whether a redesign may be built today.

    References
    ----------
    Raiffa and Schlaifer, Applied statistical decision theory, 1961, chapter 5; Frazier and Powell, Paradoxes in
    learning and the marginal value of information, Decision Analysis 7(4), 2010 (why the best k).
    """
    mean, error = float(mean), float(error)
    if not np.isfinite([mean, error]).all():
        return RedesignDecision(RedesignAction.LOG, np.nan, RedesignAction.STOP, 0.0, (np.nan, np.nan), 1, terms.unit)
    scale = terms.serves * float(terms.worth or 1.0)
    interval = (scale * (mean - NORMAL_95 * error) - terms.cost, scale * (mean + NORMAL_95 * error) - terms.cost)
    logs: Array = np.arange(min(LONGEST_LOG, int(terms.serves / deployment)), dtype=float) + 1
    logged = _preposterior(mean, error, noise, terms, logs, logs * deployment)
    most = int(logged.argmax()) if len(logs) else -1
    worths = {RedesignAction.STOP: 0.0}
    if allowed:
        worths[RedesignAction.REDESIGN] = scale * mean - terms.cost
    if len(logs):
        worths[RedesignAction.LOG] = float(logged[most])
    hurdle = {RedesignAction.LOG: NOT_WORSE * terms.cost}
    ranked = sorted(worths, key=lambda action: worths[action] - hurdle.get(action, 0.0), reverse=True)
    best, other, *_ = [*ranked, RedesignAction.STOP]
    ahead = int(logs[most]) if best is RedesignAction.LOG else 0
    return RedesignDecision(best, worths[best], other, worths[other], interval, ahead, terms.unit)


def _preposterior(mean: float, error: float, noise: float, terms: RedesignCost, logs: Array, taken: Array) -> Array:
    """Expected worths (n,) of deciding after more logs."""
    left = (terms.serves - taken) * float(terms.worth or 1.0)
    moves = error**2 / np.sqrt(error**2 + noise**2 / logs) if error > 0 else np.zeros(len(logs))
    excess = mean * left - terms.cost
    spread = left * moves
    with np.errstate(divide="ignore", invalid="ignore"):
        beyond = np.nan_to_num(excess / spread, posinf=np.inf, neginf=-np.inf)
    worth: Array = excess * stats.norm.cdf(beyond) + spread * stats.norm.pdf(beyond)
    return worth - terms.logging * logs
