"""A climb gets under way wherever a long first step would lead, and in whatever unit the cost is."""

import numpy as np
import pytest
import torch

from ccdtools.co_design.climb import SampleAverage, climb

COMPRESS_ABOVE = 2.0  # relative costs
PER_UNIT = 0.03**-2  # the unit of the value where that of weights and design is 0.03


def climbed(cost, weights, v=None, *, scale=1.0, length=60):
    """Relative cost before and after a climb."""
    average = SampleAverage(lambda: cost(weights, v), weights=[weights], v=v, scale=scale)
    before = average(average.first)[0] / PER_UNIT
    climb(average, length, counted=lambda: False, look=lambda: False)
    with torch.no_grad():
        return before, float(cost(weights, v)) / scale


@pytest.mark.parametrize("power", [2, 4, 8])
@pytest.mark.parametrize("slope", [0.1, 1.0, 10.0])
@pytest.mark.parametrize("unit", [1e-6, 1e6])
def test_a_climb_does_not_end_because_its_first_step_would_lose_everything(power, slope, unit):
    """A valley between walls that rise without end within a step of length one, as the cost of lost runs does."""

    def cost(w, v):
        valley = 1 - slope * w.sum() / 40**0.5 + 10 * slope * w @ w
        return unit * (valley + 1e-3 * torch.exp((w.norm() / 0.15) ** power))

    before, after = climbed(cost, torch.zeros(40, requires_grad=True), scale=unit)
    assert before == pytest.approx(1.001)
    assert before - after > 0.9 * 0.025 * slope


@pytest.mark.parametrize("slope", [0.001, 0.003, 0.1])
def test_a_small_slope_of_the_design_is_followed(slope):
    weights = torch.zeros(40, requires_grad=True)
    v = torch.tensor([0.3], requires_grad=True)
    climbed(lambda w, v: 1.0 - slope * v.sum() + 0.1 * w @ w, weights, v, length=20)
    assert v.item() == pytest.approx(1.0, abs=1e-3)


def test_a_design_stops_at_the_bounds_of_its_box():
    weights = torch.zeros(3, requires_grad=True)
    v = torch.tensor([0.5, 0.5], requires_grad=True)
    _, after = climbed(lambda w, v: 2.0 + (v[0] - 2) ** 2 + (v[1] - 0.3) ** 2 + (w**2).sum(), weights, v, scale=4.0)
    np.testing.assert_allclose(v.detach().numpy(), [1.0, 0.3], atol=1e-3)
    assert after == pytest.approx(0.75, abs=1e-5)


@pytest.mark.parametrize("height", [0.5, 1.9, 2.1, 50.0, 1e7])
def test_the_gradient_is_that_of_the_cost_also_where_it_is_tall(height):
    weights = torch.tensor([0.3, -0.2], requires_grad=True)
    average = SampleAverage(
        lambda: height * (1 + weights[0] + weights[1] ** 2), weights=[weights], v=None, scale=1.0
    )  # fmt: skip
    z = average.first
    value, gradient = average(z)
    cost = height * (1 + 0.3 + 0.04)
    compressed = cost if cost <= COMPRESS_ABOVE else COMPRESS_ABOVE * (1 + np.log(cost / COMPRESS_ABOVE))
    assert value / PER_UNIT == pytest.approx(compressed, rel=1e-5)
    for i in range(2):
        h = np.zeros(2)
        h[i] = 0.1
        slope = (average(z + h)[0] - average(z - h)[0]) / 0.2
        assert gradient[i] == pytest.approx(slope, rel=0.02)


@pytest.mark.parametrize(("slope", "kept"), [(300.0, 300.0), (3000.0, 1000.0)])
def test_a_gradient_above_a_thousand_is_shortened(slope, kept):
    weights = torch.zeros(1, requires_grad=True)
    average = SampleAverage(lambda: 1 + slope * weights[0], weights=[weights], v=None, scale=1.0)
    assert average(average.first)[1] == pytest.approx([kept / 0.03], rel=1e-5)
