"""One CasADi function, three machines: CasADi's own, NumPy, torch."""

import casadi as ca
import numpy as np
import pytest
import torch

from ccdtools import InputError
from ccdtools.plants.casadi_arrays import Vectorised

X, Y = ca.SX.sym("x"), ca.SX.sym("y")

EXPRESSIONS = {
    "arithmetic": (X + 2 * Y) / (1 + X**2) - X * Y,
    "powers": ca.vertcat(ca.fabs(X) ** 1.7, X**2, X**3, (1 + ca.fabs(X)) ** Y),
    "exponentials": ca.vertcat(ca.exp(X), ca.log(1 + X**2), ca.sqrt(1 + Y**2)),
    "trigonometry": ca.vertcat(ca.sin(X), ca.cos(Y), ca.tan(X), ca.asin(X / 9), ca.acos(Y / 9), ca.atan(X)),
    "hyperbolic": ca.vertcat(ca.sinh(X), ca.cosh(Y), ca.tanh(X)),
    "atan2": ca.atan2(X, Y),
    "abs": ca.fabs(X) * X,
    "sign": ca.sign(X),
    "rounding": ca.vertcat(ca.floor(X), ca.ceil(Y)),
    "fmin": ca.vertcat(ca.fmin(X, Y), ca.fmin(X, 0.1), ca.fmin(ca.sin(X), 0.1) * 3),
    "fmax": ca.vertcat(ca.fmax(X, Y), ca.fmax(-0.7, X)),
    "if_else": ca.if_else(X > Y, X**2, ca.sin(Y)),
    "if_else on equality": ca.if_else(X == Y, 1, Y),
    "if_else not": ca.if_else(ca.logic_not(X > 0), X, 2 * Y),
    "logic": ca.vertcat(
        ca.logic_and(X > 0, Y > 0), ca.logic_or(X > 0, Y <= 0), ca.logic_not(X >= Y), X != Y, ca.if_else(X > 0, 1, 0)
    ),
    "an unused branch that is not finite": ca.if_else(X > 0, ca.log(X), 0),
    "a saturation": ca.fmin(ca.fmax(X, -1), 1) ** 2,
    "constants": ca.vertcat(1.5, X, 0),
    "an inverse": 1 / X,
    "inputs as they are": ca.vertcat(Y, X),
    "error function": ca.vertcat(ca.erf(X), ca.erfinv(X / 9)),
    "inverse hyperbolic": ca.vertcat(ca.asinh(X), ca.acosh(1 + Y**2), ca.atanh(X / 9), ca.log1p(X**2), ca.expm1(Y)),
    "two arguments": ca.vertcat(ca.hypot(X, Y), ca.copysign(X, Y), ca.fmod(X, Y), ca.remainder(X, Y)),
}


def function(name):
    return ca.Function("f", [X, Y], [EXPRESSIONS[name]])


def points(n=200):
    xy = np.random.default_rng(0).uniform(-3, 3, (n, 2))
    xy[:10, 1] = xy[:10, 0]
    xy[10:12] = [[2.0, -1.0], [-1.0, 1.0]]
    return xy[:, :1], xy[:, 1:]


@pytest.mark.parametrize("name", EXPRESSIONS)
def test_numpy_agrees_with_casadi(name):
    f, (x, y) = function(name), points()
    expected = np.asarray(f(x.T, y.T)).T
    np.testing.assert_allclose(Vectorised(f)(x, y), expected, rtol=1e-13, atol=1e-14)


@pytest.mark.parametrize("name", EXPRESSIONS)
def test_torch_in_double_precision_agrees_with_casadi(name):
    f, (x, y) = function(name), points()
    expected = np.asarray(f(x.T, y.T)).T
    out = Vectorised(f)(torch.tensor(x), torch.tensor(y))
    assert out.dtype == torch.float64
    np.testing.assert_allclose(out.numpy(), expected, rtol=1e-13, atol=1e-14)


@pytest.mark.parametrize(
    "name", [n for n in EXPRESSIONS if n not in ("sign", "rounding", "logic", "if_else on equality", "constants")]
)
def test_torch_gradients_agree_with_casadi_derivatives(name):
    x, y = points()
    x, y = np.abs(x[20:]) + 0.1, y[20:]  # off the kinks and the ill-defined branch
    expression = ca.sum1(EXPRESSIONS[name])
    jacobian = ca.Function("J", [X, Y], [ca.jacobian(expression, ca.vertcat(X, Y))])
    expected = np.array([np.asarray(jacobian(a, b)).ravel() for a, b in zip(x, y)])
    tensors = [torch.tensor(a, requires_grad=True) for a in (x, y)]
    out = Vectorised(ca.Function("f", [X, Y], [expression]))(*tensors)
    gradients = torch.autograd.grad(out.sum(), tensors, allow_unused=True)
    own = np.hstack([np.zeros_like(x) if g is None else g.numpy() for g in gradients])
    np.testing.assert_allclose(own, expected, rtol=1e-10, atol=1e-12)


def test_leading_shapes_broadcast():
    v = Vectorised(ca.Function("f", [X, Y], [ca.vertcat(X + Y, 1)]))
    assert v(np.zeros((5, 3, 1)), np.ones(1)).shape == (5, 3, 2)
    assert v(torch.zeros(5, 3, 1), torch.ones(1)).shape == (5, 3, 2)


def test_single_precision_stays_single():
    v = Vectorised(ca.Function("f", [X, Y], [ca.fmin(X, 0.1) + ca.if_else(X > Y, X, Y)]))
    assert v(torch.zeros(4, 1), torch.ones(4, 1)).dtype == torch.float32


def test_a_function_of_matrices_is_expanded():
    M = ca.MX.sym("m", 2)
    v = Vectorised(ca.Function("f", [M], [ca.mtimes(ca.DM([[1, 2], [3, 4]]), M)]))
    np.testing.assert_allclose(v(np.array([[1.0, 1.0], [0.0, 2.0]])), [[3, 7], [4, 8]])


def test_an_operation_without_an_array_counterpart_is_refused():
    with pytest.raises(InputError, match="dynamics: got the CasADi operations OP_PRINTME, which arrays do not have"):
        Vectorised(ca.Function("f", [X], [X.printme(X)]))
