"""The inputs that keep the next state in a set."""

import copy
import pickle

import numpy as np
import pytest
from scipy.optimize import linprog, minimize_scalar
from set_plants import ILLUSTRATIVE_U, ILLUSTRATIVE_X, SUSPENSION_U, SUSPENSION_X, illustrative, suspension

from invariant_sets import AdmissibleInputFamily, AdmissibleInputs, Polytope, maximal_control_invariant_set


@pytest.fixture
def one_input():
    A, B = illustrative(1.0)
    C = maximal_control_invariant_set(A, B, ILLUSTRATIVE_X, ILLUSTRATIVE_U).set
    return A, B, C, AdmissibleInputs(A, B, C, ILLUSTRATIVE_U)


def test_every_state_of_an_invariant_set_has_an_admissible_input(one_input, rng):
    A, B, C, inputs = one_input
    x = np.vstack([C.vertices, C.sample(500, rng=rng)])
    u, admissible = inputs.project(x, rng.uniform(-3, 3, (len(x), 1)))
    assert admissible.all()
    assert C.contains(x @ A.T + u @ B.T, tol=1e-8).all()
    assert (np.abs(u) <= 1 + 1e-12).all()


def test_an_admissible_proposal_is_left_alone(one_input, rng):
    A, B, C, inputs = one_input
    x, proposed = C.sample(300, rng=rng), rng.uniform(-1, 1, (300, 1))
    stays = C.contains(x @ A.T + proposed @ B.T, tol=0.0)
    u, _ = inputs.project(x, proposed)
    np.testing.assert_allclose(u[stays], proposed[stays], atol=1e-14)
    assert 0 < stays.sum() < 300


def test_projection_is_the_nearest_admissible_input(one_input, rng):
    _, _, C, inputs = one_input
    x = C.sample(50, rng=rng)
    u, _ = inputs.project(x, np.full((50, 1), 5.0))
    for xi, ui in zip(x, u):
        assert ui[0] == pytest.approx(inputs.at(xi).bounding_box()[1][0], abs=1e-7)


def test_without_an_admissible_input_the_scaled_violation_is_least(one_input, rng):
    A, B, C, inputs = one_input
    width = np.abs(C.A) @ np.ptp(C.vertices, axis=0)
    for x in rng.uniform(-30, 30, (40, 2)):
        u, admissible = inputs.project(x, [0.3])

        def violation(v, x=x):
            return ((C.A @ (A @ x + B[:, 0] * v) - C.b) / width).max()

        best = minimize_scalar(violation, bounds=(-1, 1), method="bounded", options={"xatol": 1e-10})
        least = min(best.fun, violation(-1.0), violation(1.0))
        if admissible:
            assert least <= 1e-8
        else:
            assert violation(u[0]) <= least + 1e-7
            assert abs(u[0]) <= 1 + 1e-12


def test_several_inputs_project_like_a_quadratic_program(rng):
    A = np.array([[1.1, 0.3, 0.0], [0.0, 0.9, 0.4], [0.2, 0.0, 1.05]])
    B = rng.normal(size=(3, 2))
    U = Polytope.from_vertices([[-100.0, 0], [100, 1], [0, -2], [50, 2]])
    S = Polytope.from_bounds([-1, -2, -3], [1, 2, 3])
    inputs = AdmissibleInputs(A, B * [0.01, 1], S, U)
    lower, upper = U.bounding_box()
    x, proposed = rng.uniform(-3, 3, (60, 3)), rng.uniform(lower, upper, (60, 2))
    u, admissible = inputs.project(x, proposed)
    assert 5 < admissible.sum() < 55
    assert U.contains(u, tol=1e-8).all()
    for k in range(60):
        rows, right = np.vstack([S.A @ (B * [0.01, 1]), U.A]), np.append(S.b - S.A @ A @ x[k], U.b)
        feasible = linprog([0, 0], A_ub=rows, b_ub=right, bounds=(None, None)).status == 0
        assert feasible == admissible[k]
        if feasible:  # variational inequality: no admissible point lies on the near side of the plane through u
            gradient = (u[k] - proposed[k]) / ((upper - lower) / 2) ** 2
            answer = linprog(gradient, A_ub=rows, b_ub=right, bounds=(None, None))
            assert answer.fun >= gradient @ u[k] - 1e-6


