"""The reward, and weights that are none."""

from contextlib import nullcontext

import numpy as np
import pytest
import torch

from ccdtools import InputError, QuadraticObjective


def test_the_reward_is_minus_the_quadratic_form_of_the_next_state_and_the_input(rng):
    Q, R = np.array([[2.0, 0.5], [0.5, 1.0]]), np.array([[0.1]])
    x, u = rng.standard_normal((4, 5, 2)), rng.standard_normal((4, 5, 1))
    expected = -np.einsum("...i,ij,...j", x, Q, x) - np.einsum("...i,ij,...j", u, R, u)
    objective = QuadraticObjective(Q, R)
    np.testing.assert_allclose(objective.rewards(x, u), expected)
    torch.testing.assert_close(objective.rewards(torch.tensor(x), torch.tensor(u)), torch.tensor(expected))


def test_torch_rewards_keep_their_gradient():
    x = torch.tensor([[1.0, -2.0]], requires_grad=True)
    objective = QuadraticObjective(np.diag([3.0, 1.0]), [[1.0]])
    (gradient,) = torch.autograd.grad(objective.rewards(x, torch.zeros(1, 1)).sum(), x)
    torch.testing.assert_close(gradient, torch.tensor([[-6.0, 4.0]]))


def test_weights_are_copied_and_read_only():
    Q = np.eye(2)
    objective = QuadraticObjective(Q, 0.1)
    Q[0, 0] = 9
    assert objective.Q[0, 0] == 1
    with pytest.raises(ValueError, match="read-only"):
        objective.Q[0, 0] = 2


@pytest.mark.parametrize("size", [1e-6, 1.0, 1e6])
@pytest.mark.parametrize(("miss", "allowed"), [(3e-10, True), (3e-9, False)])
def test_a_weight_may_be_asymmetric_or_negative_by_rounding_in_any_unit(size, miss, allowed):
    units = np.diag([1.0, size])
    negative = units @ [[1.0, 1.0 + miss], [1.0 + miss, 1.0]] @ units
    for weight in (negative, [[size, miss * size], [0.0, size]]):
        with nullcontext() if allowed else pytest.raises(InputError, match="Q: got"):
            QuadraticObjective(weight, 0.1)


def test_a_semidefinite_state_weight_is_allowed():
    assert QuadraticObjective(np.diag([1.0, 0.0]), [[1.0]]).Q[1, 1] == 0


@pytest.mark.parametrize(
    ("Q", "R", "message"),
    [
        (np.ones((2, 3)), [[1]], r"Q: got shape \(2, 3\), expected \(2, 2\)"),
        ([[np.nan]], [[1]], "Q: got (nan|-?inf) at index"),
        ([[1, 1], [0, 1]], [[1]], r"Q: got max \|Q - Q'\| = 1, expected a symmetric matrix"),
        ([[-1]], [[1]], r"Q: got a negative direction \(scaled eigenvalue -1\), expected Q ⪰ 0"),
        ([[1]], [[-1]], r"R: got a negative direction \(scaled eigenvalue -1\), expected R ⪰ 0"),
        ([[1]], np.ones((1, 2)), "R: got shape"),
    ],
)
def test_weights_that_are_none_are_refused(Q, R, message):
    with pytest.raises(InputError, match=message):
        QuadraticObjective(Q, R)
