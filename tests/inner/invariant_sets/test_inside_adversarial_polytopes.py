"""What test_adversarial_polytopes.py claims, seen from inside."""

import numpy as np
import pytest
from scipy.optimize import linprog

from invariant_sets.linear_programs import largest_ball, minimise
from invariant_sets.rational_programs import exact_optimum


def test_programs_in_rationals_agree_with_highs():
    for k in range(25):
        rng = np.random.default_rng(k)
        n = int(rng.integers(1, 5))
        A = np.vstack([rng.normal(size=(6, n)), np.eye(n), -np.eye(n)])
        b = np.append(rng.uniform(-0.3, 1, 6), np.full(2 * n, 4.0))
        c = rng.normal(size=n) * (rng.random(n) < 0.7)
        judged, exact = linprog(c, A_ub=A, b_ub=b, bounds=(None, None)), exact_optimum(c, A, b)
        assert (exact is None) == (judged.status == 2)
        if exact is not None:
            value, x, dual = exact
            assert value == pytest.approx(judged.fun, abs=1e-9)
            assert (A @ x <= b + 1e-12).all()
            assert (dual >= 0).all()
            np.testing.assert_allclose(c + dual @ A, 0, atol=1e-12)


@pytest.mark.check
def test_linear_programs_are_right_in_columns_of_any_size():
    wrong = []
    for k in range(150):
        rng = np.random.default_rng(k)
        n, m = int(rng.integers(1, 7)), int(rng.integers(1, 30))
        A, units = rng.normal(size=(m, n)), 10 ** rng.uniform(-6, 6, n)
        A /= np.linalg.norm(A, axis=1)[:, None]
        b, c = rng.uniform(-0.1, 1, m), rng.normal(size=n)
        scaled = A * units
        norms = np.linalg.norm(scaled, axis=1)
        value, x = minimise(c * units, scaled / norms[:, None], b / norms)
        status = linprog(0 * c, A_ub=A, b_ub=b, bounds=(None, None)).status
        answer = linprog(c, A_ub=A, b_ub=b, bounds=(None, None))
        expected = np.inf if status == 2 else answer.fun if answer.status == 0 else -np.inf
        if not (value == expected or abs(value - expected) <= 1e-6 * max(1.0, abs(expected))):
            wrong.append((k, value, expected))
        assert (x is None) == np.isinf(value)
    assert wrong == []


def test_verdicts_of_linear_programs_are_confirmed():
    slab = np.array([[0.13, -0.13, 0.64], [-0.13, 0.13, -0.64]]) / np.linalg.norm([0.13, -0.13, 0.64])
    assert minimise(np.array([0, -1.0, 0]), slab, np.ones(2)) == (-np.inf, None)
    assert minimise(np.array([0, -1.0, 0]), slab, -np.ones(2)) == (np.inf, None)
    assert minimise(np.zeros(3), slab, -np.ones(2)) == (np.inf, None)
    assert minimise(np.zeros(2), np.zeros((0, 2)), np.zeros(0))[0] == 0.0
    assert largest_ball(slab, -np.ones(2)).radius == pytest.approx(-1.0)
