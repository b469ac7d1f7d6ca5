"""Phases with algebraic variables: by collocation, shooting and in a loop, beside the same problem without them."""

import casadi as ca
import numpy as np
import pytest
from scipy.integrate import solve_ivp

from mpc import InputError
from mpc.optimal_control import (
    MultipleShooting,
    NonlinearMPC,
    OptimalControlProblem,
    Phase,
    Radau,
    build,
    refine,
    solve,
)

G = 9.81


def rates(x, u, z):
    """Pendulum of one metre in Cartesian coordinates, pushed along its path; z is the force of its rod."""
    return ca.vertcat(x[2], x[3], -z[0] * x[0] - u[0] * x[1], -z[0] * x[1] + u[0] * x[0] - G)


def rod(x, z):
    return x[2] ** 2 + x[3] ** 2 - z[0] - G * x[1]


def swing(**changes):
    stated = {
        "stage_cost": lambda u: u[0] ** 2, "start": [0.0, -1.0, 0.0, 0.0], "duration": 2.0, "u_bounds": (-9, 9),
        "end": ([0, 0.5, 0, -np.inf], [0, 1.5, 0, np.inf]), "algebraic": rod, "algebraics": 1, "z_guess": [G],
        "guess": ([0, 0.5, 1], [[0, -1, 0, 0], [1, 0, 0, 3], [0, 1, 0, 0]], np.ones((3, 1))),
    }  # fmt: skip
    return Phase(rates, 4, 1, **(stated | changes))


def by_angle():
    """The same swing-up, by its angle."""
    return Phase(
        lambda x, u: ca.vertcat(x[1], u[0] - G * ca.sin(x[0])), 2, 1, stage_cost=lambda u: u[0] ** 2, start=[0.0, 0.0],
        end=[np.pi, 0.0], duration=2.0, u_bounds=(-9, 9),
        guess=([0, 0.5, 1], [[0, 0], [-1, 0], [np.pi, 0]], np.zeros((3, 1))),
    )  # fmt: skip


@pytest.mark.long
def test_a_swing_up_costs_what_it_costs_by_the_angle():
    flat, angle = (refine(phase, Radau(5), intervals=40) for phase in (swing(), by_angle()))
    assert flat.status.name == angle.status.name == "SOLVED"
    assert flat.cost == pytest.approx(angle.cost, rel=1e-7)


@pytest.mark.long
def test_the_algebraic_variable_is_told_along_the_trajectory():
    found = refine(swing(), Radau(5), intervals=40)
    t = np.linspace(0, 2, 37)
    x, z = found.x(t), found.z(t)
    np.testing.assert_allclose(z[:, 0], x[:, 2] ** 2 + x[:, 3] ** 2 - G * x[:, 1], atol=1e-7)
    assert found.u(t).shape == (37, 1)
    assert found.z(0.5).shape == (1,)


def test_shooting_and_collocation_agree():
    short = swing(duration=1.0, end=None, guess=None, terminal_cost=lambda x: 50 * (x[1] - 0.5) ** 2 + 50 * x[0] ** 2)
    by = [solve(build(short, scheme, 20)) for scheme in (Radau(5), MultipleShooting())]
    assert {one.status.name for one in by} <= {"SOLVED", "MESH_TOO_COARSE"}
    assert by[1].cost == pytest.approx(by[0].cost, rel=0.02)  # inputs held over an interval, beside polynomials


@pytest.mark.long
def test_a_limit_on_the_algebraic_variable_is_kept():
    free = refine(swing(), Radau(5), intervals=40)
    t = np.linspace(0, 2, 400)
    most = free.z(t).max()
    kept = refine(swing(path=lambda z: z[0], path_bounds=(-np.inf, 0.8 * most)), Radau(5), intervals=40)
    assert kept.status.name == "SOLVED"
    assert kept.z(t).max() < 0.8 * most * (1 + 2e-6)
    assert kept.cost > free.cost


def test_a_free_fall_is_that_of_an_own_integration():
    phase = swing(stage_cost=lambda z: 0.1 * z[0], duration=1.0, end=None, guess=None, start=[0.6, -0.8, 0.0, 0.0])
    found = refine(Phase(**vars_of(phase, u_bounds=(0, 0))), Radau(5), intervals=20)

    def fall(t, y):
        x, v = y[:2], y[2:4]
        z = v @ v - G * x[1]
        return [*v, -z * x[0], -z * x[1] - G, 0.1 * z]

    end = solve_ivp(fall, (0, 1), [0.6, -0.8, 0, 0, 0], rtol=1e-11, atol=1e-12).y[:, -1]
    np.testing.assert_allclose(found.x(1.0), end[:4], atol=1e-7)
    assert found.cost == pytest.approx(end[4], rel=1e-7)


