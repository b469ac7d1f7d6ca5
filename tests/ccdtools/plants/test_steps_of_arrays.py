"""Steps of few runs by CasADi's machine and of many by arrays in place: both are the step that CasADi computes."""

import casadi as ca
import numpy as np
import pytest
import torch

from ccdtools import DesignSpace, Plant, SampledModel
from ccdtools.plants.native import FEW

RUNS = [1, 2, FEW, FEW + 1, 2500]
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


@pytest.mark.parametrize("n", RUNS)
@pytest.mark.parametrize("own", [False, True])
@pytest.mark.parametrize("disturbed", [False, True])
def test_a_step_of_any_number_of_runs_is_that_of_casadi(n, own, disturbed, rng):
    model = SampledModel(winding(disturbed=disturbed), 0.1, substeps=3)
    x, u, w = drawn(model, n, rng)
    p = designs(n, own, rng)
    expected = np.array([model.step(*one).full()[:, 0] for one in zip(x, u, w, np.broadcast_to(p, (n, 2)))])
    np.testing.assert_allclose(model.advance(x, u, w, p), expected, rtol=1e-13, atol=1e-15)


@pytest.mark.parametrize("n", RUNS)
@pytest.mark.parametrize("own", [False, True])
def test_slopes_of_any_number_of_runs_are_those_of_casadi(n, own, rng):
    model = SampledModel(winding(), 0.1, substeps=3)
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


def test_leading_shapes_broadcast_and_single_precision_stays_single(rng):
    model = SampledModel(winding(), 0.1, substeps=2)
    x = rng.uniform(-1.0, 1.0, (4, 70, 3)).astype(np.float32)
    u = rng.uniform(-1.0, 1.0, (70, 2))
    after = model.advance(x, u, np.zeros(1), np.array([1.0, 2.0]))
    assert after.shape == (4, 70, 3)
    assert after.dtype == np.float32
    single = model.advance(x[2, 5].astype(float), u[5], np.zeros(1), np.array([1.0, 2.0]))
    assert single.shape == (3,)
    np.testing.assert_allclose(after[2, 5], single, rtol=1e-6, atol=1e-7)
    assert model.advance(x[:0, 0], u[:0], np.zeros(1), np.array([1.0, 2.0])).shape == (0, 3)


@pytest.mark.parametrize("n", [3, 2500])
def test_a_run_that_is_no_number_leaves_the_others_as_they_are(n, rng):
    model = SampledModel(winding(), 0.1)
    x, u, w = drawn(model, n, rng)
    spoilt = x.copy()
    spoilt[1] = np.nan
    p = np.array([1.0, 2.0])
    others = np.arange(n) != 1
    np.testing.assert_array_equal(model.advance(spoilt, u, w, p)[others], model.advance(x, u, w, p)[others])
    assert np.isnan(model.advance(spoilt, u, w, p)[1, 0])
