"""Laws that engineers use for a damper between two bounds."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import lru_cache

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike
from scipy.optimize import minimize

from ccdtools.arrays import Array, Immutable
from ccdtools.co_design.problem import CoDesignProblem
from ccdtools.plants.discretisation import discretise
from ccdtools.plants.library.elements import linear_part
from ccdtools.plants.models import Model
from ccdtools.plants.plant import Plant
from ccdtools.plants.sampled_model import SampledModel
from ccdtools.scenario import Scenario
from ccdtools.vehicles.budgets import TUNING_EVALUATIONS, TUNING_RUNS
from ccdtools.vehicles.quarter_car import SOFTEST
from ccdtools_ground.door import as_floats, as_instance
from mpc import lqr


@dataclass(frozen=True, eq=False)
class SemiActive(Immutable):
    """Damper whose force comes nearest to a demanded one, f = −F x on the body.

    Of a quarter car with `semi_active`; its input is the damping between a tenth of c_s and c_s.

    Attributes
    ----------
    F : (n,) array
        Demanded force by state, of the first n.
    largest : float
        c_s [N·s/m].
    """

    F: Array
    largest: float

    def __call__(self, x: ArrayLike) -> Array:
        """Inputs (n, 1) or (1,) from −1 to 1."""
        states = as_floats("x", x)
        rate, demanded = states[..., 3] - states[..., 1], states[..., : len(self.F)] @ self.F
        moving = np.abs(rate) > np.finfo(float).tiny
        share = np.where(moving, demanded / np.where(moving, rate, 1.0) / self.largest, (1 + SOFTEST) / 2)
        u: Array = 2 * (np.clip(share, SOFTEST, 1.0)[..., None] - SOFTEST) / (1 - SOFTEST) - 1
        return u


def skyhook(problem: CoDesignProblem, design: Array) -> SemiActive:
    """Damper to the sky and one to the ground, tuned at the design.

    References
    ----------
    Karnopp, Crosby and Harwood, "Vibration control using semi-active force generators", Journal of Engineering for
    Industry 96, 1974; Valášek et al., "Extended ground-hook", Vehicle System Dynamics 29, 1998.
    """
    to_sky, to_ground = np.array([0.0, 0.0, 0.0, design[1]]), np.array([0.0, -design[1], 0.0, 0.0])
    return _tuned(problem, design, np.array([to_sky, to_ground]), np.array([[1.0, 0.2], [2.0, 0.2], [1.0, 0.6]]))


def _tuned(problem: CoDesignProblem, design: Array, parts: Array, first: Array) -> SemiActive:
    """Best damper found whose F is a weighted sum of parts.

    parts : (n, ·); first : (n + 1, n), the simplex of weights that Nelder–Mead begins with.
    """
    x0, w = problem.scenarios.sample(TUNING_RUNS, problem.steps, np.random.default_rng(0))
    scenario = Scenario(problem.model, x0, w)

    def cost(shares: Array) -> float:
        run = scenario.run(SemiActive(shares @ parts, design[1]), design=design, limit=problem.limit)
        return -float(run.returns(problem.objective).mean())

    options = {"maxfev": TUNING_EVALUATIONS * len(parts), "initial_simplex": first}
    return SemiActive(minimize(cost, first[0], method="Nelder-Mead", options=options).x @ parts, design[1])


ForceWeights = Callable[[Array], tuple[Array, Array, Array]]


def clipped_lqr(weights: ForceWeights, *, tuned: bool = False) -> Callable[[CoDesignProblem, Array], SemiActive]:
    """Law: LQR of an actuator, clipped to what the damper can do.

    The actuator stands in the place of the problem's damper.

    Parameters
    ----------
    weights : function of the design
        Q (nx, nx), R (1, 1) and S (nx, 1) of the force.
    tuned : bool
        Whether its gains are tuned in closed loop at the design: the best clipped linear feedback that is found.
    """

    def law(problem: CoDesignProblem, design: Array) -> SemiActive:
        model = as_instance("problem.model", problem.model, SampledModel, "that of a car with semi_active")
        A, B, _ = _actuated(model.plant).matrices(design)
        Q, R, S = weights(design)
        F = lqr(A, B, Q=Q, R=R, S=S)[0][0]
        first = 1 + np.eye(len(F) + 1, len(F), -1)
        return _tuned(problem, design, np.diag(F), first) if tuned else SemiActive(F, design[1])

    return law


@lru_cache(maxsize=1)
def _actuated(car: Plant) -> Model:
    """Model of a car with a force in its damper's place."""
    x, push = ca.DM.zeros(car.nx), ca.jacobian(car.dynamics, car.p[1])
    x[3] = -1.0  # where the rate is −1, the damper's force is its damping
    force = ca.substitute(push, ca.vertcat(car.x, car.u, car.w), ca.vertcat(x, 1, 0)) * car.u
    at_rest = linear_part(ca.substitute(car.dynamics, car.p[1], 0) + force, car.x, car.u, car.w)
    undamped = replace(car, dynamics=at_rest)
    return discretise(undamped, sampling_guard="ignore")
