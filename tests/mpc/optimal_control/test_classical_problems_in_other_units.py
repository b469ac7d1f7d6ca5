"""Further classical problems, whose optima are known by hand, in metres and seconds as in millimetres and minutes."""

import casadi as ca
import numpy as np
import pytest
from classical_problems import CLASSICAL
from scipy.integrate import quad
from scipy.optimize import brentq, fsolve

from mpc.optimal_control import HermiteSimpson, OptimalControlProblem, Phase, Radau, build, refine, solve

V = ca.vertcat
UNITS = pytest.mark.parametrize(("length", "time"), [(1.0, 1.0), (1e3, 1 / 60), (1e-3, 1e3)])


@pytest.mark.long
@UNITS
def test_a_moon_lander_falls_and_then_brakes(length, time):
    # Meditch 1964: least fuel from height 10 at speed −2 under gravity 1.5, thrust up to 3; one switch, by hand
    k = length / time
    fall = brentq(lambda t: (2 + 1.5 * t) ** 2 / 3 - (10 - 2 * t - 0.75 * t**2), 0, 5)
    brake = (2 + 1.5 * fall) / 1.5
    found = refine(Phase(
        lambda x, u: V(x[1], (u - 1.5) * k / time), 2, 1, start=[10 * length, -2 * k], end=[0, 0],
        duration=(0.1 * time, 20 * time), u_bounds=(0, 3), stage_cost=lambda u: u / time,
        x_bounds=([0, -50 * k], [50 * length, 50 * k]),
    ))  # fmt: skip
    assert found.solved, found.advice
    assert found.cost == pytest.approx(3 * brake, rel=1e-6)
    assert found.duration == pytest.approx((fall + brake) * time, rel=1e-5)


@pytest.mark.long
@UNITS
def test_a_hanging_chain_is_a_catenary(length, time):
    # COPS 3.0, problem 2: of length 4, hung at heights 1 and 3 over a width of 1, with its centre of mass at the lowest
    def missed(z):
        a, b, c = z
        ends = [a * np.cosh((t - b) / a) + c for t in (0, 1)]
        return [ends[0] - 1, ends[1] - 3, a * (np.sinh((1 - b) / a) + np.sinh(b / a)) - 4]

    a, b, c = fsolve(missed, [0.2, 0.4, 0.0], xtol=1e-13)
    energy = quad(lambda t: (a * np.cosh((t - b) / a) + c) * np.cosh((t - b) / a), 0, 1, epsabs=1e-12)[0]
    rise = length / time
    found = refine(Phase(
        lambda x, u: V(u, x[0] * ca.sqrt(rise**2 + u**2), ca.sqrt(rise**2 + u**2)), 3, 1, duration=time,
        start=[length, 0, 0], end=[3 * length, None, 4 * length], terminal_cost=lambda x: x[1] / length**2,
        x_bounds=(0, [10 * length, 10 * length**2, 10 * length]), u_bounds=(-20 * rise, 20 * rise),
    ))  # fmt: skip
    assert found.solved, found.advice
    assert found.cost == pytest.approx(energy, rel=1e-6)


@pytest.mark.long
@UNITS
def test_a_way_point_of_free_time_is_passed_on_the_way_to_shortest_time(length, time):
    # two phases of free duration, force at most 1: a way of 3 takes 2√3, and 1 of them √2, wherever it is cut
    def leg(end, **change):
        return Phase(
            lambda x, u: V(x[1], u * length / time**2), 2, 1, end=end, duration=(0.05 * time, 10 * time),
            u_bounds=(-1, 1), **change,
        )  # fmt: skip

    legs = [leg([length, None], start=[0, 0]), leg([3 * length, 0], terminal_cost=lambda t: t / time)]
    found = refine(OptimalControlProblem(legs))
    assert found.solved, found.advice
    assert found.cost == pytest.approx(2 * np.sqrt(3), rel=1e-6)
    assert found.phases[0].duration == pytest.approx(np.sqrt(2) * time, rel=1e-6)
    assert found.x(found.phases[0].duration) == pytest.approx([length, np.sqrt(2) * length / time], rel=1e-5)


def test_a_ball_that_bounces_needs_no_push():
    # its speed turns round at the ground: falls and rises for √2 each
    def flight(**change):
        return Phase(
            lambda x, u: V(x[1], u - 1), 2, 1, duration=(0.1, 5), stage_cost=lambda u: u**2, **change
        )  # fmt: skip

    ends = [flight(start=[1, 0], end=[0, None]), flight(end=[1, 0])]
    found = refine(OptimalControlProblem(ends, link=lambda x: V(x[0], -x[1])))
    assert found.solved
    assert found.cost == pytest.approx(0.0, abs=1e-9)
    assert [phase.duration for phase in found.phases] == pytest.approx([np.sqrt(2)] * 2, rel=1e-5)


def test_a_phase_without_inputs_is_refined():
    found = refine(Phase(lambda x: x, 1, 0, start=[1], end=[5], duration=(0.1, 10), terminal_cost=lambda t: t))
    assert found.solved
    assert found.duration == pytest.approx(np.log(5), rel=1e-6)
    assert found.phases[0].inputs.shape[1] == 0


@UNITS
@pytest.mark.parametrize("scheme", [Radau(3), HermiteSimpson()], ids=lambda scheme: scheme.name)
@pytest.mark.parametrize("turn", [2 * np.pi, 360.0])
def test_a_heading_without_bounds_turns_no_further_than_it_has_to(length, time, scheme, turn):
    # Bryson and Ho, section 2.7: in a current that grows with y, tan(heading) falls with time at a steady rate
    speed = length / time
    found = refine(
        Phase(
            lambda x, u: V(ca.cos(u * 2 * np.pi / turn) - x[1] / length, ca.sin(u * 2 * np.pi / turn)) * speed, 2, 1,
            start=[3.66 * length, -1.86 * length], end=[0, 0], duration=(0.1 * time, 20 * time),
            terminal_cost=lambda t: t / time,
        ), scheme,
    )  # fmt: skip
    assert found.solved, found.advice
    assert found.cost == pytest.approx(5.457865, rel=1e-6)
    heading = 2 * np.pi / turn * found.u(np.linspace(0, found.duration, 200))[:, 0]
    assert np.abs(np.diff(heading)).max() < 0.1
    assert np.abs(heading[0]) <= np.pi
    ends = np.tan(heading[[0, -1]])
    assert abs(ends[1] - ends[0]) == pytest.approx(found.cost, rel=1e-3)


def test_an_input_that_is_no_angle_keeps_its_jump():
    # a state that has to rise by 9 and to fall by 9, with a price of u² alone: u is 9 and then −9
    found = solve(build(Phase(
        lambda u: u, 1, 1, stage_cost=lambda u: u**2, start=[0], end=[0], duration=2.0,
        path=lambda x, t: 9 - x - 1e3 * (t - 1) ** 2,
    ), Radau(3), 40))  # fmt: skip
    assert found.solved_on_mesh
    assert found.u(0.5) == pytest.approx([9.0], rel=0.05)
    assert found.u(1.5) == pytest.approx([-9.0], rel=0.05)


@pytest.mark.long
def test_what_swings_along_a_singular_arc_is_said():
    bioreactor = CLASSICAL["Lee-Ramirez bioreactor"].phase
    found = refine(bioreactor, intervals=20, rounds=2)
    assert not found.solved
    assert "MultipleShooting() holds them" in found.advice
