"""Draws in closed loop have the log's answer to error and state, and so its spread."""

from dataclasses import replace

import casadi as ca
import numpy as np
import pytest
import torch
from scipy.linalg import solve_discrete_lyapunov

from ccdtools import DesignSpace, LinearFeedback, Plant, discretise, simulate
from ccdtools.twin.discrepancy import Discrepancy, TwinPlant
from ccdtools.twin.loop_moments import matched_in_the_loop
from ccdtools.twin.residuals import residuals
from learning import fit_copula
from learning.copula_fit import regression
from learning.quantile import QuantileNetwork

P = [1.0]
LAW = LinearFeedback([[0.3, 0.2]], [-50.0], [50.0])
MEMORY = 0.6


def plant():
    """Two slow states, one input; every state has a disturbance."""
    x, u, w, p = ca.SX.sym("x", 2), ca.SX.sym("u"), ca.SX.sym("w", 2), ca.SX.sym("p")
    after = ca.vertcat(0.95 * x[0] + 0.1 * x[1], 0.9 * x[1] + p * u) + w
    return Plant(x, u, w, p, after, DesignSpace(["b"], [0.5], [2.0]), dt=1.0, continuous=False)


@pytest.fixture(scope="module")
def log():
    """A log under skewed noise of first order that one signal drives."""
    rng = np.random.default_rng(0)
    w = np.zeros((1, 20000, 1))
    for k in range(1, 20000):
        w[:, k] = MEMORY * w[:, k - 1] + rng.exponential() - 1
    return simulate(plant(), LAW, x0=np.zeros(2), steps=20000, disturbance=w * [0.1, -0.2], design=P)


def drawing(errors, *, answer):
    """Draws of the log's margins around constant quantiles, their mean with or without the log's answer."""
    network = QuantileNetwork(5, 2, (0.1, 0.5, 0.9), (4,))
    for parameter in network.parameters():
        torch.nn.init.zeros_(parameter)
    network.output_scale.copy_(torch.tensor(errors.e_next.std(axis=(0, 1))))
    made = Discrepancy(network, np.eye(2))
    inputs = made.inputs_of([errors])
    copula = fit_copula(network, inputs, errors.e_next[0])
    if not answer:
        copula.slope.zero_()
    return replace(made, copula=copula, noise="quantiles")


def spread(model, discrepancy):
    """Standard deviations of the states of a long simulation with draws."""
    w = np.random.default_rng(3).random((200, 300, 2))
    run = simulate(TwinPlant(model, discrepancy), LAW, x0=np.zeros((200, 2)), steps=300, disturbance=w, design=P)
    return run.states[:, 60:].std(axis=(0, 1))


def test_a_linear_answer_and_what_it_leaves_give_the_spread_of_the_loop(log):
    # the identity that the matching rests on, by a Lyapunov equation in (x, e)
    model = discretise(plant())
    errors = residuals(model, log)
    A, B, _ = model.matrices(P)
    slope, mean = regression(np.hstack([errors.e[0], errors.x[0]]), errors.e_next[0])
    left = errors.e_next[0] - mean - (np.hstack([errors.e[0], errors.x[0]])) @ slope
    onto_e, onto_x = slope[:2].T, slope[2:].T
    closed = A - B @ LAW.K
    F = np.block([[closed + onto_x, onto_e], [onto_x, onto_e]])
    G = np.vstack([np.eye(2), np.eye(2)])
    S = solve_discrete_lyapunov(F, G @ np.cov(left.T) @ G.T)
    np.testing.assert_allclose(np.sqrt(np.diag(S))[:2], errors.x[0].std(axis=0), rtol=0.03)


def test_a_mean_that_answers_nothing_is_moved_until_draws_spread_as_the_log(log):
    model = discretise(plant())
    errors = residuals(model, log)
    true = errors.x[0].std(axis=0)
    deaf = drawing(errors, answer=False)
    assert (spread(model, deaf) < 0.75 * true).any()
    found = matched_in_the_loop(deaf, model, [errors], np.random.default_rng(1))
    np.testing.assert_allclose(spread(model, replace(deaf, copula=found)), true, rtol=0.08)


def test_a_mean_that_is_right_is_left_about_as_it_is_by_any_generator(log):
    model = discretise(plant())
    errors = residuals(model, log)
    right = drawing(errors, answer=True)
    a, b = (matched_in_the_loop(right, model, [errors], np.random.default_rng(2)) for _ in range(2))
    torch.testing.assert_close(a.slope, b.slope)
    np.testing.assert_allclose(spread(model, replace(right, copula=a)), errors.x[0].std(axis=0), rtol=0.08)


def test_draws_that_the_loop_does_not_hold_are_left_alone(log):
    model = discretise(plant())
    errors = residuals(model, log)
    wild = drawing(errors, answer=True)
    wild.copula.slope.copy_(torch.eye(5)[:, :2] * 3.0)  # e⁺ = 3 e and more
    wild.copula.subspace.copy_(torch.eye(2))
    assert matched_in_the_loop(wild, model, [errors], np.random.default_rng(2)) is wild.copula
