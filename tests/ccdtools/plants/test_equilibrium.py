"""Where plants rest, how that follows the design, and the linear plants about it."""

import casadi as ca
import numpy as np
import pytest
from nonlinear_plants import GRAVITY, swing, tank_rates, tanks
from scipy.optimize import approx_fprime, fsolve

from ccdtools import (
    CoDesignProblem,
    DesignSpace,
    FixedStart,
    Gaussian,
    InputError,
    Plant,
    QuadraticObjective,
    codesign,
    deploy,
    discretise,
    equilibrium,
    linearise,
    simulate,
)
from ccdtools.plants import deviations
from ccdtools.twin import fit_plant, updated_problem

NAN = np.nan


def test_a_level_is_held_by_the_inflow_that_torricelli_asks_for():
    rest = equilibrium(tanks(), [0.8], x=[NAN, 0.3], u=[NAN])
    flow = 1.5e-4 * np.sqrt(2 * GRAVITY * 0.3)
    assert rest.u[0] == pytest.approx(flow, rel=1e-12)
    assert rest.x[0] == pytest.approx((flow / 0.8e-4) ** 2 / (2 * GRAVITY), rel=1e-12)
    assert rest.unique
    assert np.abs(tank_rates(rest.x, rest.u, [0.0], [0.8])).max() < 1e-14


@pytest.mark.parametrize("unit", [1e-6, 1.0, 1e6])
def test_units_do_not_matter(unit):
    rest = equilibrium(tanks(unit=unit), [0.8], x=[NAN, 0.3 / unit], u=[NAN])
    assert rest.x[0] * unit == pytest.approx(equilibrium(tanks(), [0.8], x=[NAN, 0.3], u=[NAN]).x[0], rel=1e-9)


def test_the_derivative_by_the_design_is_that_of_solutions_nearby():
    def level(p):
        own = fsolve(lambda z: tank_rates([z[0], 0.3], [z[1] * 1e-3], [0.0], p), [0.5, 0.3], xtol=1e-14)
        return own[0]

    rest = equilibrium(tanks(), [0.8], x=[NAN, 0.3], u=[NAN])
    h = 1e-4
    assert rest.dx_dp[0, 0] == pytest.approx((level([0.8 + h]) - level([0.8 - h])) / (2 * h), rel=1e-6)
    assert rest.dx_dp[1, 0] == 0.0
    assert rest.du_dp[0, 0] == pytest.approx(0.0, abs=1e-12)


@pytest.mark.check
def test_an_equilibrium_follows_the_design_over_the_whole_box():
    plant = tanks()
    rest = equilibrium(plant, [2.0], x=[NAN, 0.3], u=[NAN])
    for p in plant.design.spread():
        x, u = rest.function(p)
        np.testing.assert_allclose(np.asarray(x).ravel(), equilibrium(plant, p, x=[NAN, 0.3], u=[NAN]).x, rtol=1e-9)
        assert np.abs(tank_rates(np.asarray(x).ravel(), np.asarray(u).ravel(), [0.0], p)).max() < 1e-12


def test_a_linear_plant_under_gravity_needs_one_step():
    x, u, p = ca.SX.sym("x", 2), ca.SX.sym("u"), ca.SX.sym("p")
    plant = Plant(x, u, None, p, ca.vertcat(x[1], -9.81 - p * x[0] + u), DesignSpace(["k"], [20.0], [200.0]), dt=0.1)
    rest = equilibrium(plant, [50.0])
    np.testing.assert_allclose(rest.x, [-9.81 / 50, 0.0], rtol=1e-14)
    assert rest.dx_dp[0, 0] == pytest.approx(9.81 / 50**2)
    assert rest.function.n_instructions() < 25
    model = discretise(linearise(plant, rest))
    assert not model.affine


def test_an_upright_pendulum_is_found_near_its_guess_and_a_torque_holds_any_angle():
    upright = equilibrium(swing(), [1.0], guess=([3.0, 0.0], [0.0]))
    np.testing.assert_allclose(upright.x, [np.pi, 0.0], atol=1e-9)
    held = equilibrium(swing(), [1.5], x=[0.4, NAN], u=[NAN])
    assert held.u[0] == pytest.approx(GRAVITY * 1.5 * np.sin(0.4), rel=1e-12)


