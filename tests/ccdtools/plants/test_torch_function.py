"""CasADi functions as torch functions: the same values and derivatives, in batches, whatever the shapes."""

import casadi as ca
import numpy as np
import pytest
import torch

from ccdtools import InputError
from ccdtools.plants import to_torch


def random_function(seed):
    """A random function of a column, a matrix and a sparse matrix, with a dense, a sparse and a scalar output."""
    rng = np.random.default_rng(seed)
    x, M = ca.SX.sym("x", 3), ca.SX.sym("M", 2, 3)
    S = ca.SX.sym("S", ca.Sparsity.lower(3))
    values = [x[0], x[1], x[2], *ca.vertsplit(ca.vec(M)), *S.nonzeros()]
    smooth = [ca.sin, ca.tanh, lambda v: ca.sqrt(1 + v**2), lambda v: ca.exp(-(v**2)), ca.atan, ca.erf, ca.asinh]
    pairs = [lambda a, b: a * b, lambda a, b: a - b, lambda a, b: a / (2 + b**2), lambda a, b: ca.atan2(a, 3 + b**2)]
    pairs += [lambda a, b: ca.if_else(a > b, a * b, b**2), lambda a, b: ca.fmin(a, 2 * b), lambda a, b: ca.hypot(a, b)]
    for _ in range(30):
        a, b = (values[i] for i in rng.integers(len(values), size=2))
        values.append(smooth[rng.integers(len(smooth))](pairs[rng.integers(len(pairs))](a, b)))
    sparse = ca.SX(3, 2)
    sparse[0, 1], sparse[2, 0] = values[-4], values[-5]
    return ca.Function("f", [x, M, S], [ca.vertcat(*values[-3:]), sparse, values[-6]], ["x", "M", "S"], ["y", "Z", "s"])


def points(seed, n):
    """Dense arguments (n, ·) for `random_function`; entries of S above the diagonal are not zero and do not count."""
    rng = np.random.default_rng([seed, 1])
    return rng.normal(size=(n, 3)), rng.normal(size=(n, 2, 3)), rng.normal(size=(n, 3, 3))


def by_casadi(f, *arguments):
    """Outputs of each point, one by one."""
    rows = [[np.asarray(ca.densify(v)) for v in f.call([ca.DM(np.tril(a) if a.shape == (3, 3) else a) for a in point])]
            for point in zip(*arguments)]  # fmt: skip
    return [np.array(own) for own in zip(*rows)]


@pytest.mark.parametrize("seed", range(20))
def test_values_agree_with_casadi(seed):
    f = random_function(seed)
    arguments = points(seed, 7)
    y, Z, s = to_torch(f)(*map(torch.tensor, arguments))
    expected = by_casadi(f, *arguments)
    assert y.shape == (7, 3)
    assert Z.shape == (7, 3, 2)
    assert s.shape == (7, 1)
    for own, theirs in zip((y[..., None], Z, s[..., None]), expected):
        np.testing.assert_allclose(own.numpy(), theirs, rtol=1e-12, atol=1e-13)


@pytest.mark.parametrize("seed", range(20))
def test_first_and_second_derivatives_agree_with_casadi(seed):
    f = random_function(seed)
    x, M, S = points(seed, 1)
    symbols = [ca.SX.sym(name, f.size_in(i)) for i, name in enumerate("xMS")]
    total = sum(ca.sum1(ca.vec(ca.densify(out))) for out in f.call(symbols))
    free = ca.vertcat(*(ca.vec(s) for s in symbols))
    H, g = ca.hessian(total, free)
    expected = ca.Function("d", symbols, [ca.densify(g), ca.densify(H)])(x[0], M[0], S[0])

    def scalar(v):
        return sum(out.sum() for out in to_torch(f)(v[:3], v[3:9].reshape(3, 2).mT, v[9:].reshape(3, 3).mT))

    at = torch.tensor(np.concatenate([x[0], M[0].ravel(order="F"), S[0].ravel(order="F")]))
    gradient = torch.func.grad(scalar)(at)
    np.testing.assert_allclose(gradient, np.asarray(expected[0]).ravel(), rtol=1e-9, atol=1e-11)
    hessian = torch.autograd.functional.hessian(scalar, at)
    np.testing.assert_allclose(hessian, np.asarray(expected[1]), rtol=1e-8, atol=1e-10)


def test_leading_shapes_broadcast_and_types_stay():
    x, p = ca.SX.sym("x", 2), ca.SX.sym("p")
    f = to_torch(ca.Function("f", [x, p], [x * p, 3]))
    y, three = f(torch.ones(5, 1, 2), torch.ones(4, 1))
    assert y.shape == (5, 4, 2)
    assert three.shape == (5, 4, 1)
    assert y.dtype == three.dtype == torch.float32
    assert f(torch.ones(2), torch.ones(1))[0].shape == (2,)
    assert to_torch(ca.Function("f", [x], [x]))(torch.ones(0, 2)).shape == (0, 2)
    row = to_torch(ca.Function("f", [x.T], [2 * x.T]))
    assert row(torch.ones(6, 1, 2)).shape == (6, 1, 2)


