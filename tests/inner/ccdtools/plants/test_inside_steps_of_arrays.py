"""What test_steps_of_arrays.py claims, seen from inside."""

from concurrent.futures import ThreadPoolExecutor

import casadi as ca
import numpy as np
import pytest
import torch

from ccdtools import DesignSpace, Plant
from ccdtools.plants import SampledModel
from ccdtools.plants.budgets import FEW_ROWS, KEPT_SIZES

RUNS = [1, 2, FEW_ROWS, FEW_ROWS + 1, pytest.param(2500, marks=pytest.mark.check)]
DESIGN = DesignSpace(["a", "b"], lower=[0.5, 1.0], upper=[2.0, 3.0])


def winding(*, disturbed=True):
    """A plant with a rate that is always zero, and operations of every kind."""
    x, u, p = ca.SX.sym("x", 3), ca.SX.sym("u", 2), ca.SX.sym("p", 2)
    w = ca.SX.sym("w") if disturbed else ca.SX(0, 1)
    rough = ca.if_else(x[0] > u[1], ca.fmax(x[2], 0.1) ** p[1], ca.fabs(x[0])) + ca.fmod(u[0], 0.7)
    rates = [-p[0] * x[0] + ca.sin(x[2]) / p[1] + rough, 0, ca.atan2(x[0], 2 + x[2] ** 2) - ca.sqrt(1 + x[2] ** 2)]
    if disturbed:
        rates[2] += w * p[0]
    return Plant(x, u, w, p, ca.vertcat(*rates), DESIGN, dt=0.1)


def drawn(plant, n, rng):
    """States, inputs and disturbances of n runs."""
    return [rng.uniform(-1.0, 1.0, (n, size)) for size in (plant.nx, plant.nu, plant.nw)]


def designs(n, own, rng):
    """One design for each run, or one for all."""
    return rng.uniform(DESIGN.lower, DESIGN.upper, (n, 2) if own else 2)


@pytest.mark.long
@pytest.mark.parametrize("n", RUNS)
@pytest.mark.parametrize("own", [False, True])
@pytest.mark.parametrize("disturbed", [False, True])
@pytest.mark.parametrize("compiled", [False, True])
def test_a_step_of_any_number_of_runs_is_that_of_casadi(n, own, disturbed, compiled, rng):
    model = SampledModel(winding(disturbed=disturbed), 0.1, substeps=3, compiled=compiled)
    x, u, w = drawn(model, n, rng)
    p = designs(n, own, rng)
    expected = np.array([model.step(*one).full()[:, 0] for one in zip(x, u, w, np.broadcast_to(p, (n, 2)))])
    np.testing.assert_allclose(model.advance(x, u, w, p), expected, rtol=1e-13, atol=1e-15)


@pytest.mark.quick(8)
@pytest.mark.parametrize("n", RUNS)
@pytest.mark.parametrize("own", [False, True])
@pytest.mark.parametrize("compiled", [False, True])
def test_slopes_of_any_number_of_runs_are_those_of_casadi(n, own, compiled, rng):
    model = SampledModel(winding(), 0.1, substeps=3, compiled=compiled)
    x, u, w = drawn(model, n, rng)
    p = designs(n, own, rng)
    factor = rng.standard_normal((n, 3))
    given = [torch.tensor(a, requires_grad=True) for a in (x, u, w, p)]
    found = torch.autograd.grad((model.pathwise(*given) * torch.tensor(factor)).sum(), given)
    slopes = model.step.jacobian()
    rows = zip(factor, x, u, w, np.broadcast_to(p, (n, 2)))
    each = [[m @ np.asarray(J) for J in slopes(*one, np.zeros(3))] for m, *one in rows]
    expected = [np.array(slope) for slope in zip(*each)]
    if not own:
        expected[3] = expected[3].sum(axis=0)
    for one, other in zip(found, expected):
        np.testing.assert_allclose(one, other, rtol=1e-9, atol=1e-11)


@pytest.mark.check
def test_several_threads_may_step_one_model_with_many_numbers_of_runs(rng):
    model = SampledModel(winding(), 0.1)
    p = np.array([1.0, 2.0])
    given = {n: drawn(model, n, rng) for n in range(2, 3 * KEPT_SIZES)}
    expected = {n: model.advance(*one, p) for n, one in given.items()}

    def differs(n):
        """Whether a step of n runs is another one here."""
        return bool((model.advance(*given[n], p) != expected[n]).any())

    with ThreadPoolExecutor(6) as pool:
        assert not any(pool.map(differs, rng.choice(list(given), 3000)))


@pytest.mark.long
def test_compiled_operations_are_those_of_casadi_for_any_number():
    x, u = ca.SX.sym("x", 2), ca.SX.sym("u")
    a, b = x[0], x[1]
    unary = [ca.exp, ca.log, ca.sqrt, ca.tan, ca.asin, ca.acos, ca.atan, ca.sinh, ca.cosh, ca.tanh, ca.asinh, ca.acosh,
             ca.atanh, ca.fabs, ca.sign, ca.floor, ca.ceil, ca.log1p, ca.expm1, ca.logic_not]  # fmt: skip
    binary = [ca.fmin, ca.fmax, ca.atan2, ca.hypot, ca.copysign, ca.fmod, ca.remainder, ca.power, ca.logic_and,
              ca.logic_or, ca.lt, ca.le, ca.eq, ca.ne, lambda a, b: 1 / a - b,
              lambda a, b: ca.if_else(a, b, 3)]  # fmt: skip
    values = [f(a) for f in unary] + [f(a, b) for f in binary]
    state = ca.SX.sym("s", len(values))
    function = ca.Function("all", [state, ca.vertcat(x, u)], [ca.vertcat(*values)])
    drive = ca.SX.sym("u", 3)
    plant = Plant(
        state, drive, ca.SX(0, 1), ca.SX(0, 1), function(state, drive), DesignSpace([], lower=[], upper=[]), dt=1.0,
        continuous=False,
    )  # fmt: skip
    given = np.array([0.0, -0.0, 0.3, -0.3, 1.0, -2.5, 2.5, 7.0, np.nan])
    u = np.array([(one, other, 0.0) for one in given for other in given])
    x, w = np.zeros((len(u), len(values))), np.zeros((len(u), 0))
    found, expected = (
        SampledModel(plant, 1.0, compiled=compiled).advance(x, u, w, np.zeros(0)) for compiled in (True, False)
    )
    np.testing.assert_allclose(found, expected, rtol=1e-14, atol=1e-300)