def test_what_decides_nothing_keeps_its_guess():
    x, u, p = ca.SX.sym("x", 2), ca.SX.sym("u"), ca.SX.sym("p")
    cart = Plant(x, u, None, p, ca.vertcat(x[1], -p * x[1] + u), DesignSpace(["d"], [0.1], [1.0]), dt=0.1)
    rest = equilibrium(cart, [0.5], guess=([3.0, 1.0], [0.0]))
    assert rest.x[0] == pytest.approx(3.0)
    assert rest.x[1] == pytest.approx(0.0, abs=1e-12)
    assert not rest.unique


def test_a_discrete_plant_rests_where_it_maps_to_itself():
    x, u, p = ca.SX.sym("x"), ca.SX.sym("u"), ca.SX.sym("p")
    plant = Plant(x, u, None, p, ca.cos(x) * p + u, DesignSpace(["p"], [0.8], [1.2]), dt=1.0, continuous=False)
    assert equilibrium(plant, [1.0]).x[0] == pytest.approx(0.7390851332151607, rel=1e-12)
    moved = deviations(plant, equilibrium(plant, [1.0]))
    for p in ([0.8], [1.13]):
        assert abs(float(moved.right_hand_side(0, 0, ca.DM(0, 1), p))) < 1e-12


# ── linearise ──


def test_a_linearisation_about_rest_has_the_slopes_of_the_rates():
    plant = tanks()
    rest = equilibrium(plant, [1.0], x=[NAN, 0.3], u=[NAN])
    linear = linearise(plant, rest)
    assert linear.linear
    for p in ([0.6], [1.7]):
        at, held = (np.asarray(v).ravel() for v in rest.function(p))
        slopes = approx_fprime(np.r_[at, held], lambda z, p=p: tank_rates(z[:2], z[2:], [0.0], p), 1e-7)
        M = ca.densify(ca.jacobian(linear.dynamics, ca.vertcat(linear.x, linear.u)))
        J = np.asarray(ca.Function("J", [plant.p], [M])(p))
        np.testing.assert_allclose(J, slopes, rtol=1e-4, atol=1e-6)


def test_a_linearisation_about_a_point_touches_the_plant_there():
    plant = swing()
    linear = linearise(plant, [0.5, 0.2], [1.0], [0.3])
    point = ([0.5, 0.2], [1.0], [0.3], [0.8])
    np.testing.assert_allclose(linear.right_hand_side(*point), plant.right_hand_side(*point), rtol=1e-14)
    assert discretise(linear).affine


def test_a_plant_in_deviations_rests_at_zero_at_every_design_and_is_the_same_plant():
    plant = tanks()
    rest = equilibrium(plant, [1.0], x=[NAN, 0.3], u=[NAN])
    moved = deviations(plant, rest)
    for p in plant.design.spread():
        assert np.abs(np.asarray(moved.right_hand_side(0, 0, 0, p))).max() < 1e-13
        at, held = rest.function(p)
        step = (np.array([0.01, -0.02]), np.array([1e-5]), np.array([1e-6]))
        own = moved.right_hand_side(*step, p)
        np.testing.assert_allclose(own, plant.right_hand_side(at + step[0], held + step[1], step[2], p), rtol=1e-12)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: equilibrium(swing(), [9.0]), "design: got l = 9"),
        (lambda: equilibrium(swing(), [1.0], x=[0.3, 0.0]), "plant: got no equilibrium: the least rate found is"),
        (lambda: equilibrium(swing(), [1.0], x=[0.3]), r"x: got \[0.3\] of shape \(1,\)"),
        (lambda: equilibrium(swing(), [1.0], u=[np.inf]), "u: got"),
        (lambda: equilibrium(swing(), [1.0], w=[0.0, 1.0]), "w: got"),
        (lambda: equilibrium("swing", [1.0]), "plant: got 'swing'"),
        (
            lambda: linearise(swing(), equilibrium(tanks(), [1.0], x=[NAN, 0.3], u=[NAN])),
            "an equilibrium of another plant",
        ),
        (lambda: linearise(swing(), [0.0]), "about: got"),
        (lambda: deviations(swing(), [0.0, 0.0]), "about: got"),
    ],
)
def test_what_does_not_rest_is_refused_by_name(call, message):
    with pytest.raises(InputError, match=message):
        call()


@pytest.mark.check
def test_no_equilibrium_is_said_with_the_least_rate():
    x, u, p = ca.SX.sym("x", 2), ca.SX.sym("u"), ca.SX.sym("p")
    plant = Plant(x, u, None, p, ca.vertcat(x[1], p + x[0] ** 2), DesignSpace(["p"], [1.0], [2.0]), dt=0.1)
    with pytest.raises(InputError, match=r"the least rate found is 1\.5"):
        equilibrium(plant, [1.5])


