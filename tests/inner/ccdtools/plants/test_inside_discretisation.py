"""What test_discretisation.py claims, seen from inside."""

import casadi as ca
import numpy as np
import pytest

from ccdtools.plants.matrix_exponential import expm, zero_order_hold


def test_the_symbolic_exponential_of_zero_is_the_identity():
    np.testing.assert_array_equal(np.asarray(ca.DM(expm(ca.SX.zeros(3, 3), squarings=0))), np.eye(3))


def test_the_exponential_of_a_nilpotent_matrix_is_its_series():
    N = ca.SX(ca.DM([[0, 2, 0], [0, 0, 3], [0, 0, 0]]))
    np.testing.assert_allclose(ca.DM(expm(N, squarings=4)), [[1, 2, 3], [0, 1, 3], [0, 0, 1]], atol=1e-14)


def test_a_constant_hold_needs_no_design():
    A, B, E = zero_order_hold(
        ca.SX(ca.DM([[-1.0]])), ca.SX(ca.DM([[1.0]])), ca.SX(1, 0), 0.5, symbols=ca.SX(0, 1), design=None
    )
    assert float(ca.DM(A)) == pytest.approx(np.exp(-0.5), rel=1e-15)
    assert float(ca.DM(B)) == pytest.approx(1 - np.exp(-0.5), rel=1e-15)
    assert E.shape == (1, 0)
