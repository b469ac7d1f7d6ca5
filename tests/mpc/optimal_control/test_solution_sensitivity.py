"""Derivatives of optimal trajectories are those of differences of solutions, by every transcription, in any units."""

import casadi as ca
import numpy as np
import pytest
from differences import distance, slopes

from mpc import SensitivityStatus
from mpc.optimal_control import (
    HermiteSimpson,
    MultipleShooting,
    OptimalControlProblem,
    Phase,
    Radau,
    Trapezoidal,
    build,
    solve,
)

REQUIRED = 1e-5
P = np.array([2.0, 0.3])


def pendulum(start=(1.0, 0.0), length=1.0, force=1.0, **changes):
    """A damped pendulum with limits, lengths and forces in other units."""

    def dynamics(x, u, p):
        z = x / length
        return length * ca.vertcat(z[1], -p[0] * ca.sin(z[0]) - p[1] * z[1] + u / force)

    given = {
        "stage_cost": lambda x, u: ca.sumsqr(x / length) + 0.1 * (u / force) ** 2,
        "start": list(np.array(start) * length), "duration": 2.0, "u_bounds": (-0.8 * force, 0.8 * force),
        "terminal_cost": lambda x: 3 * ca.sumsqr(x / length),
    } | changes  # fmt: skip
    return OptimalControlProblem(Phase(dynamics=dynamics, states=2, inputs=1, **given), p_bounds=([0, 0], [5, 5]))


def tight(program, p=P):
    """A solution to the last digits."""
    return solve(program, p=p, tolerance=1e-12)


@pytest.mark.long
@pytest.mark.parametrize(
    "scheme", [MultipleShooting(), Trapezoidal(), HermiteSimpson(), Radau(3)], ids=lambda scheme: scheme.name
)
def test_derivatives_are_those_of_differences(scheme):
    program = build(pendulum(), scheme, 20)
    found = tight(program)
    derivatives = found.sensitivity()
    assert derivatives.smooth
    steps = [1e-3, 1e-3]
    assert distance(derivatives.cost_by_parameters, slopes(lambda p: tight(program, p).cost, P, steps)) < REQUIRED
    inputs = slopes(lambda p: tight(program, p).phases[0].inputs, P, steps)
    assert distance(derivatives.phases[0].inputs_by_parameters, inputs) < REQUIRED
    states = slopes(lambda p: tight(program, p).phases[0].states, P, steps)
    assert distance(derivatives.phases[0].states_by_parameters, states) < REQUIRED
    gradients = slopes(lambda p: tight(program, p).p_gradient, P, steps)
    assert distance(derivatives.cost_curvature, gradients) < REQUIRED

    def from_start(x):
        return tight(build(pendulum(tuple(x)), scheme, 20))

    start = np.array([1.0, 0.0])
    assert distance(derivatives.cost_by_start, slopes(lambda x: from_start(x).cost, start, steps)) < REQUIRED
    inputs = slopes(lambda x: from_start(x).phases[0].inputs, start, steps)
    assert distance(derivatives.phases[0].inputs_by_start, inputs) < REQUIRED
    assert derivatives.cost_by_start == pytest.approx(found.costate(0.0), rel=1e-6)


def test_path_constraints_and_free_final_time():
    def problem():
        phase = Phase(
            dynamics=lambda x, u, p: ca.vertcat(x[1], u / p[0] - p[1] * x[1]), states=2, inputs=1, start=[0, 0],
            end=[1, 0], duration=(0.1, 10), u_bounds=(-2, 2), path=lambda x: x[1], path_bounds=(-1.0, 0.7),
            terminal_cost=lambda t: t, stage_cost=lambda u: 0.05 * u**2,
        )  # fmt: skip
        return OptimalControlProblem(phase, p_bounds=([0.1, 0], [5, 5]))

    program = build(problem(), Radau(2), 20)
    p = np.array([1.0, 0.2])
    derivatives = tight(program, p).sensitivity()
    assert derivatives.status in (SensitivityStatus.SMOOTH, SensitivityStatus.ONE_SIDED)
    expected = slopes(lambda q: tight(program, q).cost, p, [1e-3, 1e-3])
    assert distance(derivatives.cost_by_parameters, expected) < REQUIRED


@pytest.mark.parametrize(("length", "force"), [(1e3, 1e-3), (1e-3, 1e6)])
def test_units_do_not_matter(length, force):
    plain = tight(build(pendulum(), Radau(3), 20)).sensitivity()
    scaled = tight(build(pendulum(length=length, force=force), Radau(3), 20)).sensitivity()
    assert scaled.status is plain.status
    assert distance(scaled.cost_by_parameters, plain.cost_by_parameters) < 1e-7
    assert distance(scaled.cost_curvature, plain.cost_curvature) < 1e-6
    own, other = scaled.phases[0], plain.phases[0]
    assert distance(own.inputs_by_parameters / force, other.inputs_by_parameters) < 1e-6
    assert distance(own.inputs_by_start * length / force, other.inputs_by_start) < 1e-6


def test_a_bound_that_is_just_met_is_flagged_by_name():
    free = build(pendulum(u_bounds=(-50, 50)), Radau(2), 15)
    largest = np.abs(tight(free).phases[0].inputs).max()
    found = tight(build(pendulum(u_bounds=(-largest, largest)), Radau(2), 15)).sensitivity()
    assert found.status is SensitivityStatus.ONE_SIDED
    assert any("bound of u1 at t = " in name for name in found.weakly_active)


@pytest.mark.parametrize(("price", "smooth"), [(4.2e-7, False), (1.3e-6, True)])
def test_a_linear_price_holds_an_input_at_its_bound_where_it_is_beyond_the_blur(price, smooth):
    # a thousandth of the curvature of the first input is taken for that of the second, which has none
    phase = Phase(
        dynamics=lambda u: u[0], states=1, inputs=2, start=[0], end=[1], u_bounds=([-5, 0], [5, 1]),
        stage_cost=lambda u: u[0] ** 2 + price * u[1],
    )  # fmt: skip
    found = tight(build(phase, MultipleShooting(), 2), None).sensitivity()
    assert found.smooth == smooth
    assert bool(found.weakly_active) != smooth


def test_inputs_without_a_cost_have_no_derivatives():
    phase = Phase(
        dynamics=lambda x, u: ca.vertcat(u[0] + 0 * u[1]), states=1, inputs=2, start=[1.0], duration=1.0,
        stage_cost=lambda x, u: x**2 + u[0] ** 2,
    )  # fmt: skip
    found = solve(build(phase, Radau(2), 10)).sensitivity()
    assert found.status is SensitivityStatus.SINGULAR
    assert np.isnan(found.cost_by_start).all()


def test_solves_that_stop_early_have_none_either():
    found = solve(build(pendulum(), Radau(3), 20), p=P, max_iterations=1)
    assert not found.solved
    derivatives = found.sensitivity()
    assert derivatives.status is SensitivityStatus.UNSOLVED
    assert np.isnan(derivatives.cost_by_parameters).all()
    assert derivatives.phases[0].states_by_parameters.shape == (21, 2, 2)
