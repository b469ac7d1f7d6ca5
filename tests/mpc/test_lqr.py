"""The regulator: agreement with python-control, and every way a pair can be unusable."""

import control
import numpy as np
import pytest
from adversarial_regulator import agrees, judged, oracle, out_of_reach, pair, pole_on_a_cart, unseen, weights
from plants import double_integrator, suspension

from mpc import InputError, NotConvexError, NotStabilisableError, lqr


@pytest.mark.parametrize("seed", range(10))
def test_agrees_with_dlqr(seed):
    rng = np.random.default_rng(seed)
    A, B = rng.normal(size=(4, 4)), rng.normal(size=(4, 2))
    K, P = lqr(A, B, Q=np.eye(4), R=0.1 * np.eye(2))
    K_ref, P_ref, _ = control.dlqr(A, B, np.eye(4), 0.1 * np.eye(2))
    np.testing.assert_allclose(K, K_ref, rtol=1e-7, atol=1e-9)
    np.testing.assert_allclose(P, P_ref, rtol=1e-7, atol=1e-9)


def test_units_do_not_matter():
    A, B, _ = suspension()
    Q, R = np.diag([10.0, 1.0, 50.0, 5.0]), np.array([[1e-6]])
    K, _ = lqr(A, B, Q=Q, R=R)
    sx, su = np.array([1e6, 1e-6, 1e3, 1.0]), 1e5
    K_scaled, _ = lqr(A * sx[:, None] / sx, B * sx[:, None] / su, Q=Q / np.outer(sx, sx), R=R / su**2)
    np.testing.assert_allclose(K_scaled * sx / su, K, rtol=1e-6)


def test_takes_a_state_space():
    A, B = double_integrator()
    K, _ = lqr(control.ss(A, B, np.eye(2), 0, 1.0), Q=np.eye(2), R=[[1.0]])
    np.testing.assert_allclose(K, lqr(A, B, Q=np.eye(2), R=[[1.0]])[0])


def test_singular_R_is_legal():
    A, B = double_integrator()
    K, _ = lqr(A, B, Q=np.eye(2), R=[[0.0]])
    assert np.abs(np.linalg.eigvals(A - B @ K)).max() < 1


@pytest.mark.parametrize("b", [0.0, 1e-9])
def test_unstabilisable_and_nearly_unstabilisable_pairs_are_refused(b):
    message = r"cannot be stabilised, the input reaches the mode at eigenvalue 1\.1"
    with pytest.raises(NotStabilisableError, match=message) as caught:
        lqr(np.diag([1.1, 0.5]), [[b], [1.0]], Q=np.eye(2), R=[[1.0]])
    assert caught.value.eigenvalue == pytest.approx(1.1)


def test_a_mode_on_the_unit_circle_without_cost_is_refused():
    with pytest.raises(NotStabilisableError, match="Q: got no weight on the mode at eigenvalue 1"):
        lqr([[1.0]], [[1.0]], Q=[[0.0]], R=[[1.0]])


@pytest.mark.parametrize("kind", ["plain", "zeros", "Q = 0", "dense"])
def test_weights_over_14_decades_are_regulated_as_in_200_digits(kind):
    rng = np.random.default_rng([3, len(kind)])
    for _ in range(3):
        A, B = pair(rng)
        assert judged(A, B, *weights(rng, *B.shape, kind)).startswith("right")


def test_the_weights_do_not_say_what_a_force_reaches():
    A, B = pole_on_a_cart()
    Q, R = np.diag([1.0, 1e-8, 1.0, 1e-8]), np.eye(1)
    assert agrees(*lqr(A, B, Q=Q, R=R), oracle(A, B, Q, R), Q, R)


def test_of_several_modes_the_one_out_of_reach_is_named():
    rng = np.random.default_rng(0)
    for _ in range(6):
        A, B, modes = out_of_reach(rng)
        if modes:
            assert judged(A, B, *weights(rng, *B.shape, "plain"), modes) == "rightly refused"
        A, B, Q = unseen(rng)
        assert judged(A, B, Q, np.eye(B.shape[1]), [1.0]) == "rightly refused"


@pytest.mark.parametrize("A", [np.diag([0.5, -0.9]), np.array([[0.0, 1.0], [0.0, 0.0]]), [[0.3, 5.0], [0.0, 0.3]]])
def test_without_a_weight_a_stable_plant_is_left_alone(A):
    K, P = lqr(A, [[1.0], [1.0]], Q=0.0, R=1.0)
    np.testing.assert_array_equal(K, np.zeros((1, 2)))
    np.testing.assert_array_equal(P, np.zeros((2, 2)))


@pytest.mark.parametrize(
    ("change", "error", "message"),
    [
        ({"A": [[1.0, np.nan], [0.0, 1.0]]}, InputError, r"A: got nan at index \(0, 1\)"),
        ({"A": np.ones((2, 3))}, InputError, r"A: got shape \(2, 3\), expected a square"),
        ({"A": "x"}, InputError, "A: got '.*, expected numbers of shape"),
        ({"B": np.ones((3, 1))}, InputError, r"B: got shape \(3, 1\), expected \(2, any\)"),
        ({"B": np.ones((2, 0))}, InputError, "at least one input"),
        ({"B": None}, InputError, "B: got nothing"),
        ({"Q": np.eye(3)}, InputError, r"Q: got shape \(3, 3\), expected \(2, 2\)"),
        ({"Q": [[1.0, 2.0], [0.0, 1.0]]}, NotConvexError, "Q: got max .* expected a symmetric"),
        ({"Q": np.diag([1.0, -1.0])}, NotConvexError, "Q: got a negative direction"),
        ({"R": [[-1.0]]}, NotConvexError, "R: got a negative direction"),
    ],
)
def test_bad_input_is_named(change, error, message):
    A, B = double_integrator()
    data = {"A": A, "B": B, "Q": np.eye(2), "R": np.eye(1)} | change
    with pytest.raises(error, match=message):
        lqr(data["A"], data["B"], Q=data["Q"], R=data["R"])


def test_a_continuous_state_space_is_refused():
    A, B = double_integrator()
    with pytest.raises(InputError, match="expected a discrete-time system"):
        lqr(control.ss(A, B, np.eye(2), 0), Q=np.eye(2), R=[[1.0]])
