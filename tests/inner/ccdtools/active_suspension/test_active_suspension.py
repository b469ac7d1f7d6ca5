"""Simultaneous and nested co-design of the detailed suspension, on a synthetic road and on the recorded one."""

from functools import cache

import numpy as np
import pytest
from active_suspension.detailed_suspension import detailed_active_suspension
from active_suspension.independent import damping, rules_along, rules_of_design, simulated, stiffness  # fmt: skip
from active_suspension.roads import SOURCE, recorded_road, recording, synthetic_road
from active_suspension.run import ramp
from active_suspension.statement import OF_RAMP, OF_ROUGH, PUBLISHED, STARTS, WEIGHTS, meshes, problem
from active_suspension.strategies import Inner, nested, simultaneous
from scipy.integrate import solve_ivp

from mpc.optimal_control import OptimalControlProblem, Radau, build, solve

STIFF = np.array([0.0199, 0.1355, 0.03365, 10.57, 0.00935, 0.0403, 0.17])  # far from every limit of travel
COARSE = (60, 0.05)


@pytest.fixture(scope="module")
def plant():
    """Return the published statement."""
    return detailed_active_suspension(published=True)


@cache
def found(strategy, start):
    """What a strategy finds on the synthetic road, once."""
    plant = detailed_active_suspension(published=True)
    return strategy(plant, synthetic_road(), STARTS[start], meshes(*COARSE))


def tracking_cost(p, road):
    """Least cost of a known road without limits: Riccati's equation and its feedforward, integrated backwards."""
    k, c, s, us, tyre = stiffness(p), damping(p), 325.0, 65.0, 232.5e3
    A = np.array([[0, 1, 0, 0], [-tyre / us, -c / us, k / us, c / us], [0, -1, 0, 1], [0, c / s, -k / s, -c / s]])
    B = np.array([0, -1 / us, 0, 1 / s])
    E = np.array([-1.0, 0, 0, 0])
    Q = np.diag([1e5, 0, 0, 0]) + 0.5 * np.outer(A[3], A[3])
    N, R = 0.5 * A[3] / s, 1e-5 + 0.5 / s**2

    def backwards(tau, y):
        P, f = y[:16].reshape(4, 4), y[16:20]
        K = (B @ P + N) / R
        push = P @ E * road(np.array([2.0 - tau]))[0]
        w = road(np.array([2.0 - tau]))[0]
        dP = A.T @ P + P @ A + Q - R * np.outer(K, K)
        return np.concatenate([dP.ravel(), (A - np.outer(B, K)).T @ f + push, [2 * f @ E * w - (B @ f) ** 2 / R]])

    return solve_ivp(backwards, (0, 2.0), np.zeros(21), method="LSODA", rtol=1e-9, atol=1e-9).y[-1, -1]


@pytest.mark.check
def test_without_active_limits_the_cost_is_that_of_riccati(plant):
    road = synthetic_road()
    both = problem(plant, road, STIFF, rules=False)
    alone = OptimalControlProblem(both.phases[0], p_bounds=both.p_bounds, p_guess=STIFF)
    solution = solve(build(alone, Radau(3), 200), p=STIFF)
    assert solution.solved
    assert solution.cost == pytest.approx(tracking_cost(STIFF, road), rel=2e-5)


@pytest.mark.check
def test_gradient_of_the_optimal_cost_is_that_of_differences_where_limits_are_active(plant):
    p = np.array(PUBLISHED["simultaneous"])
    inner = Inner(plant, synthetic_road(), p, meshes(20, 0.1))
    gradient = inner.at(p).p_gradient
    for i in (0, 2, 5):
        step = -1e-4 * np.eye(7)[i] * p  # the wire is at its bound
        ahead, further = inner.at(p + step).cost, inner.at(p + 2 * step).cost
        slope = (4 * ahead - further - 3 * inner.at(p).cost) / (2 * step[i])
        assert gradient[i] == pytest.approx(slope, rel=1e-3, abs=1e-5 * np.abs(gradient).max())


@pytest.mark.check
def test_both_strategies_reach_one_cost():
    together = [found(simultaneous, start) for start in ("theirs, 1", "theirs, 3")]
    for one in (*together, found(nested, "theirs, 1")):
        assert one.solution.solved_on_mesh
        assert one.solution.cost == pytest.approx(together[0].solution.cost, rel=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize("start", ["theirs, 2", "theirs, 3", "theirs, 7"])
def test_nested_reaches_that_cost_from_every_published_start(start):
    assert found(nested, start).solution.cost == pytest.approx(found(simultaneous, start).solution.cost, rel=1e-5)


@pytest.mark.check
def test_equal_costs_are_those_of_one_stiffness_and_damping_in_different_dimensions():
    designs = np.array([found(simultaneous, "theirs, 1").p, found(nested, "theirs, 1").p])
    assert np.abs(designs[1] / designs[0] - 1).max() > 0.2
    assert stiffness(designs[1]) == pytest.approx(stiffness(designs[0]), rel=1e-4)
    assert damping(designs[1]) == pytest.approx(damping(designs[0]), rel=1e-3)


@pytest.mark.check
@pytest.mark.parametrize("strategy", [simultaneous, nested], ids=["simultaneous", "nested"])
def test_rules_and_cost_hold_in_a_simulation_that_shares_no_code(strategy):
    one = found(strategy, "theirs, 1")
    assert max(rules_of_design(one.p).values()) < 1e-6
    total = 0.0
    for phase, speed, weight, kept in zip(one.solution.phases, (synthetic_road(), ramp), WEIGHTS, (OF_ROUGH, OF_RAMP)):
        states, cost = simulated(one.p, phase, speed)
        rules = rules_along(one.p, states, True)
        assert max(rules[name].max() for name in kept) < 2e-3  # between the points of a coarse mesh
        total += weight * cost
    assert total == pytest.approx(one.solution.cost, rel=0.01)


def test_the_published_designs_are_not_beaten_by_more_than_their_rounding_on_the_recorded_road(plant):
    path = recording()
    if path is None:
        pytest.skip(f"the recorded road is not part of the project; set CCDTOOLS_DATA to a folder with {SOURCE}")
    road, mesh = recorded_road(path), meshes(200, 0.02)
    best = simultaneous(plant, road, STARTS["theirs, 1"], mesh)
    inner = Inner(plant, road, best.p, mesh)
    assert best.solution.solved
    assert best.solution.cost == pytest.approx(2.06684, rel=1e-4)
    for name in PUBLISHED:
        theirs = inner.at(plant.design.project(PUBLISHED[name]))
        assert best.solution.cost <= theirs.cost <= 1.005 * best.solution.cost