def test_an_equilibrium_that_ends_within_the_box_is_named_with_its_design():
    x, u, p = ca.SX.sym("x"), ca.SX.sym("u"), ca.SX.sym("p")
    plant = Plant(x, u, None, p, x**2 - p, DesignSpace(["p"], [-1.0], [1.0]), dt=0.1)
    rest = equilibrium(plant, [0.5], guess=([1.0], [0.0]))
    assert rest.x[0] == pytest.approx(np.sqrt(0.5))
    with pytest.raises(InputError, match=r"a rest that was not followed from p = 0\.5 to p = "):
        linearise(plant, rest)


# ── outputs, and the real plant beside the nominal one ──


def suspended(hardening=20.0, states=2, upper=200.0):
    """A mass under gravity on a spring that hardens, whose force is an output with limits."""
    x, u, w, p = ca.SX.sym("x", states), ca.SX.sym("u"), ca.SX.sym("w"), ca.SX.sym("p")
    force = p * (x[0] + hardening * x[0] ** 3) + 0.8 * x[1]
    dynamics = ca.vertcat(x[1], u + w - force - 9.81, *([-x[2]] if states > 2 else []))
    return Plant(x, u, w, p, dynamics, DesignSpace(["k"], [60.0], [upper]), dt=0.02, outputs=ca.vertcat(force, x[0]),
                 output_limits=([-20, -1], [20, 1]))  # fmt: skip


def test_outputs_in_deviations_are_those_of_the_plant():
    plant = suspended()
    rest = equilibrium(plant, [100.0])
    moved, linear = deviations(plant, rest), linearise(plant, rest)
    for p in ([70.0], [190.0]):
        at, held = (np.asarray(v).ravel() for v in rest.function(p))
        own = plant.observe(at, held, p)
        assert own[0] == pytest.approx(-9.81)
        np.testing.assert_allclose(moved.observe([0, 0], [0], p), own, rtol=1e-12)
        np.testing.assert_allclose(linear.observe([0, 0], [0], p), own, rtol=1e-12)
        away = np.array([0.01, -0.03])
        np.testing.assert_allclose(moved.observe(away, [0.2], p), plant.observe(at + away, held + 0.2, p), rtol=1e-12)
        slopes = approx_fprime(at, lambda x, p=p, held=held: plant.observe(x, held, p), 1e-7)
        np.testing.assert_allclose(linear.observe(away, [0.2], p), own + slopes @ away, rtol=1e-5)
    for one in (moved, linear):
        np.testing.assert_array_equal(one.output_limits, plant.output_limits)


def test_outputs_linearised_about_a_point_touch_those_of_the_plant_there():
    plant = suspended()
    linear = linearise(plant, [0.1, 0.2], [1.0])
    np.testing.assert_allclose(linear.observe([0.1, 0.2], [1.0], [80.0]), plant.observe([0.1, 0.2], [1.0], [80.0]))
    z = ca.vertcat(linear.x, linear.u)
    assert not ca.depends_on(ca.jacobian(linear.outputs, z), z)


def test_a_real_plant_stands_in_the_deviations_of_the_nominal_one():
    nominal, real = suspended(), suspended(hardening=30.0)
    rest = equilibrium(nominal, [100.0])
    moved = deviations(real, rest)
    for p in ([60.0], [130.0]):
        at, held = rest.function(p)
        away = np.array([0.01, 0.2])
        own = moved.right_hand_side(away, [0.3], [0.1], p)
        np.testing.assert_allclose(own, real.right_hand_side(at + away, held + 0.3, 0.1, p), rtol=1e-12)
    with pytest.raises(InputError, match="about: got an equilibrium of another plant"):
        linearise(real, rest)
    with pytest.raises(InputError, match="a plant of 2 states, 1 inputs and 1 disturbances, expected one of 3 states"):
        deviations(suspended(states=3), rest)
    with pytest.raises(InputError, match="one over the designs of the plant"):
        deviations(suspended(upper=300.0), rest)


# ── what is rest, and how far it is followed ──


