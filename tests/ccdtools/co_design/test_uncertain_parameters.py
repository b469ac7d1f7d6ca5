"""Uncertain parameters of a plant as disturbances that do not change: x⁺ = f(x, u, (w, θ), p), θ = 0 nominal."""

import casadi as ca
import numpy as np
import pytest

from ccdtools import CoDesignConfig, DesignSpace, Gaussian, Plant, QuadraticObjective, Study, discretise, simulate
from ccdtools.disturbances import Constant, Stacked, Uniform
from ccdtools.plants import SampledModel

X, U = ([-1.0, -3.0], [1.0, 3.0]), (-5.0, 5.0)
P = [4.0, 0.5]
DISTURBANCE = Stacked((Gaussian([0.3]), Constant(Uniform([-0.4], [0.4]))))


def spring(mass=None):
    """A mass on a spring: 1 kg, or 1 + θ with θ the second disturbance."""
    x, u, p = ca.SX.sym("x", 2), ca.SX.sym("u"), ca.SX.sym("p", 2)
    w = ca.SX.sym("w", 2 if mass is None else 1)
    own = 1 + w[1] if mass is None else mass
    dynamics = ca.vertcat(x[1], (-p[0] * x[0] - p[1] * x[1] + u + w[0]) / own)
    return Plant(x, u, w, p, dynamics, DesignSpace(["k", "c"], [1.0, 0.1], [10.0, 2.0]), dt=0.1)


@pytest.fixture(scope="module")
def model():
    """As accurate for every mass."""
    return discretise(spring(), X=X, U=U, W=([-1.5, -0.4], [1.5, 0.4]))


@pytest.mark.parametrize("theta", [-0.4, -0.17, 0.0, 0.4])
def test_every_mass_is_integrated_as_accurately_as_promised(model, theta, rng):
    assert isinstance(model, SampledModel)
    exact = discretise(spring(1 + theta))
    x, u, w = rng.uniform(*X, (500, 2)), rng.uniform(*U, (500, 1)), rng.uniform(-1.5, 1.5, (500, 1))
    for p in exact.design.spread():
        wanted = exact.stepper(p, batch=500)(x, u, w)
        found = model.stepper(p, batch=500)(x, u, np.c_[w, np.full(500, theta)])
        assert (np.abs(found - wanted) <= model.error.bound).all()


def test_a_run_has_one_mass_and_it_is_that_of_its_disturbance(model, rng):
    w = DISTURBANCE.sample(3, 30, rng)
    law = lambda x: -x[..., :1]  # noqa: E731
    runs = simulate(model, law, x0=[0.5, 0.0], steps=30, disturbance=w, design=P)
    for i, theta in enumerate(w[:, 0, 1]):
        exact = discretise(spring(1 + theta))
        alone = simulate(exact, law, x0=[0.5, 0.0], steps=30, disturbance=w[i, :, :1], design=P)
        np.testing.assert_allclose(runs.states[i], alone.states[0], atol=1e-4)


def test_a_study_is_as_accurate_for_every_mass_it_draws():
    study = Study(
        "spring", "A spring", spring(), X, U, QuadraticObjective(np.diag([10.0, 1.0]), [[0.1]]),
        Stacked((Gaussian([0.3]), Constant(Uniform([-0.8], [3.0])))), [0.5, 0.0], P,
    )  # fmt: skip
    assert isinstance(study.model, SampledModel)
    assert study.model.error.relative <= study.accuracy
    x, u = np.array([[1.0, 3.0]]), np.array([[5.0]])
    for theta in (-0.79, 2.9):
        exact = discretise(spring(1 + theta)).stepper(P, batch=1)(x, u, np.zeros((1, 1)))
        found = study.model.stepper(P, batch=1)(x, u, np.array([[0.0, theta]]))
        assert (np.abs(found - exact) <= study.model.error.bound).all()


@pytest.mark.slow
def test_a_codesign_on_the_uncertain_mass_is_better_on_masses_it_has_not_met():
    from benchmarks.uncertain_mass import PLANTS, for_mean_mass, found, measured

    stated, first = PLANTS["absorber, 2 parameters"]
    absorber = stated()
    config = CoDesignConfig(iterations=120, pathwise_runs=128)
    mean, robust = (found(each, first, config, 0) for each in (for_mean_mass(absorber), absorber))
    assert measured(absorber, mean, robust, 0).gain.ci95[0] > 0
