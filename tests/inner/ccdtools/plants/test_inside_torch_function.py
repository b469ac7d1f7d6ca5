"""What test_torch_function.py claims, seen from inside."""

import copy
import pickle
import warnings

import casadi as ca
import numpy as np
import torch

from ccdtools.plants import to_torch
from ccdtools.plants.torch_function import TorchFunction


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


def test_a_translated_function_is_silent_and_copies():
    f = random_function(0)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        own = to_torch(f)
        again = [pickle.loads(pickle.dumps(own)), copy.deepcopy(own)]
    arguments = [torch.tensor(a) for a in points(0, 3)]
    for other in again:
        assert isinstance(other, TorchFunction)
        assert all(torch.equal(a, b) for a, b in zip(own(*arguments), other(*arguments)))
    assert len(repr(own)) < 120
