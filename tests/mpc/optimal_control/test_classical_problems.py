"""Classical problems reach their published optima from plain guesses, and their known multipliers."""

import numpy as np
import pytest
from classical_problems import CLASSICAL, FREE_FLYING_ROBOT
from scipy.integrate import quad

from mpc.optimal_control import HermiteSimpson, Radau, build, refine, solve


@pytest.mark.long
@pytest.mark.quick(10)
@pytest.mark.parametrize("name", CLASSICAL)
def test_published_optimum_is_reached(name):
    case = CLASSICAL[name]
    solution = refine(case.phase, **case.options)
    assert solution.solved, (solution.message, solution.conflicts)
    assert solution.cost == pytest.approx(case.cost, rel=1e-4), case.source


def test_hypersensitive_cost_is_that_of_its_two_ends():
    # On an endless horizon the Hamiltonian is 0: (x² − λ²)/2 − λ x³ = 0, so V'(x) = λ = −x³ ± sqrt(x⁶ + x²).
    falling = quad(lambda x: -(x**3) + np.sqrt(x**6 + x**2), 0, 1.5)[0]
    rising = quad(lambda x: x**3 + np.sqrt(x**6 + x**2), 0, 1.0)[0]
    assert CLASSICAL["hypersensitive"].cost == pytest.approx(falling + rising, rel=1e-6)


@pytest.mark.parametrize("scheme", [Radau(3), HermiteSimpson()], ids=lambda scheme: scheme.name)
def test_bryson_denham_has_its_costates_and_its_arc(scheme):
    solution = solve(build(CLASSICAL["Bryson-Denham"].phase, scheme, 60))
    limit = 1 / 9
    entry, exit_ = 3 * limit, 1 - 3 * limit
    inside = np.linspace(entry, exit_, 15)[1:-1]
    assert solution.x(inside)[:, 0] == pytest.approx(limit, abs=1e-5)
    assert solution.u(inside) == pytest.approx(0.0, abs=1e-3)
    before, after = np.linspace(0.02, 0.30, 5), np.linspace(0.70, 0.98, 5)
    assert solution.costate(before)[:, 0] == pytest.approx(2 / (9 * limit**2), rel=1e-3)
    assert solution.costate(after)[:, 0] == pytest.approx(-2 / (9 * limit**2), rel=1e-3)
    assert solution.costate(before)[:, 1] == pytest.approx(2 / (3 * limit) * (1 - before / entry), rel=1e-3)
    assert solution.u(before)[:, 0] == pytest.approx(-2 / (3 * limit) * (1 - before / entry), rel=2e-3)


def test_refinement_finds_the_arc():
    solution = refine(CLASSICAL["Bryson-Denham"].phase, Radau(3), intervals=8)
    lengths = np.diff(solution.times)
    cut = 0.5 * (solution.times[1:] + solution.times[:-1])[lengths < 0.5 * lengths.max()]
    for corner in (1 / 3, 2 / 3):  # where the state meets its limit, and where it leaves it
        assert np.abs(cut - corner).min() < 0.02
    assert np.minimum(np.abs(cut - 1 / 3), np.abs(cut - 2 / 3)).max() < 0.125  # within the interval that it was in
    assert solution.cost == pytest.approx(4.0, rel=1e-6)


@pytest.mark.check
@pytest.mark.parametrize("intervals", [10, 25])
def test_a_robot_of_four_thrusters_reaches_its_published_least_fuel(intervals):
    solution = refine(FREE_FLYING_ROBOT.phase, intervals=intervals)
    assert solution.solved, solution.advice
    assert solution.cost <= FREE_FLYING_ROBOT.cost * (1 + 1e-6)