@pytest.mark.parametrize(
    ("rate", "guess", "truth"),
    [
        (lambda x, p: p * ca.exp(60 - x) - 1, 50.0, lambda p: 60 + np.log(p)),
        (lambda x, p: 1 - 1e-6 * ca.exp(60 - x) * p, 40.0, lambda p: 60 + np.log(1e-6 * p)),
        (lambda x, p: p / (x + 1e-9) - 2 - x, 0.1, lambda p: np.sqrt((1 + 5e-10) ** 2 + p - 2e-9) - 1 - 5e-10),
    ],
)
def test_a_rate_that_is_huge_at_zero_does_not_make_rest_of_what_moves(rate, guess, truth):
    x, u, p = ca.SX.sym("x"), ca.SX.sym("u"), ca.SX.sym("p")
    plant = Plant(x, u, None, p, rate(x, p) + u, DesignSpace(["p"], [1.0], [2.0]), dt=0.1)
    rest = equilibrium(plant, [1.0], guess=([guess], [0.0]))
    for design in ([1.0], [1.4], [2.0]):
        assert float(rest.function(design)[0]) == pytest.approx(truth(design[0]), rel=2e-9)


@pytest.mark.parametrize("offset", [0.0, 1e6])
def test_rest_is_known_where_large_terms_cancel_whose_slope_is_small(offset):
    x, u, p = ca.SX.sym("x", 2), ca.SX.sym("u"), ca.SX.sym("p")
    swung = offset - offset * ca.cos(x[0] - 1.1) - p * ca.sin(x[0] - 1.1) - x[1]
    plant = Plant(x, u, None, p, ca.vertcat(x[1] - 0.3, swung + u + 0.3), DesignSpace(["p"], [1e-3], [2e-3]), dt=0.1)
    rest = equilibrium(plant, [1e-3], guess=([1.1, 0.3], [0.0]))
    np.testing.assert_allclose(rest.x, [1.1, 0.3], atol=1e-8)


@pytest.mark.parametrize("bound", [0.99, 0.999, 0.9999])
@pytest.mark.parametrize("start", [0.0, 0.9, -0.99])
def test_a_rest_is_followed_to_where_it_nearly_ends_and_to_no_other(bound, start):
    x, u, p = ca.SX.sym("x", 2), ca.SX.sym("u"), ca.SX.sym("p")
    dynamics = ca.vertcat(x[1], p - ca.sin(x[0]) - 0.5 * x[1] + u)
    held = Plant(x, u, None, p, dynamics, DesignSpace(["T"], [-bound], [bound]), dt=0.05)
    function = equilibrium(held, [start]).function
    torques = np.linspace(-bound, bound, 201)
    angles = np.array([float(function([torque])[0][0]) for torque in torques])
    np.testing.assert_allclose(angles, np.arcsin(torques), atol=1e-6)


def test_a_disturbance_at_rest_is_counted_from():
    plant = suspended()
    rest = equilibrium(plant, [100.0], w=[9.81])
    assert rest.x[0] == pytest.approx(0.0, abs=1e-12)
    for one in (deviations(plant, rest), linearise(plant, rest)):
        np.testing.assert_allclose(one.right_hand_side([0, 0], 0, 0, [80.0]), 0.0, atol=1e-12)
        assert float(one.right_hand_side([0, 0], 0, 0.5, [80.0])[1]) == pytest.approx(0.5)


@pytest.mark.parametrize("guess", [3, np.array(3.0), ([1.0, 0.0], [0.0], [0.0]), "xu"])
def test_a_guess_that_is_no_pair_is_refused(guess):
    with pytest.raises(InputError, match=r"guess: got .*, expected a pair \(x, u\)"):
        equilibrium(swing(), [1.0], guess=guess)


def levitated_ball():
    """A ball under a magnet, in deviations: it rests at 0 at every design, but for the rounding of its rates."""
    x, u, w, p = ca.SX.sym("x", 3), ca.SX.sym("u"), ca.SX.sym("w"), ca.SX.sym("p", 2)
    gap, current, turns = x[0] * 1e-3, x[2], p[0] * 100
    C = 4e-7 * np.pi * turns**2 * 5e-4 / 4
    R = 1.7e-8 * turns * 0.12 / (p[1] * 1e-6)
    flow = (u - R * current + 2 * C * current * x[1] / gap**2) / (2 * C / gap)
    dynamics = [1e3 * x[1], 9.81 + (w - C * (current / gap) ** 2) / 0.5, flow]
    plant = Plant(x, u, w, p, dynamics, DesignSpace(["N", "a"], [3.0, 0.5], [8.0, 2.0]), dt=0.002)
    return deviations(plant, equilibrium(plant, [5.0, 1.0], x=[10.0, np.nan, np.nan], u=[np.nan]))


