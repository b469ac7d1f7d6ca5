"""Whatever a nonlinear MPC is asked to keep, its plan is the optimum of the nonlinear program that Ipopt solves."""

import casadi as ca
import numpy as np
import pytest
from nonlinear_programs import optimum

from mpc import InputError, LinearMPC, Status
from mpc.optimal_control import NonlinearMPC, Phase, sampled

N = 20
UNITS = [
    pytest.param(np.ones(2), 1.0, 1.0, id="rad and N·m"),
    pytest.param(np.array([57.3, 57.3]), 1e3, 1e-4, id="degrees and N·mm"),
    pytest.param(np.array([1e3, 3.6e6]), 1e-3, 1e6, id="mrad, mrad per hour and kN·m"),
]


def pendulum(x, u, w):
    """Upright at 0, sampled at 50 ms; w pushes it."""

    def rate(z):
        return ca.vertcat(z[1], 9.81 * ca.sin(z[0]) - 0.2 * z[1] + 4 * u + w)

    h = 0.05
    k1 = rate(x)
    k2 = rate(x + h / 2 * k1)
    k3 = rate(x + h / 2 * k2)
    return x + h / 6 * (k1 + 2 * k2 + 2 * k3 + rate(x + h * k3))


def in_units(sx, su):
    """The pendulum with its states and torque in other units."""
    x, u, w = ca.SX.sym("x", 2), ca.SX.sym("u"), ca.SX.sym("w")
    return ca.Function("step", [x, u, w], [sx * pendulum(x / sx, u / su, w)], ["x", "u", "w"], ["next"])


Q, R = np.diag([3.0, 0.2]), np.array([[0.1]])
X0 = np.array([1.2, 0.3])
CASES = {
    "limits": ({"U": [5.0], "X": [1.5, 1.8]}, {}),
    "rates": ({"U": [5.0], "rate_limit": 1.0}, {"u_prev": [0.5]}),
    "soft": ({"U": [5.0], "X": [0.5, 1.0], "soft": (4.0, 30.0)}, {}),
    "reference": ({"U": [5.0]}, {"x_ref": [0.3, 0.0], "u_ref": [-9.81 * np.sin(0.3) / 4]}),
    "preview": ({"U": [5.0]}, {"w": 3 * np.sin(0.7 * np.arange(N))[:, None]}),
    "all of them": (
        {"U": [5.0], "X": [0.6, 1.2], "soft": (4.0, 30.0), "rate_limit": 1.5},
        {"u_prev": [0.0], "x_ref": [0.1, 0.0], "w": 2 * np.cos(0.5 * np.arange(N))[:, None]},
    ),
}


def law_in(sx, su, cost, horizon, limits):
    """The controller in these units."""
    stated = {}
    for name, value in limits.items():
        if name == "terminal_set":
            stated[name] = value
            continue
        sized = {"U": su, "X": sx, "rate_limit": su, "soft": cost}[name] * np.array(value)
        stated[name] = (-sized, sized) if name in "UX" else sized
    return NonlinearMPC(
        in_units(sx, su), 2, 1, Q=cost * Q / sx / sx[:, None], R=cost * R / su**2, horizon=horizon, disturbances=1,
        **stated,
    )  # fmt: skip


def reference(horizon, limits, signals, plan):
    """The optimum in SI units, begun near a plan."""
    stated = {name: (-np.array(value), np.array(value)) if name in "UX" else value for name, value in limits.items()}
    P = law_in(np.ones(2), 1.0, 1.0, horizon, {}).linear.P
    units = (np.array(limits["X"]),) * 2 if "X" in limits else None
    return optimum(in_units(np.ones(2), 1.0), X0, Q=Q, R=R, P=P, horizon=horizon, units=units, guess=plan, **stated,
                   **({"w": np.zeros((horizon, 1))} | signals))  # fmt: skip


@pytest.mark.parametrize(("sx", "su", "cost"), UNITS)
@pytest.mark.parametrize("case", CASES)
def test_plan_is_the_optimum_of_the_whole_statement(case, sx, su, cost):
    limits, signals = CASES[case]
    law = law_in(sx, su, cost, N, limits)
    sizes = {"x_ref": sx, "u_ref": su, "u_prev": su, "w": 1.0}
    plan = law.solve(sx * X0, **{name: sizes[name] * np.array(value) for name, value in signals.items()})
    best, inputs, states = reference(N, limits, signals, (plan.states / sx * 0.9, plan.inputs / su * 0.9))
    assert plan.status is Status.SOLVED
    assert plan.cost / cost == pytest.approx(best, rel=1e-6)
    assert plan.inputs / su == pytest.approx(inputs, abs=2e-4)
    assert plan.states / sx == pytest.approx(states, abs=2e-4)


