"""The answer depends neither on units, nor on the order of rows or states, nor on rows that say nothing new."""

import numpy as np
import pytest

from invariant_sets import (
    AdmissibleInputs,
    Polytope,
    Status,
    controllable_set,
    maximal_control_invariant_set,
    maximal_positively_invariant_set,
    minimal_robust_positively_invariant_set,
    predecessor_set,
    reachable_set,
)

box = Polytope.from_bounds
A = np.array([[1.1, 0.4, 0.0], [-0.2, 0.9, 0.3], [0.1, 0.0, 0.7]])
B = np.array([[0.3, 0.0], [1.0, 0.2], [0.1, 0.8]])
STABLE = np.array([[0.8, 0.3, 0.0], [-0.3, 0.7, 0.2], [0.1, 0.0, 0.5]])
C = np.array([[1.0, 0.5, -0.3]])
X = box([-4, -3, -2], [3, 3, 4])
U = box([-1, -0.5], [0.8, 0.6])
W = box([-0.02, -0.03, -0.01], [0.02, 0.01, 0.02])
Y = box([-1], [0.7])
TARGET = Polytope(np.vstack([np.eye(3), -np.eye(3), [[1.0, 1, 1]]]), [0.5, 0.5, 0.5, 0.4, 0.6, 0.3, 0.8])

RECURSIONS = {
    "control invariant": lambda p: maximal_control_invariant_set(p.A, p.B, p.X, p.U),
    "robust control invariant": lambda p: maximal_control_invariant_set(p.A, p.B, p.X, p.U, W=p.W),
    "positively invariant": lambda p: maximal_positively_invariant_set(p.stable, p.X),
    "output admissible": lambda p: maximal_positively_invariant_set(p.stable, Y, C=p.C),
    "minimal robust": lambda p: minimal_robust_positively_invariant_set(p.stable, p.W, eps=0.2),
    "predecessor": lambda p: predecessor_set(p.A, p.B, p.target, p.U, X=p.X),
    "controllable": lambda p: controllable_set(p.A, p.B, p.X, p.U, p.target, 3),
    "robustly controllable": lambda p: controllable_set(p.A, p.B, p.X, p.U, p.target, 2, W=p.W),
    "reachable": lambda p: reachable_set(p.A, p.B, p.target, p.U, 2, X=p.X),
}


class Plant:
    """The plant with x' = T x and u' = S u, and its sets with other rows that describe the same points."""

    def __init__(self, T=None, S=None, rows=lambda P: P):
        T = np.eye(3) if T is None else T
        S = np.eye(2) if S is None else S
        back = np.linalg.inv(T)
        self.T = T
        self.A, self.B, self.stable, self.C = T @ A @ back, T @ B @ np.linalg.inv(S), T @ STABLE @ back, C @ back
        self.X, self.W, self.target = (rows(P.affine_map(T)) for P in (X, W, TARGET))
        self.U = rows(U.affine_map(S))


@pytest.fixture(scope="module")
def natural():
    return {name: call(Plant()) for name, call in RECURSIONS.items()}


def assert_same(name, natural, plant):
    """Check that the set of a changed plant, taken back to the natural coordinates, is the natural one."""
    result = RECURSIONS[name](plant)
    assert result.status is natural[name].status is Status.CONVERGED
    assert result.certificate.holds
    assert result.set.affine_map(np.linalg.inv(plant.T)).equals(natural[name].set, 2e-7 if "robust" in name else 1e-7)


def shuffled(P):
    order = np.random.default_rng(3).permutation(len(P.b))
    return Polytope(P.A[order] * 7.0, P.b[order] * 7.0)


def duplicated(P):
    return Polytope(np.vstack([P.A, 3 * P.A[:2], P.A[-1:]]), np.concatenate([P.b, 3 * P.b[:2], P.b[-1:]]))


def with_far_rows(P):
    direction = np.abs(P.A[0]) + 0.3 * np.abs(P.A[-1])
    return Polytope(np.vstack([P.A, direction, -direction]), np.concatenate([P.b, [1e15], [1e7]]))


def weakly_redundant(P):
    """Return P with a row that touches it in a vertex only."""
    direction = P.A[0] + 0.5 * P.A[1] + 0.1 * P.A[-1]
    return Polytope(np.vstack([P.A, direction]), np.append(P.b, P.support(direction)))


@pytest.mark.long
@pytest.mark.parametrize("rows", [shuffled, duplicated, with_far_rows, weakly_redundant])
@pytest.mark.parametrize("name", RECURSIONS)
def test_rows_that_say_the_same_give_the_same_set(name, rows, natural):
    assert_same(name, natural, Plant(rows=rows))


STATES = {
    "one small": np.diag([1e-8, 1.0, 1.0]),
    "one large": np.diag([1.0, 1e8, 1.0]),
    "both": np.diag([1e8, 1.0, 1e-8]),
    "all small": 1e-8 * np.eye(3),
    "permuted": np.eye(3)[[2, 0, 1]],
    "sheared": np.array([[1.0, 2.0, 0.0], [0.0, 1.0, -3.0], [0.0, 0.0, 1.0]]),
    "sheared and scaled": np.diag([1e4, 1.0, 1e-4]) @ np.array([[1.0, 0.7, 0.0], [0.2, 1.0, -0.5], [0.0, 0.4, 1.0]]),
}


@pytest.mark.parametrize("change", STATES)
@pytest.mark.parametrize("name", RECURSIONS)
def test_other_state_coordinates_give_the_same_set(name, change, natural):
    assert_same(name, natural, Plant(T=STATES[change]))


@pytest.mark.parametrize("units", [(1e-8, 1.0), (1.0, 1e8), (1e8, 1e-8)])
@pytest.mark.parametrize("name", ["control invariant", "robust control invariant", "controllable", "reachable"])
def test_other_input_units_give_the_same_set(name, units, natural):
    assert_same(name, natural, Plant(S=np.diag(units)))


@pytest.mark.parametrize("units", [(1e-8, 1.0), (1e8, 1e-8)])
def test_a_filter_gives_the_same_inputs_in_other_units(units, natural, rng):
    S, T = np.diag(units), np.diag([1e5, 1.0, 1e-5])
    plain, scaled = Plant(), Plant(T=T, S=S)
    safe = natural["control invariant"].set
    x, proposed = X.sample(40, rng=rng), U.scale(2.0).sample(40, rng=rng)
    u, admissible = AdmissibleInputs(plain.A, plain.B, safe, plain.U).project(x, proposed)
    other, verdict = AdmissibleInputs(scaled.A, scaled.B, safe.affine_map(T), scaled.U).project(x @ T, proposed @ S)
    assert admissible.any()
    assert (admissible == verdict).all()
    assert abs(other @ np.linalg.inv(S) - u).max() <= 1e-6