@pytest.mark.parametrize("design", [(6.0, 0.6), (8.0, 2.0), (5.0, 1.0), (3.0, 0.5)])
def test_a_plant_that_rests_at_zero_everywhere_is_followed_from_any_design(design):
    plant = levitated_ball()
    rest = equilibrium(plant, design)
    for p in plant.design.spread()[:20]:
        x, u = (np.asarray(part).ravel() for part in rest.function(p))
        np.testing.assert_allclose(np.r_[x, u], 0, atol=1e-6)


def heated(names, lower, upper, **known):
    """Tank that loses heat; its heater has an efficiency, and its loss a factor, which may be unknown."""
    x, u, w, p = (ca.SX.sym(*sized) for sized in (("x", 1), ("u", 1), ("w", 1), ("p", len(names))))
    entries = {"mass": 2.0, "loss": 1.0, "efficiency": 1.0} | known | dict(zip(names, ca.vertsplit(p)))
    rate = (entries["efficiency"] * u - entries["loss"] * (x - 20) * (1 + 0.01 * (x - 20)) + w) / entries["mass"]
    return Plant(x, u, w, p, rate, DesignSpace(names, lower, upper), dt=0.1)


def test_a_plant_with_unknown_entries_is_in_the_coordinates_of_the_nominal_one():
    rest = equilibrium(heated(["mass"], [1.0], [3.0]), [2.0], x=[60.0], u=[np.nan])
    unknown = heated(["loss", "mass", "efficiency"], [0.5, 1.0, 0.5], [1.5, 3.0, 1.5])
    shifted = deviations(unknown, rest)
    rate = ca.Function("rate", [shifted.x, shifted.u, shifted.w, shifted.p], [shifted.dynamics])
    assert float(rate(0, 0, 0, [1.0, 2.5, 1.0])) == pytest.approx(0.0, abs=1e-9)
    assert float(rate(3, -4, 2, [0.8, 2.5, 0.9])) == pytest.approx((0.9 * 52 - 0.8 * 43 * 1.43 + 2) / 2.5)


def test_the_rest_of_another_box_is_refused():
    rest = equilibrium(heated(["mass"], [1.0], [2.5]), [2.0], x=[60.0], u=[np.nan])
    with pytest.raises(InputError, match="about: got an equilibrium over"):
        deviations(heated(["mass", "loss"], [1.0, 0.5], [3.0, 1.5]), rest)


@pytest.mark.long
def test_what_a_fitted_plant_adds_at_the_nominal_rest_is_designed_for():
    nominal = heated(["mass"], [1.0], [3.0])
    rest = equilibrium(nominal, [2.0], x=[60.0], u=[np.nan])
    unknown = deviations(heated(["mass", "loss", "efficiency"], [1.0, 0.5, 0.5], [3.0, 1.5, 1.5]), rest)
    limits = {"X": ([-20.0], [20.0]), "U": ([-40.0], [40.0])}
    problem = CoDesignProblem(
        discretise(deviations(nominal, rest), **limits, W=(-2.0, 2.0)), **limits, steps=50,
        objective=QuadraticObjective([[1.0]], [[0.01]]), scenarios=FixedStart([5.0], Gaussian([0.5])),
    )  # fmt: skip
    rng = np.random.default_rng(0)
    real = deviations(heated(["mass"], [1.0], [3.0], loss=0.8, efficiency=0.9), rest)
    w = Gaussian([0.5]).sample(20, 50, rng)
    log = deploy(real, lambda x: rng.uniform(-20, 20, x.shape), [2.0], w, x0=np.zeros((20, 1)))
    fit = fit_plant(problem, log, plant=unknown)
    assert fit.values[:2] == pytest.approx([0.8, 0.9], abs=0.02)
    before, after = (
        codesign(one, method="nested", design=[2.0], rng=rng) for one in (problem, updated_problem(problem, fit))
    )
    assert after.controller.offset[0] == pytest.approx(-6.2, abs=1.0)  # 49.8 W hold it in place of 56
    runs = [simulate(real, one.controller, x0=np.full((20, 1), 5.0), steps=50, disturbance=w, design=one.design)
            for one in (before, after)]  # fmt: skip
    gain = runs[1].returns(problem.objective) - runs[0].returns(problem.objective)
    assert gain.mean() > 3 * gain.std() / len(gain) ** 0.5
