"""Whole-number inputs: the gap of their integrals, its bound, and two problems of the literature."""

from dataclasses import replace

import casadi as ca
import numpy as np
import pytest
from scipy.integrate import solve_ivp

from mpc import InputError
from mpc.optimal_control import (
    MultipleShooting,
    OptimalControlProblem,
    Phase,
    Radau,
    Trapezoidal,
    build,
    refine,
    round_inputs,
    solve,
    sum_up_rounding,
)


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
        relaxed, durations = rng.dirichlet(np.full(m, 0.3), n), rng.uniform(0.01, 1.0, n)
        found = sum_up_rounding(relaxed, durations, one_of=True)
        np.testing.assert_array_equal(found.inputs.sum(axis=1), np.ones(n))
        assert gap_of(relaxed, found.inputs, durations) <= found.bound == pytest.approx((m - 1) * durations.max())


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


def fish(x, u):
    """Lotka and Volterra's fish, and a fishing fleet that is out or not (Sager 2005; relaxed 1.34408)."""
    return ca.vertcat(x[0] - x[0] * x[1] - 0.4 * x[0] * u[0], -x[1] + x[0] * x[1] - 0.2 * x[1] * u[0])


def tanks(x, u):
    """Double tank of mintOC: one of two flows at a time, the lower level near 3."""
    return ca.vertcat(u[0] + 2 * u[1] - ca.sqrt(x[0]), ca.sqrt(x[0]) - ca.sqrt(x[1]))


FISHING = Phase(fish, 2, 1, stage_cost=lambda x: ca.sumsqr(x - 1), start=[0.5, 0.7], duration=12.0, u_bounds=(0, 1))
PUMPING = Phase(
    tanks, 2, 2, stage_cost=lambda x: 2 * (x[1] - 3) ** 2, start=[2.0, 2.0], duration=10.0, u_bounds=(0, 1),
    path=lambda u: u[0] + u[1], path_bounds=(1.0, 1.0),
)  # fmt: skip


def integrated(phase, inputs):
    """States at the end and the cost, by SciPy."""
    x, u = ca.SX.sym("x", 2), ca.SX.sym("u", phase.inputs)
    f = ca.Function("f", [x, u], [ca.vertcat(phase.dynamics(x, u), phase.stage_cost(x))])
    y = np.append(phase.start[0], 0.0)
    for held in inputs:

        def rates(t, y, held=held):
            return np.asarray(f(y[:2], held)).ravel()

        span = (0, phase.duration[0] / len(inputs))
        y = solve_ivp(rates, span, y, method="DOP853", rtol=1e-10, atol=1e-12).y[:, -1]
    return y[:2], y[2]


@pytest.mark.long
def test_fishing_or_not_comes_as_near_as_one_likes_to_the_relaxed_optimum():
    best = refine(FISHING, Radau(3), intervals=40)
    assert best.cost == pytest.approx(1.34408, abs=5e-6)
    costs = []
    for intervals in (100, 400, 1600):
        rounded, held = round_inputs(solve(build(FISHING, Radau(3), intervals), start=best))
        assert held.status.name == "SOLVED"
        assert set(rounded.inputs.ravel()) == {0.0, 1.0}
        np.testing.assert_allclose(held.u(12 * (np.arange(intervals) + 0.5) / intervals), rounded.inputs, atol=1e-12)
        assert rounded.gap <= rounded.bound == pytest.approx(6 / intervals)
        costs.append(held.cost)
    assert costs[0] > costs[1] > costs[2] > best.cost - 1e-6
    assert costs[2] == pytest.approx(best.cost, abs=2e-5)


@pytest.mark.parametrize("scheme", [Radau(3), Radau(5), MultipleShooting(4)])
@pytest.mark.parametrize(("phase", "one_of"), [(FISHING, False), (PUMPING, True)])
def test_the_rounded_trajectory_is_that_of_an_own_integration(phase, one_of, scheme):
    relaxed = solve(build(phase, scheme, 60))
    rounded, held = round_inputs(relaxed, one_of=one_of)
    at_end, cost = integrated(phase, rounded.inputs)
    np.testing.assert_allclose(held.phases[0].states[-1], at_end, rtol=1e-6)
    assert held.cost == pytest.approx(cost, rel=1e-6)
    starts = relaxed.times[:-1]
    means = np.mean([relaxed.u(starts + at * np.diff(relaxed.times)) for at in np.arange(0.005, 1, 0.01)], axis=0)
    assert gap_of(means, rounded.inputs, np.diff(relaxed.times)) == pytest.approx(rounded.gap, rel=2e-3)


