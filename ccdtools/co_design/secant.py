"""LQR of the linearisation over visited states, beside the tangent's.

Friction, dead zones and springs that stiffen look at rest like another plant than where the loop goes. Fitted are the
matrices and the constant that predict x⁺ best, in least squares over the states and inputs of the loop; the loop with
their LQR visits other states, so they are fitted again.

References
----------
Booton, "Nonlinear control systems with random inputs", IRE Transactions on Circuit Theory 1(1), 1954 (statistical
linearisation); Gelb and Vander Velde, Multiple-Input Describing Functions and Nonlinear System Design, 1968.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import ArrayLike

from ccdtools.arrays import Array, Immutable
from ccdtools.co_design.design_controllers import affine_lqr, saturated_lqr
from ccdtools.co_design.differentiable_model import (
    ScenarioTensors,
    Stepper,
    fewer_runs,
    in_double,
    scenario_tensors,
    visited as of_episodes,
)
from ccdtools.co_design.problem import CoDesignProblem
from ccdtools.co_design.tolerances import EXCITATION
from ccdtools.controllers.controllers import LinearFeedback, Passive
from ccdtools.exceptions import InputError
from ccdtools.tolerances import NOT_WORSE
from ccdtools_ground.door import as_generator, as_instance
from mpc import NotStabilisableError


@dataclass(frozen=True, eq=False)
class Linearisation(Immutable):
    """Linearisation x⁺ ≈ A x + B u + c over visited states, and LQR."""

    A: Array  # (nx, nx)
    B: Array  # (nx, nu)
    c: Array  # (nx,): what motion itself, or a stated mean of the disturbance, adds at each step
    controller: LinearFeedback  # saturated LQR of A and B, with the offset against c
    mean_return: float  # of that LQR, on the scenarios of the fit; NaN where there is none
    tangent_return: float  # of LQR of the tangent at rest
    size: float  # of the mean return, without the cost of the design

    @property
    def better(self) -> bool:
        """True if the secant's closed-loop return exceeds the tangent's by 0.5 %."""
        return not self.tangent_return >= self.mean_return - NOT_WORSE * self.size

    def __str__(self) -> str:
        tangent = "none" if np.isnan(self.tangent_return) else f"{self.tangent_return:.5g}"
        return (
            f"LQR of the tangent at rest returns {tangent}, of the secant over the visited states "
            f"{self.mean_return:.5g}"
        )


def stochastic_linearisation(problem: CoDesignProblem, design: ArrayLike, rng: np.random.Generator) -> Linearisation:
    """Linearisation at a design over the states visited by its LQR.

    Of four rounds, each fitted over the loop of the one before, the best in closed loop is returned.

    Raises
    ------
    InputError
        If an argument is of the wrong kind, or the first round has too few steps to fit.
    NotStabilisableError
        If no round finds matrices that can be stabilised.

    Examples
    --------
    >>> found = stochastic_linearisation(problem, design, np.random.default_rng(0))
    >>> found.A, found.B, found.c, found.controller
    >>> print(found)
    """
    as_instance("problem", problem, CoDesignProblem, "a CoDesignProblem")
    as_generator("rng", rng)
    return fitted(problem, problem.design.check_one(design), visited(problem, rng))


def visited(problem: CoDesignProblem, rng: np.random.Generator) -> ScenarioTensors:
    """Scenarios that a fit is over."""
    x0, w = scenario_tensors(problem, fewer_runs(32, problem.steps), rng)
    return x0.double(), w.double()


def fitted(problem: CoDesignProblem, p: Array, scenarios: ScenarioTensors) -> Linearisation:
    """Best linearisation of the rounds on given scenarios, at a design (np,)."""
    rng = np.random.default_rng(0)
    bounds = problem.input_bounds_at(p)

    def driven(law: LinearFeedback | Passive) -> tuple[Array, Array, float]:
        """States and inputs (n, ·) visited before divergence, and the mean return."""
        step = Stepper.at(in_double(problem), torch.tensor(p))
        *pairs, seen = of_episodes(step, lambda x: x.new_tensor(law(x.numpy())), scenarios)
        states, inputs = (part.numpy() for part in pairs)
        within = (np.abs(states) <= problem.limit).all(axis=1)
        return states[within], inputs[within], float(seen.total.mean())

    try:
        states, _, tangent = driven(saturated_lqr(problem, p))
    except NotStabilisableError:
        states = driven(Passive(problem.model.nu))[0]
        tangent = float("nan")
    half = np.where(np.isfinite(bounds[1] - bounds[0]), bounds[1] - bounds[0], 1.0) / 2
    inputs = np.clip(EXCITATION * half * rng.standard_normal((len(states), problem.model.nu)), *bounds)
    best: Linearisation | None = None
    for _ in range(4):  # each fits over the loop of the one before
        try:
            fit = _least_squares(problem, p, states, inputs, rng)
            law = affine_lqr(problem, p, *fit)
        except (NotStabilisableError, InputError):
            if best is None:
                raise
            break
        states, inputs, mean = driven(law)
        if best is None or mean > best.mean_return:
            best = Linearisation(*fit, law, mean, tangent, abs(float(problem.made_by_control(mean, p))))
    assert best is not None
    return best


def _least_squares(
    problem: CoDesignProblem, p: Array, states: Array, inputs: Array, rng: np.random.Generator
) -> tuple[Array, Array, Array]:  # fmt: skip
    """A, B and c that predict undisturbed steps best."""
    x, u = np.vstack([states, states]), np.vstack([inputs, rng.permutation(inputs)])
    pairs = np.hstack([x, u])
    after = problem.model.stepper(p, batch=1)(x, u, np.tile(problem.mean_disturbance, (len(x), 1)))
    kept = np.isfinite(after).all(axis=1)  # not where a simulator gives no number
    if kept.sum() <= pairs.shape[1]:
        got = f"numbers after {kept.sum()} of {len(kept)} steps of runs that are not lost"
        raise InputError("problem", got, f"more than {pairs.shape[1]}, which a linearisation is fitted to")
    pairs, after = pairs[kept], after[kept]
    mean, mean_after = pairs.mean(axis=0), after.mean(axis=0)
    fit = np.linalg.lstsq(pairs - mean, after - mean_after, rcond=None)[0].T
    return fit[:, : x.shape[1]], fit[:, x.shape[1] :], mean_after - fit @ mean
