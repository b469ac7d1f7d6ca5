"""Redesign now, log longer or stop: beside the decision of Bayes, and in a study that stops by itself."""

from dataclasses import replace

import numpy as np
import pytest
from scipy import integrate, stats

from ccdtools import InputError
from ccdtools.studies import RedesignCost, decide_redesign

EUR = RedesignCost(cost=200.0, serves=40, unit="EUR", worth=2.0, logging=1.0)


def worth_of_logs(k, mean, error, noise, terms):
    """Expected worth of k logs and the better action afterwards, by quadrature over the gain and what is measured."""
    left = (terms.serves - k) * terms.worth
    known = error**-2 + k * noise**-2
    moved = np.sqrt(error**2 - 1 / known)
    grid = np.linspace(-8, 8, 4001)
    paid = np.maximum(left * (mean + moved * grid) - terms.cost, 0.0)
    return integrate.trapezoid(paid * stats.norm.pdf(grid), grid) - k * terms.logging


@pytest.mark.parametrize("mean", [-3.0, 1.0, 2.4, 2.6, 8.0])
def test_the_action_is_that_of_bayes(mean):
    noise, prior = 4.0, (0.0, 6.0)
    gains = np.full(3, mean)
    known = prior[1] ** -2 + 3 * noise**-2
    after, error = 3 * mean * noise**-2 / known, known**-0.5
    worths = {"stop": 0.0, "redesign now": EUR.serves * EUR.worth * after - EUR.cost}
    worths["log longer"] = max(worth_of_logs(k, after, error, noise, EUR) for k in range(1, 40))
    found = decide_redesign(gains, EUR, noise=noise, prior=prior)
    best, other, _ = sorted(worths, key=lambda action: 0.005 * EUR.cost * (action == "log longer") - worths[action])
    assert found.status.value == best
    assert found.worth == pytest.approx(worths[best], abs=0.02)
    assert found.alternative_worth == pytest.approx(worths[other], abs=0.02)


def test_it_stops_where_nothing_is_to_be_gained():
    found = decide_redesign([0.1, 0.12, 0.08, 0.11], EUR)
    assert found.status.value == "stop"
    assert found.worth == 0.0
    assert "next best" in str(found)


def test_it_logs_where_a_measurement_would_decide():
    found = decide_redesign([8.0, -3.0], EUR)
    assert found.status.value == "log longer"
    assert found.logs >= 1


def test_it_redesigns_where_it_surely_pays():
    found = decide_redesign([9.0, 9.5, 8.8, 9.2], EUR)
    assert found.status.value == "redesign now"
    assert found.worth == pytest.approx(40 * 2 * 9.125 - 200)
    assert found.redesign[0] < found.worth < found.redesign[1]


@pytest.mark.parametrize("size", [1e300, 1e-300])
def test_numbers_whose_squares_are_none_are_named(size):
    for name in ("cost", "serves", "worth", "logging"):
        with pytest.raises(InputError, match=f"{name}.*another unit"):
            RedesignCost(**{"cost": 1.0, "serves": 2.0, "unit": "EUR", "worth": 1.0, "logging": 1.0} | {name: size})
    for name, value in (("noise", size), ("prior", (0.0, size)), ("deployment", size)):
        with pytest.raises(InputError, match=f"{name}.*another unit"):
            decide_redesign([1.0, 2.0], EUR, **{name: value})
    with pytest.raises(InputError, match=r"gains.*another unit"):
        decide_redesign([0.0, size], EUR)


def test_the_unit_does_not_matter():
    cents = RedesignCost(cost=2e4, serves=40, unit="cent", worth=200.0, logging=100.0)
    one, other = (decide_redesign([3.0, 2.0, 4.0], terms) for terms in (EUR, cents))
    assert one.status is other.status
    assert other.worth == pytest.approx(100 * one.worth)


@pytest.mark.parametrize(("options", "said"), [
    ({"unit": ""}, "unit"), ({"worth": None}, "worth"), ({"cost": -1.0}, "cost"), ({"serves": 0.0}, "serves"),
    ({"cost": np.nan}, "cost"), ({"logging": -1.0}, "logging"), ({"worth": -2.0}, "worth"),
])  # fmt: skip
def test_wrong_terms_are_named(options, said):
    with pytest.raises(InputError, match=said):
        RedesignCost(**{"cost": 200.0, "serves": 40, "unit": "EUR", "worth": 2.0} | options)


@pytest.mark.parametrize(("gains", "options"), [
    ([1.0], {}), ([], {"noise": 1.0}), ([np.nan, 1.0], {}), ([1.0, 2.0], {"noise": -1.0}),
    ([1.0, 2.0], {"prior": (0.0, 0.0)}), ("many", {}), ([[1.0], [2.0, 3.0]], {}), ([1.0, 2.0], {"deployment": 0.0}),
    ([1.0, 2.0], {"deployment": np.nan}), ([1.0, 2.0], {"deployment": -1.0}), ([1.0, 2.0], {"terms": None}),
])  # fmt: skip
def test_wrong_measurements_are_named(gains, options):
    with pytest.raises(InputError, match=r"gains|noise|prior|deployment|terms"):
        decide_redesign(gains, **{"terms": EUR} | options)


@pytest.mark.parametrize("count", [2, 3, 8])
def test_the_interval_covers_as_often_as_it_says(count):
    rng = np.random.default_rng(count)
    found = [decide_redesign(rng.normal(2.5, 4.0, count), EUR).redesign for _ in range(1000)]
    covered = np.mean([low <= EUR.serves * EUR.worth * 2.5 - EUR.cost <= high for low, high in found])
    assert abs(covered - 0.95) < 4 * np.sqrt(0.95 * 0.05 / 1000)


def test_without_a_measurement_the_prior_decides():
    assert decide_redesign([], EUR, noise=1.0, prior=(9.0, 0.1)).status.value == "redesign now"
    assert decide_redesign([], EUR, noise=1.0, prior=(-9.0, 0.1)).status.value == "stop"


def test_money_and_a_price_in_return_exclude_each_other(illustrative):
    terms = RedesignCost(cost=200.0, serves=500, unit="EUR", worth=1.0)
    with pytest.raises(InputError, match="redesign_price"):
        replace(illustrative, redesign_cost=terms, redesign_price="3 return")


def test_a_text_states_what_a_redesign_costs():
    assert RedesignCost.parse("500 EUR, serves 2000, worth 0.3, logging 20") == RedesignCost(500, 2000, "EUR", 0.3, 20)
    assert RedesignCost.parse("12 return,serves 2e2") == RedesignCost(12, 200, "return")
    for text in (
        None,
        "",
        "EUR 500, serves 2",
        "500 EUR serves 2",
        "500, serves 2",
        "5 EUR, serves 2, worth x",
        "5 EUR,",
        "5 EUR, serves 1, serves 2",
    ):
        with pytest.raises(InputError, match=r"redesign_cost: .*expected a text like"):
            RedesignCost.parse(text)
    with pytest.raises(InputError, match="cost: got -5"):
        RedesignCost.parse("-5 return, serves 9")
    with pytest.raises(InputError, match="worth: got 3"):
        RedesignCost(5.0, 10.0, "return", worth=3.0)
    with pytest.raises(InputError, match='called "return"'):
        RedesignCost.parse("12 returns, serves 9")