@pytest.mark.long
def test_one_of_two_pumps_of_a_double_tank_at_a_time():
    best = solve(build(PUMPING, Radau(3), 100))
    found = [round_inputs(solve(build(PUMPING, Radau(3), n), start=best), one_of=True) for n in (50, 200)]
    for rounded, held in found:
        np.testing.assert_array_equal(rounded.inputs.sum(axis=1), np.ones(len(rounded.inputs)))
        assert rounded.gap <= rounded.bound == pytest.approx(10 / len(rounded.inputs))
        assert held.status.name == "SOLVED"
    costs = [held.cost for _, held in found]
    assert abs(costs[1] - best.cost) < abs(costs[0] - best.cost) < 1e-3


def test_what_is_not_whole_is_optimised_anew():
    """A mass by the shortest time, with a thruster that is on or off and a small one that is not."""
    phase = Phase(
        lambda x, u: ca.vertcat(x[1], u[0] + u[1]), 2, 2, terminal_cost=lambda t: t, start=[0.0, 0.0], end=[1.0, 0.0],
        duration=(0.1, 10.0), u_bounds=([-1, -0.1], [1, 0.1]),
    )  # fmt: skip
    relaxed = solve(build(phase, Radau(3), 41))
    rounded, held = round_inputs(relaxed, inputs=[0])
    assert relaxed.cost == pytest.approx(2 / np.sqrt(1.1), rel=1e-4)  # a switch within an interval
    assert held.status.name == "SOLVED"
    np.testing.assert_array_equal(held.phases[0].inputs[:, 0], np.repeat(rounded.inputs[:, 0], 3))
    np.testing.assert_allclose(held.phases[0].states[-1], [1.0, 0.0], atol=1e-6)
    assert relaxed.cost - 1e-6 < held.cost < 1.01 * relaxed.cost


def test_discrete_dynamics_and_algebraic_variables_are_rounded():
    steps = Phase(lambda x, u: x + 0.3 * u - 0.1, 1, 1, stage_cost=lambda x: (x - 1) ** 2, start=[0.0], duration=40,
                  discrete=True, u_bounds=(0, 2))  # fmt: skip
    rounded, held = round_inputs(solve(steps))
    assert held.status.name == "SOLVED"
    x = np.concatenate([[0.0], np.cumsum(0.3 * rounded.inputs[:, 0] - 0.1)])
    np.testing.assert_allclose(held.phases[0].states[:, 0], x, atol=1e-7)
    tank = Phase(lambda x, z, u: u[0] - z, 1, 1, stage_cost=lambda x: (x[0] - 1) ** 2, start=[1.0], duration=2.0,
                 u_bounds=(0, 4), algebraic=lambda x, z: z + z**3 - 2 * x, algebraics=1, z_guess=1.0)  # fmt: skip
    rounded, held = round_inputs(solve(build(tank, Radau(3), 40)))
    assert held.status.name == "SOLVED"
    assert rounded.inputs.shape == (40, 1)
    t = np.linspace(0, 2, 21)
    z = held.z(t)
    np.testing.assert_allclose(z + z**3, 2 * held.x(t), atol=1e-6)


def test_limits_that_whole_inputs_cannot_keep_are_conflicts():
    """A mass that has to rest at a place: by forces of one newton on five intervals it does not."""
    phase = Phase(
        lambda x, u: ca.vertcat(x[1], u), 2, 1, stage_cost=lambda u: u**2, start=[0.0, 0.0], end=[0.5, 0.0],
        duration=2.0, u_bounds=(-1, 1), state_names=("place", "speed"),
    )  # fmt: skip
    _, held = round_inputs(solve(build(phase, Radau(3), 5)))
    assert held.status.name == "INFEASIBLE"
    assert any("end of place" in conflict for conflict in held.conflicts)


@pytest.mark.parametrize(("changes", "options", "said"), [
    ({}, {"inputs": [1]}, "inputs"), ({}, {"inputs": []}, "inputs"), ({}, {"inputs": [0, 0]}, "inputs"),
    ({}, {"inputs": [0.0]}, "inputs"), ({}, {"inputs": [[0], [0, 0]]}, "inputs"), ({}, {"inputs": False}, "inputs"),
    ({"u_bounds": (0, 2.5)}, {}, "whole bounds"), ({"u_bounds": (0, np.inf)}, {}, "whole bounds"),
    ({}, {"one_of": True}, "sum to 1"),
])  # fmt: skip
def test_wrong_roundings_are_named(changes, options, said):
    with pytest.raises(InputError, match=said):
        round_inputs(solve(build(replace(FISHING, **changes), Radau(3), 5)), **options)


def test_only_solutions_of_one_phase_whose_inputs_may_jump_are_rounded():
    two = OptimalControlProblem([FISHING, FISHING], linked=False)
    for given in (np.zeros(3), solve(build(FISHING, Trapezoidal(), 5)), solve(build(two, Radau(3), 5))):
        with pytest.raises(InputError, match="may jump"):
            round_inputs(given)
