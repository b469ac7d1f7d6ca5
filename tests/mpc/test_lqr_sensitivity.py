"""Derivatives of gain and cost of the regulator are those of SciPy's Riccati solver, by differences, in any units."""

import numpy as np
import pytest
from differences import distance, slopes
from plants import suspension
from scipy.linalg import solve_discrete_are

from mpc import InputError, NotConvexError, NotStabilisableError, lqr, lqr_sensitivity

REQUIRED = 1e-6


def by_scipy(A, B, Q, R, S):
    """Gain and cost, of the equation alone."""
    P = solve_discrete_are(A, B, Q, R, s=S)
    return np.linalg.solve(R + B.T @ P @ B, B.T @ P @ A + S.T), P


def random_family(seed, nx, nu, count):
    """Matrices at p = 0, and how each changes with p."""
    rng = np.random.default_rng(seed)
    at = {"A": 1.5 * rng.normal(size=(nx, nx)) / np.sqrt(nx), "B": rng.normal(size=(nx, nu)), "Q": 10 * np.eye(nx),
          "R": 10 * np.eye(nu), "S": rng.normal(size=(nx, nu))}  # fmt: skip
    changes = {name: rng.normal(size=(*matrix.shape, count)) for name, matrix in at.items()}
    for name in "QR":
        changes[name] = changes[name] + changes[name].swapaxes(0, 1)
    return at, changes


@pytest.mark.parametrize(("nx", "nu"), [(1, 1), (4, 2), (12, 3)])
@pytest.mark.parametrize("seed", range(3))
def test_derivatives_of_everything_at_once_are_those_of_differences(nx, nu, seed):
    at, changes = random_family(seed, nx, nu, 4)
    found = lqr_sensitivity(**at, **{f"d{name}": change for name, change in changes.items()})

    def moved(which):
        return lambda p: by_scipy(*(at[name] + changes[name] @ p for name in "ABQRS"))[which]

    assert distance(found.dK, slopes(moved(0), np.zeros(4), [1e-4] * 4)) < REQUIRED
    assert distance(found.dP, slopes(moved(1), np.zeros(4), [1e-4] * 4)) < REQUIRED
    x = np.arange(1.0, nx + 1)
    assert found.cost(x) == pytest.approx(x @ moved(1)(np.zeros(4)) @ x)
    assert found.cost_by_parameters(x) == pytest.approx(
        slopes(lambda p: x @ moved(1)(p) @ x, np.zeros(4), [1e-4] * 4), rel=REQUIRED
    )


SPRING, DAMPER = 27692.0, 1906.5


def suspension_family():
    """The quarter car, with spring and damper as parameters: its matrices and, by differences, their derivatives."""

    def matrices(p):
        A, B, _ = suspension(*p)
        return np.hstack([A, B])

    p = np.array([SPRING, DAMPER])
    changes = slopes(matrices, p, 1e-3 * p)
    return p, matrices, changes[:, :4], changes[:, 4:]


@pytest.mark.parametrize("length", [1.0, 1e3, 1e6])
@pytest.mark.parametrize("force", [1.0, 1e-3])
def test_units_do_not_matter(length, force):
    p, matrices, dA, dB = suspension_family()
    Q, R = np.diag([10.0, 1.0, 50.0, 5.0]), np.array([[1e-6]])
    sx, su = length, force
    A, B = np.split(matrices(p), [4], axis=1)
    found = lqr_sensitivity(A, B * sx / su, Q=Q / sx**2, R=R / su**2, dA=dA, dB=dB * sx / su)
    x = np.array([0.01, 0.1, -0.05, 0.2])

    def cost(q):
        A, B = np.split(matrices(q), [4], axis=1)
        return x @ by_scipy(A, B, Q, R, np.zeros((4, 1)))[1] @ x

    assert found.cost_by_parameters(sx * x) == pytest.approx(slopes(cost, p, 3e-3 * p), rel=REQUIRED)
    assert found.input_by_state * sx / su == pytest.approx(-lqr(A, B, Q=Q, R=R)[0], rel=1e-9)


def test_noise_costs_what_its_covariance_says():
    at, changes = random_family(1, 3, 1, 2)
    rng = np.random.default_rng(5)
    E = rng.normal(size=(3, 2))
    dE = rng.normal(size=(3, 2, 2))
    found = lqr_sensitivity(**at, **{f"d{name}": change for name, change in changes.items()})
    dW = np.einsum("xwp,yw->xyp", dE, E) + np.einsum("xw,ywp->xyp", E, dE)

    def cost(p):
        moved = E + dE @ p
        return np.trace(by_scipy(*(at[name] + changes[name] @ p for name in "ABQRS"))[1] @ moved @ moved.T)

    assert found.noise_cost(E @ E.T) == pytest.approx(cost(np.zeros(2)))
    expected = slopes(cost, np.zeros(2), [1e-4] * 2)
    assert found.noise_cost_by_parameters(E @ E.T, dW) == pytest.approx(expected, rel=REQUIRED)


def test_nearly_marginal_loops_keep_their_digits():
    A, B = np.diag([1.0, 0.9]), np.array([[1e-5], [1.0]])
    Q, R = np.diag([1.0, 1.0]), np.eye(1)  # a closed-loop pole 1e-5 inside the unit circle
    found = lqr_sensitivity(A, B, Q=Q, R=R, dB=np.array([[[1.0]], [[0.0]]]))

    def cost(p):
        return by_scipy(A, B + np.array([[p[0]], [0]]), Q, R, np.zeros((2, 1)))[1]

    expected = slopes(cost, np.zeros(1), [1e-9])
    assert distance(found.dP, expected) < 1e-5


def test_parameters_that_change_nothing_have_no_effect_and_none_are_legal():
    at, _ = random_family(0, 3, 1, 1)
    assert lqr_sensitivity(**at).dK.shape == (1, 3, 0)
    assert not lqr_sensitivity(**at, dA=np.zeros((3, 3, 2))).dP.any()


@pytest.mark.parametrize(
    ("change", "error", "message"),
    [
        ({"dA": np.ones((3, 3))}, InputError, r"dA: got shape \(3, 3\), expected \(3, 3, np\).* dA\[\.\.\., None\]"),
        ({"dA": np.ones((3, 3, 2)), "dB": np.ones((3, 1, 1))}, InputError, r"dB: got shape \(3, 1, 1\)"),
        ({"dA": np.full((3, 3, 1), np.nan)}, InputError, "dA: got nan"),
        ({"dQ": np.arange(9.0).reshape(3, 3, 1)}, InputError, "dQ: got max"),
        ({"A": np.diag([1.2, 0.5, 0.5]), "B": [[0.0], [1.0], [1.0]]}, NotStabilisableError, "cannot be stabilised"),
        ({"Q": np.diag([1.0, -1.0, 1.0])}, NotConvexError, "Q: got a negative direction"),
    ],
)
def test_bad_input_is_named(change, error, message):
    at, _ = random_family(0, 3, 1, 1)
    del at["S"]
    with pytest.raises(error, match=message):
        lqr_sensitivity(**(at | change))


def test_a_state_of_another_size_is_named():
    at, _ = random_family(0, 3, 1, 1)
    with pytest.raises(InputError, match=r"x: got shape \(2,\)"):
        lqr_sensitivity(**at).cost_by_parameters([1.0, 2.0])