@pytest.mark.parametrize("size", [1e3, 1e9, 1e30, 1e300])
def test_a_diverged_state_gives_an_input_in_U_and_a_flag(size, one_input):
    u, admissible = one_input[3].project([size, -size], [1e300])
    assert not admissible
    assert abs(u[0]) <= 1.0


def test_suspension_inputs_of_a_thousand_newton_are_filtered_in_their_own_units(rng):
    A, B = suspension((27692.0, 1906.5))
    C = maximal_control_invariant_set(A, B, SUSPENSION_X, SUSPENSION_U).set
    x = C.sample(300, rng=rng)
    u, admissible = AdmissibleInputs(A, B, C, SUSPENSION_U).project(x, rng.uniform(-2000, 2000, (300, 1)))
    assert admissible.all()
    assert C.contains(x @ A.T + u @ B.T, tol=1e-8).all()
    assert np.abs(u).max() == pytest.approx(1000)


@pytest.mark.parametrize("seed", range(40))
def test_random_filters_agree_with_a_linear_program(seed):
    """Scales from 1e-3 to 1e3, one to three inputs, flat and shifted U, with and without a disturbance."""
    rng = np.random.default_rng(seed)
    n, m = int(rng.integers(1, 4)), int(rng.integers(1, 4))
    s, us = 10 ** rng.uniform(-3, 3, n), 10 ** rng.uniform(-2, 3, m)
    A, B = rng.normal(size=(n, n)) * s[:, None] / s, rng.normal(size=(n, m)) * s[:, None] / us
    S = Polytope.from_vertices(rng.normal(size=(3 * n + 2, n)) * s)
    U = Polytope.from_bounds(-us * (rng.random(m) > 0.2), us * rng.random(m))
    W = Polytope.from_bounds(-0.05 * s, 0.05 * s) if seed % 3 == 0 else None
    tightened = S if W is None else S.pontryagin_difference(W)
    x, proposed = rng.normal(size=(12, n)) * s, rng.normal(size=(12, m)) * us
    u, admissible = AdmissibleInputs(A, B, S, U, W=W).project(x, proposed)
    assert U.contains(u, tol=1e-7).all()
    assert not admissible.any() or tightened.contains((x @ A.T + u @ B.T)[admissible], tol=1e-7).all()
    lower, upper = U.bounding_box()
    size = np.abs(S.A) @ s
    for k in range(12):
        right = (tightened.b - S.A @ A @ x[k]) / size
        bounds = list(zip(lower / us, upper / us))
        answer = linprog(np.zeros(m), A_ub=S.A @ B * us / size[:, None], b_ub=right, bounds=bounds)
        assert (answer.status == 0) == admissible[k]


@pytest.mark.parametrize("inputs", [1, 2])
def test_a_family_of_filters_gives_what_each_filter_gives_alone(inputs, rng):
    filters = []
    for _ in range(6):
        A, B = rng.normal(size=(3, 3)), rng.normal(size=(3, inputs))
        S = Polytope.from_vertices(rng.normal(size=(rng.integers(6, 15), 3)))
        filters.append(AdmissibleInputs(A, B, S, Polytope.from_bounds(-np.ones(inputs), rng.uniform(0.1, 2, inputs))))
    x, proposed = rng.normal(size=(6, 3)), rng.normal(size=(6, inputs)) * 3
    u, admissible = AdmissibleInputFamily(filters).project(x, proposed)
    for k, one in enumerate(filters):
        alone, verdict = one.project(x[k], proposed[k])
        np.testing.assert_allclose(u[k], alone, atol=1e-12)
        assert admissible[k] == verdict


def test_a_filter_is_read_only_and_survives_pickle_and_deepcopy(one_input):
    inputs = one_input[3]
    with pytest.raises(AttributeError):
        inputs.S = inputs.U
    for twin in (pickle.loads(pickle.dumps(inputs)), copy.deepcopy(inputs)):
        np.testing.assert_array_equal(twin.project([1.0, 1.0], [3.0])[0], inputs.project([1.0, 1.0], [3.0])[0])
    assert len(repr(inputs)) < 100
