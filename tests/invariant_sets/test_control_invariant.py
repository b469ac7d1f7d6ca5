"""Maximal control invariant sets: reference figures, and invariance checked from scratch."""

import numpy as np
import pytest
from scipy.optimize import linprog
from set_plants import ILLUSTRATIVE_U, ILLUSTRATIVE_X, SUSPENSION_U, SUSPENSION_X, illustrative, suspension

from invariant_sets import Polytope, Status, maximal_control_invariant_set


def worst_violation(A, B, C, U):
    """Return max over vertices of min over u of the violation, by HiGHS: none of the package's own code."""
    worst = -np.inf
    width = (C.A @ C.vertices.T).max(1) - (C.A @ C.vertices.T).min(1)
    for x in C.vertices:
        nu = B.shape[1]
        rows = np.block([[C.A @ B, -width[:, None]], [U.A, np.zeros((len(U.b), 1))]])
        answer = linprog(np.r_[np.zeros(nu), 1], A_ub=rows, b_ub=np.r_[C.b - C.A @ A @ x, U.b], bounds=(None, None))
        worst = max(worst, answer.x[-1])
    return worst


@pytest.mark.parametrize(("p", "area", "facets"), [(1.0, 69.4821951, 6), (2.0, 95.6964856, 5)])
def test_illustrative_set_has_the_reference_area(p, area, facets):
    result = maximal_control_invariant_set(*illustrative(p), ILLUSTRATIVE_X, ILLUSTRATIVE_U)
    assert result.status is Status.CONVERGED
    assert result.set.volume == pytest.approx(area, rel=1e-7)
    assert result.set.volume < result.outer.volume
    assert len(result.set.b) == len(result.set.vertices) == facets


def test_suspension_set_has_the_reference_facets_vertices_and_volume():
    result = maximal_control_invariant_set(*suspension((27692.0, 1906.5)), SUSPENSION_X, SUSPENSION_U)
    assert result.status is Status.CONVERGED
    assert (len(result.set.b), len(result.set.vertices)) == (24, 80)
    assert result.set.volume == pytest.approx(8.5750993, rel=1e-7)


@pytest.mark.parametrize("case", ["illustrative", "suspension", "nonsymmetric"])
def test_set_is_invariant_by_an_independent_solver(case):
    A, B, X, U = {
        "illustrative": (*illustrative(1.0), ILLUSTRATIVE_X, ILLUSTRATIVE_U),
        "suspension": (*suspension((1e4, 3000.0)), SUSPENSION_X, SUSPENSION_U),
        "nonsymmetric": (
            np.array([[1.3, 1], [0, 0.5]]),
            np.array([[0.2], [1.0]]),
            Polytope.from_bounds([-10, -10], [10, 10]),
            ILLUSTRATIVE_U,
        ),
    }[case]
    result = maximal_control_invariant_set(A, B, X, U)
    assert result.certificate.holds
    assert worst_violation(A, B, result.set, U) <= 1e-9


def test_unstable_mode_is_bounded_by_its_left_eigenvector():
    A, B = [[1.3, 1.0], [0.0, 0.5]], [[0.2], [1.0]]
    C = maximal_control_invariant_set(A, B, Polytope.from_bounds([-10, -10], [10, 10]), ILLUSTRATIVE_U).set
    v = np.array([0.8, 1.0]) / np.hypot(0.8, 1.0)  # left eigenvector of 1.3
    assert C.support(v) == pytest.approx(3.019, abs=5e-4)
    assert C.support(v) == pytest.approx(abs(v @ np.ravel(B)) / 0.3, rel=1e-7)
