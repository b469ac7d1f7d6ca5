"""What test_preview.py claims, seen from inside."""

import numpy as np
import pytest

from ccdtools import LinearFeedback, Plant, QuadraticObjective, discretise, simulate
from ccdtools.co_design import previewed_objective
from ccdtools.co_design.preview import shifted
from ccdtools.controllers import Previewing
from ccdtools.plants import with_preview
from ccdtools.plants.library import mass_chain, pendulum_on_cart
from ccdtools.plants.preview import previewed_state
from mpc import lqr

P = [100.0, 1.0]
Q = np.diag([10.0, 3.0, 1.0, 2.0])
R = np.array([[0.1]])


def two_masses():
    """Two masses, each pushed by a disturbance of its own."""
    return mass_chain(2, disturbed=(1, 2))


def batch_optimum(A, B, E, x0, w, horizon, P_end):
    """The input at time 0 of Σ x'Qx + u'Ru over a horizon with known disturbances, by one least-squares problem."""
    nx, nu = B.shape
    G = np.zeros((horizon * nx, horizon * nu))
    free = np.zeros(horizon * nx)
    x = x0
    for k in range(horizon):
        x = A @ x + (E @ w[k] if k < len(w) else 0.0)
        free[k * nx : (k + 1) * nx] = x
        column = B
        for i in range(k, horizon):
            G[i * nx : (i + 1) * nx, k * nu : (k + 1) * nu] = column
            column = A @ column
    root = np.kron(np.eye(horizon), np.linalg.cholesky(Q))
    root[-nx:, -nx:] = np.linalg.cholesky(P_end)
    weights = np.kron(np.eye(horizon), np.linalg.cholesky(R))
    target = -np.r_[root.T @ free, np.zeros(horizon * nu)]
    return np.linalg.lstsq(np.vstack([root.T @ G, weights.T]), target, rcond=None)[0][:nu]


@pytest.mark.parametrize("channels", [None, (1,), (1, 0)])
@pytest.mark.parametrize("horizon", [20, 60])
def test_lqr_of_the_register_is_the_least_squares_plan_of_known_disturbances(channels, horizon, rng):
    model = discretise(two_masses())
    A, B, E = model.matrices(P)
    K0, P0 = lqr(A, B, Q=Q, R=R)
    known = [0, 1] if channels is None else list(channels)
    augmented = with_preview(model, 6, channels=channels).matrices(P)
    objective = previewed_objective(QuadraticObjective(Q, R), 6, channels=len(known))
    K, _ = lqr(*augmented[:2], Q=objective.Q, R=R)
    np.testing.assert_allclose(K[:, :4], K0, rtol=1e-8, atol=1e-9 * np.abs(K0).max())  # as without a preview
    for _ in range(3):
        x0 = rng.standard_normal(4)
        w = rng.standard_normal((6, 2))
        wanted = batch_optimum(A, B, E[:, known], x0, w[:, known], horizon, P0)
        np.testing.assert_allclose(-K @ previewed_state(x0, w, known), wanted, rtol=1e-6, atol=1e-8)


def augmented_run(model, plant, law, x0, w, steps, p, channels=(0, 1), ahead=5):
    """Runs of the augmented model, fed with what comes later."""
    z0 = previewed_state(x0, w[:, :ahead], channels)
    later = shifted(w, ahead, channels)
    return simulate(model, law, x0=z0, steps=steps, disturbance=later, design=p).states[..., : plant.nx]


def pendulum():
    """Not linear."""
    return pendulum_on_cart()


@pytest.mark.parametrize(("plant", "p"), [(two_masses(), P), (pendulum(), [0.6, 0.5])])
@pytest.mark.parametrize("channels", [None, (0,)])
def test_the_register_delays_and_nothing_else(plant, p, channels, rng):
    nw = plant.nw
    model = discretise(plant, X=(-1.0, 1.0), U=(-5.0, 5.0), W=(-1.0, 1.0)) if not plant.linear else discretise(plant)
    known = tuple(range(nw)) if channels is None else channels
    ahead = with_preview(model, 5, channels=channels)
    assert type(ahead) is type(model)
    assert (ahead.nx, ahead.nu, ahead.nw) == (plant.nx + 5 * len(known), plant.nu, nw)
    law = LinearFeedback(0.3 * rng.standard_normal((1, ahead.nx)))
    x0, w = 0.02 * rng.standard_normal((3, plant.nx)), 0.05 * rng.standard_normal((3, 45, nw))
    direct = simulate(model, Previewing(law, 5, channels), x0=x0, steps=45, disturbance=w, design=p).states[:, :41]
    np.testing.assert_allclose(augmented_run(ahead, plant, law, x0, w, 40, p, known), direct, rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize("real", [two_masses(), mass_chain(2, disturbed=(1, 2), real=True)])
def test_a_plant_with_a_register_steps_as_the_plant(real, rng):
    plant = with_preview(real, 5)
    assert isinstance(plant, Plant)
    assert plant.state_names[4:7] == ("w1", "w2", "w1 in 1 samples")
    law = LinearFeedback(rng.standard_normal((1, 14)), -1.0, 1.0)
    x0, w = rng.standard_normal((2, 4)), rng.standard_normal((2, 25, 2))
    direct = simulate(discretise(real) if real.linear else real, Previewing(law, 5), x0=x0, steps=25, disturbance=w,
                      design=P).states[:, :21]  # fmt: skip
    np.testing.assert_allclose(augmented_run(plant, real, law, x0, w, 20, P), direct, rtol=1e-9, atol=1e-12)