def vars_of(phase, **changes):
    names = ("dynamics", "states", "inputs", "stage_cost", "start", "duration", "algebraic", "algebraics", "z_guess")
    return {name: getattr(phase, name) for name in names} | changes


@pytest.mark.long
def test_nonlinear_mpc_holds_a_pendulum_upright_by_its_rod():
    phase = swing(
        stage_cost=lambda x, u: 20 * (x[0] ** 2 + (x[1] - 1) ** 2) + x[2] ** 2 + x[3] ** 2 + 0.1 * u[0] ** 2,
        duration=1.0, end=None, guess=None,
    )  # fmt: skip
    law = NonlinearMPC(phase, horizon=20)
    x, step = np.array([np.sin(2.6), -np.cos(2.6), 0.0, 0.0]), 0.05
    for _ in range(60):
        u = float(law(x)[0])

        def pushed(t, y, u=u):
            angle, rate = y
            return [rate, u - G * np.sin(angle)]

        angle, rate = np.arctan2(x[0], -x[1]), x[2] * -x[1] + x[3] * x[0]
        angle, rate = solve_ivp(pushed, (0, step), [angle, rate], rtol=1e-9, atol=1e-10).y[:, -1]
        x = np.array([np.sin(angle), -np.cos(angle), rate * np.cos(angle), rate * np.sin(angle)])
    assert x[1] > 0.999
    assert np.abs(x[2:]).max() < 0.02


# ── bad input ──


@pytest.mark.parametrize(("changes", "said"), [
    ({"algebraic": lambda x, z: x[0] ** 2 + x[1] ** 2 - 1}, "index > 1"),
    ({"algebraics": 0}, "algebraic"),
    ({"algebraic": None}, "'z'"),
    ({"algebraic": lambda x, z: ca.vertcat(z[0], z[0])}, "2 equations"),
    ({"algebraic": lambda x, z: z[0] ** 2 - x[0] * 0, "z_guess": 0.0}, "singular at `z_guess`"),
    ({"z_guess": [1.0, 2.0]}, "z_guess"), ({"z_guess": None}, "z_guess"),
    ({"z_guess": np.nan}, "z_guess"),
    ({"algebraics": -1}, "algebraics"), ({"algebraics": 2, "z_guess": 1.0}, "1 equations"),
    ({"algebraic": lambda x, z: ca.log(z[0]) - x[0], "z_guess": -1.0}, "z_guess"),
    ({"algebraic": lambda x, z: 0.0}, "equation 1, 0 = 0"),
    ({"terminal_cost": lambda x, z: z[0]}, "terminal_cost"), ({"boundary": lambda x, z: z[0]}, "boundary"),
])  # fmt: skip
def test_wrong_algebraic_statements_are_named(changes, said):
    with pytest.raises(InputError, match=said):
        build(swing(**changes), Radau(3), 5)


def test_algebraic_variables_without_equations_are_refused():
    with pytest.raises(InputError, match="algebraics"):
        Phase(lambda x, u: u, 1, 1, algebraics=1)


def test_of_no_times_there_are_no_values_and_phases_of_other_sizes_are_asked_one_by_one():
    found = solve(build(swing(duration=0.5, end=None, guess=None), Radau(3), 5))
    assert [found.x([]).shape, found.u([]).shape, found.z([]).shape] == [(0, 4), (0, 1), (0, 1)]
    tank = {"stage_cost": lambda x, u: (x - 1) ** 2 + u**2, "duration": 1.0}
    flow = {"algebraic": lambda x, z: z + z**3 - 2 * x, "algebraics": 1, "z_guess": 1.0}
    phases = [Phase(lambda x, u, z: u - z, 1, 1, start=[2.0], **tank, **flow), Phase(lambda x, u: u - x, 1, 1, **tank)]
    found = solve(build(OptimalControlProblem(phases), Radau(3), [5, 5]))
    assert found.x([0.5, 1.5]).shape == found.u([0.5, 1.5]).shape == (2, 1)
    assert found.x([]).shape == (0, 1)
    with pytest.raises(InputError, match=r"phases\[0\].z\(t\)"):
        found.z([0.5, 1.5])


def test_where_z_is_no_unknown_it_is_not_returned():
    short = swing(duration=0.5, end=None, guess=None)
    for found in (solve(build(short, MultipleShooting(), 5)), solve(build(by_angle(), Radau(3), 5))):
        with pytest.raises(InputError, match="without unknown z"):
            found.z(0.1)
