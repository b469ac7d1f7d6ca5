"""Trade-offs, many starts and the sensitivity of the optimum, beside the exact cost of LQR."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import minimize_scalar
from small_plants import best_design, exact_return, mass, two_valleys

from ccdtools import InputError, Nested, QuadraticObjective, multi_start, optimum_sensitivity, trade_off

NESTED = Nested(starts=1, runs=200)


def priced(scale: float = 1.0):
    """The mass, which costs so much a kilogram."""
    own = mass()
    objective = QuadraticObjective(own.objective.Q, own.objective.R, design_cost=lambda p: scale * p[0])
    return replace(own, objective=objective)


def exact_best(weight: float, price: float) -> float:
    """The best mass for a weight of the position and a price, by the Lyapunov recursion."""
    own = mass()
    stated = replace(own, objective=QuadraticObjective(np.diag([weight, 1.0]), own.objective.R))

    def cost(m: float) -> float:
        return -exact_return(stated, [m]) + price * m

    return float(minimize_scalar(cost, bounds=(0.2, 3.0), method="bounded", options={"xatol": 1e-10}).x)


def weighted(weight: float):
    own = mass()
    return replace(own, objective=QuadraticObjective(np.diag([weight, 1.0]), own.objective.R))


@pytest.fixture(scope="module")
def found():
    return trade_off(priced(), [0.0, 2.0, 8.0], method=NESTED)


@pytest.mark.long
def test_designs_over_a_price_are_the_exact_ones(found):
    np.testing.assert_allclose(found.designs[:, 0], [exact_best(10.0, price) for price in found.values], atol=0.01)


def test_what_is_paid_falls_and_so_does_what_control_brings(found):
    assert (np.diff(found.design_costs) < 0).all()
    assert (np.diff(found.control_returns) < 0).all()
    assert found.efficient.all()
    np.testing.assert_allclose(found.design_costs, found.designs[:, 0])  # at price 1, one a kilogram


def test_a_trade_off_is_shown(found, tmp_path):
    assert len(str(found).splitlines()) == 4
    found.plot().savefig(tmp_path / "shown.png")
    assert (tmp_path / "shown.png").read_bytes().startswith(b"\x89PNG")


@pytest.mark.long
def test_a_function_of_a_weight_gives_the_same_as_prices():
    beside = trade_off(priced, [2.0, 8.0], method=NESTED)
    np.testing.assert_allclose(beside.designs[:, 0], [exact_best(10.0, price) for price in (2.0, 8.0)], atol=0.01)
    np.testing.assert_allclose(beside.design_costs, beside.values * beside.designs[:, 0])


@pytest.mark.parametrize(
    ("args", "argument"),
    [((mass(), [1.0]), "problem"), ((priced(), [-1.0]), "values"), ((3, [1.0]), "problem"),
     ((lambda v: v, [1.0]), "problem")],
)  # fmt: skip
def test_trade_offs_without_a_meaning_are_refused(args, argument):
    with pytest.raises(InputError) as error:
        trade_off(*args, method=NESTED)
    assert error.value.argument == argument


@pytest.mark.long
@pytest.mark.quick(2)
@pytest.mark.parametrize("inner", ["riccati", "lqr"])
def test_the_slope_of_the_optimum_is_that_of_the_exact_one(inner):
    h = 0.02
    exact = (exact_best(10 + h, 0) - exact_best(10 - h, 0)) / (2 * h)
    found = optimum_sensitivity(weighted, 10.0, inner=inner, runs=200)
    assert found.slope[0] == pytest.approx(exact, rel=0.05)
    assert found.agrees
    assert found.held == ()
    assert repr(found).startswith("OptimumSensitivity(θ = 10: dm/dθ -0.02")


def test_a_design_at_a_bound_does_not_move():
    found = optimum_sensitivity(lambda price: priced(price), 500.0, inner="riccati", design=[0.2])
    assert found.held == ("m lower",)
    assert found.slope[0] == 0.0
    assert found.agrees
    assert found.return_slope == pytest.approx(-0.2, rel=1e-6)  # of the price: the mass itself


@pytest.mark.check
def test_where_the_design_meets_its_bound_the_slopes_to_both_sides_differ():
    low, high = 0.0, 500.0
    for _ in range(40):
        price = (low + high) / 2
        low, high = (price, high) if exact_best(10.0, price) > 0.2 + 1e-6 else (low, price)
    found = optimum_sensitivity(lambda price: priced(price), 1.03 * price, inner="riccati", design=[0.2], step=0.05)
    assert found.ahead[0] == pytest.approx(0.0, abs=1e-6)
    assert found.behind[0] < -1e-3
    assert found.slope == pytest.approx((found.ahead + found.behind) / 2)
    assert not found.agrees
    assert "ahead" in repr(found)


@pytest.mark.check
def test_all_starts_lead_to_the_exact_optimum_and_processes_change_nothing():
    own = mass()
    found = multi_start(own, 3, method=NESTED)
    best, _ = best_design(own)
    np.testing.assert_allclose(found.designs, np.tile(best, (3, 1)), atol=0.01)
    beside = multi_start(own, found.starts, method=NESTED, jobs=2)
    np.testing.assert_array_equal(beside.designs, found.designs)


def test_starts_that_end_apart_are_told_apart_and_the_better_one_is_the_best():
    own = two_valleys()
    found = multi_start(own, [[0.2], [0.85]], method=Nested(starts=1, runs=200, evaluations=1))
    np.testing.assert_allclose(found.designs, found.starts)  # of one evaluation each
    assert found.spread == pytest.approx(0.65)
    assert exact_return(own, [0.85]) > exact_return(own, [0.2])
    assert found.best.design == pytest.approx([0.85])


@pytest.mark.parametrize("starts", [0, [[9.0]], [0.5], "three"])
def test_wrong_starts_are_refused(starts):
    with pytest.raises(InputError, match="starts"):
        multi_start(mass(), starts, method=NESTED)


def test_starts_and_what_each_found_stand_in_a_table():
    own = two_valleys()
    found = multi_start(own, [[0.2], [0.85]], method=Nested(starts=1, runs=50, evaluations=1))
    name = own.design.names[0]
    assert len(found) == 2
    assert [row[name] for row in found.table()] == [result.design[0] for result in found]
    assert [row[f"{name} at first"] for row in found.table()] == pytest.approx([0.2, 0.85])
    heading, *lines = str(found).splitlines()
    assert heading.split() == ["first", "design", "design", "return", "time", "status"]
    assert [line[: len("p = 0.85")].strip() for line in lines] == [f"{name} = 0.2", f"{name} = 0.85"]
    assert "2 starts" in repr(found)
