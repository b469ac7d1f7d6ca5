"""Whole-number inputs: the gap of their integrals, its bound, and two problems of the literature."""

import casadi as ca
import numpy as np
import pytest
from scipy.integrate import solve_ivp

from mpc import InputError
from mpc.optimal_control import Phase, Radau, RoundingStatus, refine, round_inputs, sum_up_rounding


def gap_of(relaxed, whole, durations):
    """Largest difference of the integrals, over all times and columns."""
    return np.abs(np.cumsum((relaxed - whole) * durations[:, None], axis=0)).max()


@pytest.mark.parametrize("m", [1, 2, 5])
def test_integrals_follow_within_half_an_interval(m):
    rng = np.random.default_rng(m)
    for _ in range(50):
        n = int(rng.integers(1, 60))
        relaxed, durations = rng.uniform(-2, 3, (n, m)), rng.uniform(0.1, 2.0, n)
        durations = np.full(n, durations[0])
        found = sum_up_rounding(relaxed, durations)
        assert found.gap == pytest.approx(gap_of(relaxed, found.inputs, durations))
        assert found.gap <= found.bound * (1 + 1e-12)
        assert found.bound == pytest.approx(durations[0] / 2)
        assert (found.inputs == np.round(found.inputs)).all()


@pytest.mark.parametrize("m", [2, 3, 6])
def test_exactly_one_is_on_and_the_bound_is_kept(m):
    rng = np.random.default_rng(10 + m)
    for _ in range(50):
        n = int(rng.integers(1, 80))
        relaxed, durations = rng.dirichlet(np.full(m, 0.3), n), np.full(n, 0.5)
        found = sum_up_rounding(relaxed, durations, one_of=True)
        np.testing.assert_array_equal(found.inputs.sum(axis=1), np.ones(n))
        assert gap_of(relaxed, found.inputs, durations) <= found.bound


def test_unequal_intervals_keep_the_bound():
    rng = np.random.default_rng(3)
    for _ in range(50):
        relaxed, durations = rng.uniform(0, 1, (40, 1)), rng.uniform(0.01, 1.0, 40)
        found = sum_up_rounding(relaxed, durations)
        assert gap_of(relaxed, found.inputs, durations) <= found.bound


@pytest.mark.parametrize(("relaxed", "durations", "options", "said"), [
    (np.zeros((3, 1)), np.zeros(3), {}, "durations"),
    (np.zeros((3, 1)), np.ones(2), {}, "durations"),
    (np.full((3, 1), np.nan), np.ones(3), {}, "relaxed"),
    (np.full((3, 2), 0.4), np.ones(3), {"one_of": True}, "sum to 1"),
    (np.zeros((0, 1)), np.zeros(0), {}, "durations"),
])  # fmt: skip
def test_wrong_relaxations_are_named(relaxed, durations, options, said):
    with pytest.raises(InputError, match=said):
        sum_up_rounding(relaxed, durations, **options)


# ── along a solution ──


@pytest.fixture(scope="module")
def fishing():
    """Lotka and Volterra's fish, with fishing that is relaxed (Sager 2005; 1.34408)."""

    def rates(x, u):
        return ca.vertcat(x[0] - x[0] * x[1] - 0.4 * x[0] * u, -x[1] + x[0] * x[1] - 0.2 * x[1] * u)

    phase = Phase(rates, 2, 1, stage_cost=lambda x: ca.sumsqr(x - 1), start=[0.5, 0.7], duration=12.0, u_bounds=(0, 1))
    return refine(phase, Radau(3), intervals=40)


def test_fishing_or_not_comes_as_near_as_one_likes_to_the_relaxed_optimum(fishing):
    assert fishing.cost == pytest.approx(1.34408, abs=5e-6)
    costs = []
    for intervals in (100, 400, 1600):
        found = round_inputs(fishing, intervals=intervals)
        assert found.status is RoundingStatus.KEPT
        assert set(found.inputs.ravel()) == {0.0, 1.0}
        assert found.gap <= found.bound == pytest.approx(6 / intervals)
        costs.append(found.cost)
    assert costs[0] > costs[1] > costs[2] > fishing.cost - 1e-6
    assert costs[2] == pytest.approx(fishing.cost, abs=2e-5)


def test_the_rounded_trajectory_is_that_of_an_own_integration(fishing):
    found = round_inputs(fishing, intervals=60)
    y = np.array([0.5, 0.7, 0.0])
    for u in found.inputs[:, 0]:

        def rates(t, y, u=u):
            a, b, _ = y
            return [a - a * b - 0.4 * a * u, -b + a * b - 0.2 * b * u, (a - 1) ** 2 + (b - 1) ** 2]

        y = solve_ivp(rates, (0, 0.2), y, rtol=1e-10, atol=1e-12).y[:, -1]
    np.testing.assert_allclose(found.states[-1], y[:2], rtol=1e-6)
    assert found.cost == pytest.approx(y[2], rel=1e-6)


def test_one_of_two_pumps_of_a_double_tank():
    """Double tank of mintOC: one of two flows at a time, the lower level near 3."""

    def rates(x, u):
        return ca.vertcat(u[0] + 2 * u[1] - ca.sqrt(x[0]), ca.sqrt(x[0]) - ca.sqrt(x[1]))

    phase = Phase(
        rates, 2, 2, stage_cost=lambda x: 2 * (x[1] - 3) ** 2, start=[2.0, 2.0], duration=10.0, u_bounds=(0, 1),
        path=lambda u: u[0] + u[1], path_bounds=(1.0, 1.0),
    )  # fmt: skip
    relaxed = refine(phase, Radau(3), intervals=40)
    assert relaxed.status.name == "SOLVED"
    found = [round_inputs(relaxed, intervals=n, one_of=True) for n in (100, 1000)]
    for one in found:
        np.testing.assert_array_equal(one.inputs.sum(axis=1), np.ones(len(one.inputs)))
        assert one.gap <= one.bound
        assert one.status is RoundingStatus.KEPT
    assert found[1].cost == pytest.approx(relaxed.cost, rel=3e-3)
    assert abs(found[1].cost - relaxed.cost) < abs(found[0].cost - relaxed.cost)


def test_a_limit_that_whole_inputs_break_is_named():
    """A mass that has to stop within a wall: with whole forces on few intervals it does not."""
    phase = Phase(
        lambda x, u: ca.vertcat(x[1], u), 2, 1, stage_cost=lambda u: u**2, start=[0.0, 0.0], end=[0.5, 0.0],
        duration=2.0, u_bounds=(-1, 1), state_names=("place", "speed"),
    )  # fmt: skip
    found = round_inputs(refine(phase, Radau(3), intervals=10), intervals=5)
    assert found.status is RoundingStatus.VIOLATED
    assert any("end of" in name for name in found.violations)


@pytest.mark.parametrize(("options", "said"), [
    ({"intervals": 0}, "intervals"), ({"inputs": [1]}, "inputs"), ({"inputs": []}, "inputs"),
    ({"inputs": [0, 0]}, "inputs"),
])  # fmt: skip
def test_wrong_roundings_are_named(fishing, options, said):
    with pytest.raises(InputError, match=said):
        round_inputs(fishing, **options)


def test_only_solutions_are_rounded():
    with pytest.raises(InputError, match="solution"):
        round_inputs(np.zeros(3))
