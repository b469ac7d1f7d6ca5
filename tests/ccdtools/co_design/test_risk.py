import numpy as np
import pytest
import torch

from ccdtools import CVaR, InputError, Mean, MeanSpread


def mean_less_spread(r):
    return r.mean(-1) - 0.7 * r.std(-1)


def mean_of_worst(count):
    return lambda r: np.sort(r, axis=-1)[..., :count].mean(-1)


CASES = {
    "mean": (Mean(), lambda r: r.mean(-1)),
    "spread": (MeanSpread(0.7), mean_less_spread),
    "tenth": (CVaR(0.1), mean_of_worst(4)),
    "uneven share": (CVaR(0.11), mean_of_worst(5)),
    "worst": (CVaR(1e-9), mean_of_worst(1)),
    "all": (CVaR(1.0), lambda r: r.mean(-1)),
}


@pytest.mark.parametrize("unit", [1.0, 1e-6, 1e7])
@pytest.mark.parametrize("name", CASES)
def test_the_mean_of_the_values_is_the_measure(name, unit):
    risk, measure = CASES[name]
    returns = unit * (np.random.default_rng(0).standard_normal((3, 40)) - 5)
    np.testing.assert_allclose(risk.values(returns).mean(-1), measure(returns), rtol=1e-12)
    np.testing.assert_allclose(risk.values(torch.tensor(returns)).mean(-1), measure(returns), rtol=1e-12)


@pytest.mark.parametrize("name", CASES)
def test_its_gradient_is_that_of_the_measure(name):
    risk, measure = CASES[name]
    r = np.random.default_rng(1).standard_normal(40) - 5
    returns = torch.tensor(r, requires_grad=True)
    (gradient,) = torch.autograd.grad(risk.values(returns).mean(), returns)
    h = 1e-6
    slopes = [(measure(r + h * e) - measure(r - h * e)) / (2 * h) for e in np.eye(40)]
    np.testing.assert_allclose(gradient, slopes, atol=1e-8)


def test_equal_returns_have_no_spread_and_a_gradient():
    returns = torch.full((5,), -3.0, dtype=torch.float64, requires_grad=True)
    values = MeanSpread(2.0).values(returns)
    np.testing.assert_array_equal(values.detach(), -3.0)
    assert torch.autograd.grad(values.mean(), returns)[0].isfinite().all()


@pytest.mark.parametrize(
    ("make", "argument"),
    [(lambda: CVaR(0), "share"), (lambda: CVaR(1.2), "share"), (lambda: MeanSpread(-1), "weight"),
     (lambda: CVaR("a"), "share")],
)  # fmt: skip
def test_a_wrong_risk_is_refused(make, argument):
    with pytest.raises(InputError) as caught:
        make()
    assert caught.value.argument == argument


@pytest.mark.parametrize("kind", [torch.float32, torch.float64])
def test_equal_returns_have_the_slope_of_their_mean(kind):
    returns = torch.full((4,), -3.0, dtype=kind, requires_grad=True)
    MeanSpread(2.0).values(returns).mean().backward()
    np.testing.assert_allclose(returns.grad, 0.25)
