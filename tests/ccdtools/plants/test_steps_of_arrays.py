"""Steps of few runs by CasADi's machine and of many by arrays in place: both are the step that CasADi computes."""

from dataclasses import replace

import casadi as ca
import numpy as np
import pytest
import torch
from numba.core.event import install_recorder
from torch.utils.checkpoint import checkpoint

from ccdtools import DesignSpace, InputError, Plant
from ccdtools.plants import SampledModel

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


@pytest.mark.long
@pytest.mark.parametrize("n", [3, 100])
@pytest.mark.parametrize("continuous", [True, False])
def test_a_compiled_plant_steps_as_the_same_plant_that_is_not(continuous, n, rng):
    plant = replace(winding(), continuous=continuous)
    x, u, w = drawn(plant, n, rng)
    p = np.array([1.0, 2.0])
    compiled = replace(plant, compiled=True).stepper(p, batch=n)(x, u, w)
    np.testing.assert_allclose(compiled, plant.stepper(p, batch=n)(x, u, w), rtol=1e-12, atol=1e-12)
    with pytest.raises(InputError, match=r"^compiled: got 'yes'"):
        replace(plant, compiled="yes")


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


@pytest.mark.parametrize("n", [5, 300])
@pytest.mark.parametrize(
    ("name", "shape"),
    [("x", (3,)), ("x", ("n", 4)), ("u", ("n", 3)), ("u", ("2n", 2)), ("u", (1, 2)), ("w", (0,)), ("p", ("2n", 2)),
     ("p", (3,)), ("p", (2, 1, 2))],
)  # fmt: skip
def test_a_pathwise_step_of_sizes_that_do_not_fit_is_refused_by_name(name, shape, n, rng):
    model = SampledModel(winding(), 0.1)
    given = dict(zip("xuwp", (torch.tensor(a) for a in (*drawn(model, n, rng), designs(n, True, rng)))))
    given[name] = torch.zeros([{"n": n, "2n": 2 * n}.get(size, size) for size in shape], dtype=torch.float64)
    with pytest.raises(InputError, match=f"^{name}: "):
        model.pathwise(**given)


@pytest.mark.parametrize("n", [4, 300])
def test_slopes_at_a_state_that_was_overwritten_are_refused_as_torch_does(n, rng):
    model = SampledModel(winding(), 0.1)
    x, u, w = (torch.tensor(a, requires_grad=True) for a in drawn(model, n, rng))
    p = torch.tensor([1.0, 2.0], dtype=torch.float64)
    once = model.pathwise(x, u, w, p)
    twice = model.pathwise(once, u, w, p)
    with torch.no_grad():
        once.mul_(0.5)
    with pytest.raises(RuntimeError, match="modified by an inplace operation"):
        twice.sum().backward()


@pytest.mark.parametrize("power", [1, 2])
def test_second_derivatives_of_a_pathwise_step_are_refused_not_zero(power, rng):
    model = SampledModel(winding(), 0.1)
    x, u, w = (torch.tensor(a, requires_grad=True) for a in drawn(model, 4, rng))
    after = model.pathwise(x, u, w, torch.tensor([1.0, 2.0], dtype=torch.float64))
    slopes = torch.autograd.grad((after**power).sum(), x, create_graph=True)[0]
    with pytest.raises(RuntimeError, match="differentiate twice"):
        (slopes**2).sum().backward()


@pytest.mark.parametrize("n", [5, 300])
def test_a_step_that_torch_computes_again_has_the_slopes_of_one_that_is_kept(n, rng):
    model = SampledModel(winding(), 0.1)
    x, u, w = drawn(model, n, rng)
    p = torch.tensor([1.0, 2.0], dtype=torch.float64, requires_grad=True)

    def squares(p):
        """Sum of squares after two steps."""
        first = model.pathwise(torch.tensor(x), torch.tensor(u), torch.tensor(w), p)
        return (model.pathwise(first, torch.tensor(u), torch.tensor(w), p) ** 2).sum()

    kept = torch.autograd.grad(squares(p), p)[0]
    again = torch.autograd.grad(checkpoint(squares, p, use_reentrant=False), p)[0]
    torch.testing.assert_close(again, kept, rtol=0, atol=0)


@pytest.mark.long
def test_plants_that_differ_by_constants_are_compiled_once_and_step_by_their_own(rng):
    x, u, p = ca.SX.sym("x", 2), ca.SX.sym("u"), ca.SX.sym("p")
    space = DesignSpace(["p"], lower=[1.0], upper=[2.0])

    def oscillator(stiffness):
        rates = ca.vertcat(x[1], u - stiffness * ca.tanh(x[0]) - p * x[1] ** 3)
        return Plant(x, u, ca.SX(0, 1), p, rates, space, dt=0.05, compiled=True)

    states, inputs, none = rng.uniform(-1.0, 1.0, (100, 2)), rng.uniform(-1.0, 1.0, (100, 1)), np.zeros((100, 0))
    design = np.array([1.5])
    with install_recorder("numba:compile") as compilations:
        for stiffness in (3.7, 4.1, 5.3):
            plant = oscillator(stiffness)
            after = plant.stepper(design, batch=100)(states, inputs, none)
            plain = replace(plant, compiled=False).stepper(design, batch=100)(states, inputs, none)
            np.testing.assert_allclose(after, plain, rtol=1e-13, atol=1e-13)
            states.setflags(write=False)  # a state that cannot be written is no other kind, either
    begun = [event.data["dispatcher"].py_func.__name__ for _, event in compilations.buffer if event.is_start]
    assert begun.count("path") == 1
