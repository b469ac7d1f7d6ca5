"""Estimate of parameters, and its status."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import casadi as ca
import numpy as np
from scipy.stats import norm, t

from ccdtools_ground.door import as_share
from ccdtools_ground.outcome import Outcome
from mpc.checks import Array
from mpc.optimal_control.estimation.experiment import Experiment
from mpc.optimal_control.estimation.information import Information
from mpc.optimal_control.solution import OptimalControlStatus, Solution


class EstimationStatus(Outcome):
    """Outcome of an estimation; the value is the advice."""

    SOLVED = (
        "Solved: an optimum whose conditions were checked apart from the solver, on a fine mesh, and the data tell "
        "every combination of parameters and first states. Another optimum may lie elsewhere: compare guesses."
    )
    OPEN = (
        "An optimum, but the data leave combinations open, see `open`: their values are arbitrary. Hold one of the "
        "named by equal bounds, measure another output, or excite what distinguishes them."
    )
    COARSE = (
        "An optimum on its mesh, but the mesh misses more than was asked for, or a limit is passed between its "
        "points. Allow more rounds or time."
    )
    UNSOLVED = (
        "No optimum was found: the values are those of the last iterate, or of a saddle. Give a nearer p_guess, "
        "bounds, or an Experiment(guess=…)."
    )


@dataclass(frozen=True, eq=False, repr=False)
class ParameterEstimate:
    """Estimated parameters with what the data tell of them.

    Attributes
    ----------
    p : (np,) array
    starts : (experiments, nx) array
        First states.
    status : EstimationStatus
    solution : Solution
        Trajectories, one phase an experiment, with the solver's own status; its cost is that of a supposed noise where
        none was given, and beside a disturbance has in it what the likelihood of p adds.
    covariance : (np, np) array
        Of p, by the linearised residuals, or the likelihood beside a disturbance, along constraints that push by more
        than the noise explains: 0 for what is held, infinite variances where the data tell nothing; NaN if UNSOLVED.
    start_deviations : (experiments, nx) array
        Standard deviations of the first states.
    residuals : tuple of (n, ny) arrays
        Measured less modelled outputs; NaN where nothing was measured.
    residual_variance : float
        Sum of squared residuals beside their noise and of the disturbance, by degrees of freedom: about 1 if the model
        and a given noise are right; without a given noise its estimated variance. NaN without degrees of freedom.
    degrees : int
        Measured values less the combinations of unknowns that they tell.
    noise_known : bool
    singular_values : (k,) array
        Of the scaled information, falling: inverse standard deviations of combinations, in sizes of the unknowns and
        of the noise.
    open : tuple of dict
        Combinations that the data do not tell: changes by name, each in its own size, that hardly change the outputs.
    """

    p: Array
    starts: Array
    status: EstimationStatus
    solution: Solution
    covariance: Array
    start_deviations: Array
    residuals: tuple[Array, ...]
    residual_variance: float
    degrees: int
    noise_known: bool
    singular_values: Array
    open: tuple[dict[str, float], ...]

    def __repr__(self) -> str:
        names = self.solution.program.problem.p_names
        said = ", ".join(f"{name}={value:.6g}±{sd:.2g}" for name, value, sd in zip(names, self.p, self.deviations))
        return f"ParameterEstimate({said}, status={self.status.name}, residual_variance={self.residual_variance:.4g})"

    @property
    def solved(self) -> bool:
        """Whether it is an optimum that the data determine."""
        return self.status is EstimationStatus.SOLVED

    @property
    def deviations(self) -> Array:
        """Standard deviations (np,)."""
        return np.sqrt(np.diag(self.covariance))

    @property
    def advice(self) -> str:
        """Advice on the outcome, with the combinations that stay open."""
        said = [self.status.advice, *(f"Open: {in_words(one)}." for one in self.open)]
        return " ".join(said if self.solution.solved else [*said, self.solution.advice])

    def intervals(self, level: float = 0.95) -> Array:
        """Confidence intervals (np, 2) of the single parameters.

        By the normal distribution, or Student's where the noise is estimated; of the covariance.
        """
        tail = (1 + as_share("level", level)) / 2
        factor = norm.ppf(tail) if self.noise_known else t.ppf(tail, self.degrees)
        return np.asarray(self.p[:, None] + factor * self.deviations[:, None] * np.array([-1.0, 1.0]))


def in_words(combination: dict[str, float]) -> str:
    """Combination such as "+0.71 mass −0.71 stiffness"."""
    return " ".join(f"{'−' if share < 0 else '+'}{abs(share):.2g} {name}" for name, share in combination.items())


def estimate_of(solution: Solution, given: Sequence[Experiment], output: ca.Function, known: Information | None,
                unit: float | None) -> ParameterEstimate:  # fmt: skip
    """Estimate from a solution, NaN where an unsolved one tells nothing.

    Of unknown noise the cost is in squares of `unit`.
    """
    noise_known = unit is None
    program = solution.program
    firsts = np.stack([part.first + np.arange(part.layout.nx) for part in program.parts])
    residuals = []
    for one, part in zip(given, program.parts):
        times, _, w, seen = part.samples
        at = solution.unknowns[seen].T, w.T, solution.p, part.phase.start_time + times[None]
        modelled = np.asarray(output(*at), dtype=float).T
        residuals.append(one.outputs - modelled)
    p_places = np.arange(program.parameters.start, program.parameters.stop)
    common = (solution.p, solution.unknowns[firsts])
    if known is None:
        lost = np.full((len(p_places), len(p_places)), np.nan)
        return ParameterEstimate(
            *common, EstimationStatus.UNSOLVED, solution, lost, np.full(firsts.shape, np.nan), tuple(residuals),
            np.nan, 0, noise_known, np.zeros(0), (),
        )  # fmt: skip
    degrees = sum(int(one.measured.sum()) for one in given) - known.rank
    of_spread = program.problem.of_parameters[0]
    cost = solution.cost - (0.0 if of_spread is None else float(of_spread(solution.p)))
    variance = 2 * cost / degrees if degrees else np.nan
    deviation = 1.0 if noise_known else np.sqrt(variance)
    unknowns = np.concatenate([p_places, firsts.ravel()])
    free, whole = np.isin(unknowns, known.places), np.zeros((len(unknowns),) * 2)  # 0 for what is given
    whole[np.ix_(free, free)] = known.covariance(deviation)
    covariance = whole[: len(p_places), : len(p_places)]
    starts = np.sqrt(np.diag(whole)[len(p_places) :]).reshape(firsts.shape)
    open_ = known.named(deviation)
    status = EstimationStatus.OPEN if open_ else EstimationStatus.SOLVED
    with np.errstate(divide="ignore", invalid="ignore"):  # exact data tell a combination without end, or nothing
        told = np.nan_to_num(known.modes[0] / deviation, nan=0.0, posinf=np.inf)
    if solution.status is not OptimalControlStatus.SOLVED:
        status = EstimationStatus.COARSE
    variance *= 1.0 if unit is None else unit**2
    return ParameterEstimate(*common, status, solution, covariance, starts, tuple(residuals), float(variance), degrees,
                             noise_known, told, open_)  # fmt: skip