@pytest.mark.check
@pytest.mark.parametrize(("sx", "su", "cost"), UNITS)
def test_a_long_horizon_of_an_unstable_model_keeps_its_digits(sx, su, cost):
    horizon, limits = 150, {"U": [5.0], "X": [1.5, 1.3]}  # what is disturbed grows by 1e10
    plan = law_in(sx, su, cost, horizon, limits).solve(sx * X0)
    states, inputs = plan.states / sx, plan.inputs / su
    best, reference_inputs, _ = reference(horizon, limits, {}, (states * 0.9, inputs * 0.9))
    assert plan.status is Status.SOLVED
    assert np.abs(inputs).max() == pytest.approx(5.0, rel=1e-9)  # at their limits, and the rate at its own
    assert np.abs(states[:, 1]).max() == pytest.approx(1.3, rel=1e-6)
    assert plan.cost / cost == pytest.approx(best, rel=1e-6)
    assert inputs == pytest.approx(reference_inputs, abs=2e-4)
    after = [np.asarray(pendulum(x, u, 0)).ravel() for x, u in zip(states, inputs)]
    assert np.abs(after - states[1:]).max() < 1e-9


@pytest.mark.parametrize(("sx", "su", "cost"), UNITS)
def test_the_invariant_terminal_set_is_the_largest_one_and_is_reached(sx, su, cost):
    law = law_in(sx, su, cost, N, {"U": [5.0], "X": [1.5, 1.8], "terminal_set": "invariant"})
    linear, end = law.linear, law.linear.terminal_set
    closed = linear.A - linear.B @ linear.gain
    outside = 0
    for corner in end.vertices:
        for scale, stays in ((0.999, True), (1.01, False)):
            x, kept = scale * corner, True
            for _ in range(400):
                kept &= bool((np.abs(x / sx) <= [1.5, 1.8]).all() and np.abs(linear.gain @ x / su) <= 5.0)
                x = closed @ x
            assert kept or not stays
            outside += not kept
    assert outside == len(end.vertices)  # a hundredth beyond any corner the regulator leaves the limits
    plan = law.solve(sx * X0)
    rows = np.array(linear.terminal_rows[0]) * sx, linear.terminal_rows[1]
    guess = plan.states / sx * 0.9, plan.inputs / su * 0.9
    best, inputs, _ = reference(N, {"U": [5.0], "X": [1.5, 1.8]}, {"terminal": rows}, guess)
    assert plan.status is Status.SOLVED
    assert plan.cost / cost == pytest.approx(best, rel=1e-6)
    assert plan.inputs / su == pytest.approx(inputs, abs=2e-4)


def test_an_invariant_terminal_set_needs_limits():
    with pytest.raises(InputError, match="terminal_set") as caught:
        law_in(np.ones(2), 1.0, 1.0, N, {"terminal_set": "invariant"})
    assert caught.value.argument == "terminal_set"
    with pytest.raises(InputError, match="terminal_set"):
        law_in(np.ones(2), 1.0, 1.0, N, {"U": [5.0], "terminal_set": "largest"})


@pytest.mark.parametrize(("weight", "cross"), [(0.0, None), (1.0, [[0.0], [0.2]])])
def test_a_linear_model_whose_weights_do_not_see_what_grows_has_the_plan_of_linear_mpc(weight, cross):
    A, B = np.array([[1.3, 0.2], [0.0, 1.2]]), np.array([[0.1], [1.0]])
    own = {"Q": np.diag([0.0, weight]), "R": [[1.0]], "S": cross, "P": np.zeros((2, 2)), "horizon": 25,
           "X": ([-5, -5], [5, 5]), "U": (-2.0, 2.0)}  # fmt: skip
    mpc = NonlinearMPC(lambda x, u: ca.DM(A) @ x + ca.DM(B) @ u, 2, 1, **own)
    for x in ([1.0, 0.3], [-2.0, 1.0], [0.5, -1.0]):
        expected = LinearMPC(A, B, **own).solve(x)
        plan = mpc.solve(x)
        assert plan.status == expected.status
        np.testing.assert_allclose(plan.inputs, expected.inputs, atol=1e-8)


def test_a_plan_whose_limits_all_have_a_price_is_never_softened():
    # a house in kelvin, heated for a comfort that has a price; costs of a sample are about 1e-9
    def house(x, u, w):
        flow = (x[1] - x[0]) / 1e5
        return ca.vertcat((w[1] - x[0]) / 2e5 + flow, (x[0] - x[1]) / 4e4 + u[0] * 2e-6)

    phase = Phase(
        house, 2, 1, duration=24 * 900.0, u_bounds=(0, 6000), signal=np.tile([0.3, 275.0], (25, 1)),
        stage_cost=lambda u, w: w[0] * u[0] / 3.6e6, path=lambda x: ca.vertcat(293.15 - x[0], x[0] - 296.15),
        path_prices=(1e-3, 1e-3),
    )  # fmt: skip
    law, step, x = NonlinearMPC(phase, horizon=24), sampled(lambda x, u: house(x, u, [0.3, 275.0]), 900.0), [293.5, 295]
    for _ in range(28):
        u = law(x)
        assert law.last_plans[0].status.name == "SOLVED"
        x = np.array(ca.DM(step(x, u))).ravel()