def test_torch_takes_part_in_a_vmap_and_a_training_step():
    x, p = ca.SX.sym("x", 2), ca.SX.sym("p", 2)
    f = to_torch(ca.Function("f", [x, p], [ca.sumsqr(x - p)]))
    design = torch.nn.Parameter(torch.zeros(2))
    optimiser = torch.optim.SGD([design], lr=0.25)
    for _ in range(20):
        optimiser.zero_grad()
        f(torch.tensor([[1.0, 2.0], [3.0, 4.0]]), design).mean().backward()
        optimiser.step()
    assert torch.allclose(design, torch.tensor([2.0, 3.0]), atol=1e-5)
    points = torch.randn(6, 2)
    each = torch.func.vmap(lambda v: f(v, torch.zeros(2)))(points)
    assert torch.allclose(each[:, 0], (points**2).sum(1))


def implicit():
    """The root of z + z³ = x p, found by Newton's method: a function without scalar instructions."""
    z, q = ca.SX.sym("z"), ca.SX.sym("q")
    root = ca.rootfinder("root", "newton", {"x": z, "p": q, "g": z + z**3 - q}, {"abstol": 1e-14})
    x, p = ca.MX.sym("x", 2), ca.MX.sym("p")
    return ca.Function("implicit", [x, p], [ca.vertcat(root(0, x[0] * p), root(0, x[1] * p))])


def test_what_cannot_be_translated_is_called_and_says_so():
    with pytest.warns(UserWarning, match="CasADi evaluates implicit point by point"):
        f = to_torch(implicit())
    assert not f.translated
    x, p = torch.randn(3, 2, 2, dtype=torch.float64, requires_grad=True), torch.tensor([1.5], dtype=torch.float64)
    z = f(x, p)
    assert z.shape == (3, 2, 2)
    assert torch.allclose(z + z**3, 1.5 * x)
    (gradient,) = torch.autograd.grad(z.sum(), x, create_graph=True)
    slope = 1.5 / (1 + 3 * z**2)
    assert torch.allclose(gradient, slope)
    (second,) = torch.autograd.grad(gradient.sum(), x)
    assert torch.allclose(second, -6 * z * slope * 1.5 / (1 + 3 * z**2) ** 2)
    p.requires_grad_()
    (of_p,) = torch.autograd.grad(f(x.detach(), p).sum(), p)
    assert torch.allclose(of_p, (x / (1 + 3 * z**2)).sum().detach())


def test_an_integrator_with_arguments_of_no_entries_is_called():
    x, u = ca.SX.sym("x", 2), ca.SX.sym("u")
    integrator = ca.integrator("I", "cvodes", {"x": x, "u": u, "ode": ca.vertcat(x[1], u - x[0])}, 0, 0.1)
    with pytest.warns(UserWarning, match="evaluates I point by point"):
        f = to_torch(integrator)
    shapes = [integrator.size_in(i) for i in range(integrator.n_in())]
    arguments = [torch.zeros(*(size[:1] if size[1] == 1 else size), dtype=torch.float64) for size in shapes]
    arguments[0] = torch.tensor([[1.0, 0.0], [0.0, 1.0]], dtype=torch.float64)
    end = f(*arguments)[0]
    turned = torch.tensor([[np.cos(0.1), -np.sin(0.1)], [np.sin(0.1), np.cos(0.1)]], dtype=torch.float64)
    assert torch.allclose(end, turned, atol=1e-6)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ((torch.ones(2),), "arguments: got 1 of them, expected 2 tensors: x, p"),
        ((torch.ones(3), torch.ones(1)), r"x: got shape \(3,\), expected \(..., 2\)"),
        ((torch.ones(2), torch.tensor(1.0)), r"p: got shape \(\), expected \(..., 1\)"),
        (([1.0, 2.0], torch.ones(1)), "x: got .*, expected a floating-point tensor"),
        ((torch.ones(2, dtype=torch.int64), torch.ones(1)), "x: got a tensor of torch.int64"),
        ((torch.ones(2).double(), torch.ones(1)), "arguments: got torch.float32 on cpu and torch.float64 on cpu"),
        ((torch.ones(3, 2), torch.ones(4, 1)), r"arguments: got batches of shape \(3,\) and \(4,\)"),
    ],
)
def test_wrong_calls_name_the_argument(arguments, message):
    x, p = ca.SX.sym("x", 2), ca.SX.sym("p")
    f = to_torch(ca.Function("f", [x, p], [x * p], ["x", "p"], ["y"]))
    with pytest.raises(InputError, match=message):
        f(*arguments)


@pytest.mark.parametrize("function", [None, ca.SX.sym("x"), lambda x: x])
def test_only_functions_are_translated(function):
    with pytest.raises(InputError, match=r"function: got .*, expected a casadi\.Function"):
        to_torch(function)


def test_a_function_without_outputs_is_refused():
    x = ca.SX.sym("x")
    with pytest.raises(InputError, match="at least one output"):
        to_torch(ca.Function("f", [x], []))
