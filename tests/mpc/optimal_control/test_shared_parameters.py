"""Parameters, scenarios and phases: what several trajectories share and what joins them."""

from dataclasses import replace

import casadi as ca
import numpy as np
import pytest
from scipy.optimize import brentq, minimize, minimize_scalar

from mpc import InputError
from mpc.optimal_control import MultipleShooting, OptimalControlProblem, Phase, Radau, build, refine, solve


def array_problem(inertia, duration, torque):
    """The strain-actuated solar array of Herber and Allison, whose stiffness is to be found."""
    phase = Phase(
        dynamics=lambda x, u, p: ca.vertcat(x[1], (-p * x[0] + u) / inertia),
        states=2,
        inputs=1,
        start=[0, 0],
        end=[None, 0],
        duration=duration,
        u_bounds=(-torque, torque),
        terminal_cost=lambda x: -x[0],
    )
    return OptimalControlProblem(phase, p_bounds=([0.0], [20 * inertia / duration**2]))


@pytest.mark.long
@pytest.mark.quick(1)
@pytest.mark.parametrize(("inertia", "duration", "torque"), [(1.0, 1.0, 1.0), (3.0, 0.5, 2.0), (0.02, 7.0, 1e-3)])
def test_solar_array_has_its_published_stiffness_simultaneous_and_nested(inertia, duration, torque):
    # Herber and Allison, "Nested and simultaneous solution strategies for general combined plant and control design
    # problems", Journal of Mechanical Design 141, 2019.
    problem = array_problem(inertia, duration, torque)
    stiffness, reach = 3.41729159 * inertia / duration**2, 0.300782846 * torque * duration**2 / inertia
    simultaneous = refine(problem, intervals=20, tolerance=1e-7)
    assert simultaneous.solved
    assert simultaneous.p[0] == pytest.approx(stiffness, rel=1e-4)
    assert -simultaneous.cost == pytest.approx(reach, rel=1e-4)
    program = simultaneous.program

    def slope(p):
        return solve(program, p=[p], tolerance=1e-10).p_gradient[0]

    nested = brentq(slope, 0.5 * stiffness, 1.5 * stiffness, rtol=1e-7)
    assert nested == pytest.approx(stiffness, rel=1e-4)
    assert -solve(program, p=[nested]).cost == pytest.approx(reach, rel=1e-4)


def test_gradient_of_held_parameters_is_that_of_the_optimal_cost():
    phase = Phase(
        dynamics=lambda x, u, p: ca.vertcat(x[1], -p[0] * ca.sin(x[0]) - p[1] * x[1] + u), states=2, inputs=1,
        stage_cost=lambda x, u: ca.sumsqr(x) + 0.1 * u**2, start=[1.0, 0.0], duration=2.0, u_bounds=(-0.8, 0.8),
    )  # fmt: skip
    program = build(OptimalControlProblem(phase, p_bounds=([0, 0], [5, 5])), Radau(3), 30)
    p = np.array([2.0, 0.3])
    found = solve(program, p=p, tolerance=1e-11).p_gradient
    for i in range(2):
        step = 1e-4 * np.eye(2)[i]
        ahead, behind = (solve(program, p=p + sign * step, tolerance=1e-11).cost for sign in (1, -1))
        assert found[i] == pytest.approx((ahead - behind) / 2e-4, rel=1e-5)


def pushed(mass, **rest):
    """A mass that is brought to rest at 1 by a force, with the gain p of a spring that may help."""
    return Phase(
        dynamics=lambda x, u, p: ca.vertcat(x[1], (u - p[0] * (x[0] - 1)) / mass),
        states=2,
        inputs=1,
        stage_cost=lambda u: u**2,
        start=[0, 0],
        end=[1, 0],
        duration=1.0,
        **rest,
    )


def test_scenarios_share_parameters_and_their_costs_are_weighted():
    masses, weights = (1.0, 2.0, 4.0), (0.5, 0.3, 0.2)
    problem = OptimalControlProblem([pushed(m) for m in masses], p_bounds=(0, 60), linked=False, weights=weights)
    together = solve(build(problem, Radau(3), 12))
    alone = [OptimalControlProblem(pushed(m), p_bounds=(0, 60)) for m in masses]
    programs = [build(problem, Radau(3), 12) for problem in alone]

    def expected(p):
        return sum(w * solve(program, p=[p]).cost for w, program in zip(weights, programs))

    best = minimize_scalar(expected, bounds=(0, 60), method="bounded", options={"xatol": 1e-6})
    assert together.solved
    assert together.cost == pytest.approx(best.fun, rel=1e-6)
    assert together.p[0] == pytest.approx(best.x, rel=1e-3)


def test_worst_scenario_is_made_least():
    problem = OptimalControlProblem([pushed(1.0), pushed(4.0)], p_bounds=(0, 60), linked=False, risk="worst")
    worst = solve(build(problem, Radau(3), 12))
    programs = [build(OptimalControlProblem(pushed(m), p_bounds=(0, 60)), Radau(3), 12) for m in (1.0, 4.0)]
    largest = minimize_scalar(
        lambda p: max(solve(program, p=[p]).cost for program in programs), bounds=(0, 60), method="bounded",
    )  # fmt: skip
    assert worst.solved
    assert worst.cost == pytest.approx(largest.fun, rel=1e-4)


@pytest.mark.long
@pytest.mark.parametrize(("spread", "unit"), [(0.0, 1.0), (0.7, 1.0), (1.2, 1e-6)])
def test_mean_and_spread_of_scenarios_are_made_least(spread, unit):
    masses = (1.0, 2.0, 4.0)
    phases = [replace(pushed(m), stage_cost=lambda u: unit * u**2) for m in masses]
    together = solve(build(OptimalControlProblem(phases, p_bounds=(0, 60), linked=False, risk="spread", spread=spread),
                           Radau(3), 12))  # fmt: skip
    programs = [build(OptimalControlProblem(phase, p_bounds=(0, 60)), Radau(3), 12) for phase in phases]

    def measure(p):
        costs = np.array([solve(program, p=[p]).cost for program in programs]) / unit
        counted = minimize(lambda y: y.mean() + spread * y.std(), costs * [1.0, 1.01, 1.02],  # none counts for less
                           bounds=[(cost, None) for cost in costs], options={"ftol": 1e-15, "gtol": 1e-12})  # fmt: skip
        return unit * counted.fun

    best = minimize_scalar(measure, bounds=(0, 60), method="bounded", options={"xatol": 1e-6})
    assert together.solved
    assert together.cost == pytest.approx(best.fun, rel=1e-6)
    assert together.p[0] == pytest.approx(best.x, rel=1e-3)
    held = solve(together.program, p=[20.0], tolerance=1e-10)
    assert held.cost == pytest.approx(measure(20.0), rel=1e-7)
    assert held.p_gradient[0] == pytest.approx((measure(20.1) - measure(19.9)) / 0.2, rel=1e-3)


@pytest.mark.parametrize(("weights", "spread"), [((1, 1, 1), 2**0.5), ((1, 1, 1), 30.0), ((2, 1, 1), 3**0.5)])
def test_a_spread_that_one_scenario_bears_alone_is_the_worst_case(weights, spread):
    phases = [pushed(m) for m in (1.0, 2.0, 4.0)]
    risks = [{"risk": "worst"}, {"risk": "spread", "spread": spread, "weights": weights},
             {"risk": "spread", "spread": 0.99 * spread, "weights": weights}]  # fmt: skip
    worst, same, nearly = (
        solve(build(OptimalControlProblem(phases, p_bounds=(0, 60), linked=False, **risk), Radau(3), 12))
        for risk in risks
    )
    assert same.solved
    assert same.cost == pytest.approx(worst.cost, rel=1e-9)
    assert nearly.cost <= worst.cost * (1 + 1e-6)
    assert nearly.cost == pytest.approx(worst.cost, rel=0.02)


def moved(**options):
    """One state that goes where it is pushed, at the least ∫u²."""
    return Phase(dynamics=lambda u: u, states=1, inputs=1, stage_cost=lambda u: u**2, **options)


def test_every_joint_has_a_link_of_its_own_that_knows_the_time():
    phases = [moved(start=0, duration=1.0), moved(duration=1.0), moved(end=5, duration=1.0)]
    found = solve(build(OptimalControlProblem(phases, link=[lambda x: 2 * x, lambda x, t: x + t]), Radau(3), 4))
    assert found.solved
    assert found.cost == pytest.approx((5 - 2) ** 2 / 6, rel=1e-9)  # least a² + b² + c² with 2 a + b + 2 + c = 5
    phases = [moved(start=0, duration=(0.5, 3.0)), moved(end=5, duration=1.0)]
    found = solve(build(OptimalControlProblem(phases, link=lambda x, t: x + t), Radau(3), 4))
    assert found.cost == pytest.approx(1.0, rel=1e-6)  # least a² / 3 + (5 − a − 3)²


def test_links_that_do_not_fit_the_phases_are_refused():
    phases = [moved(start=0, duration=1.0), moved(end=5, duration=1.0)]
    with pytest.raises(InputError, match="link: got 2 functions for 2 phases"):
        OptimalControlProblem(phases, link=[None, None])
    with pytest.raises(InputError, match="link: got a function, with linked=False"):
        OptimalControlProblem(phases, link=[lambda x: x], linked=False)
    assert replace(OptimalControlProblem(phases), linked=False).link == (None,)


def test_two_linked_phases_are_one_cut_in_two():
    whole = Phase(
        dynamics=lambda x, u: ca.vertcat(x[1], u), states=2, inputs=1, start=[0, 0], end=[1, 0], duration=2.0,
        stage_cost=lambda u: u**2,
    )  # fmt: skip
    first = Phase(dynamics=whole.dynamics, states=2, inputs=1, start=[0, 0], duration=0.8, stage_cost=whole.stage_cost)
    second = Phase(dynamics=whole.dynamics, states=2, inputs=1, end=[1, 0], duration=1.2, stage_cost=whole.stage_cost)
    one = solve(build(whole, Radau(3), 20))
    two = solve(build(OptimalControlProblem([first, second]), Radau(3), (8, 12)))
    assert two.cost == pytest.approx(one.cost, rel=1e-8)
    times = np.linspace(0.05, 1.95, 9)
    assert two.x(times) == pytest.approx(one.x(times), abs=1e-7)
    assert two.costate(times) == pytest.approx(one.costate(times), abs=1e-5)


def test_a_free_switching_time_between_phases_is_found():
    # bang-bang by hand: full push for t_1, full brake to the end; two phases with given inputs find the switch
    push, brake = 1.0, 2.0
    phases = [
        Phase(lambda x, c=c: ca.vertcat(x[1], c), 2, 0, start=start, end=end, duration=(0.5, 50), terminal_cost=cost)
        for c, start, end, cost in ((push, [0, 0], None, None), (-brake, None, [300, 0], lambda t: t))
    ]
    found = solve(build(OptimalControlProblem(phases), Radau(3), 3))
    assert found.solved
    assert found.duration == pytest.approx(30.0, rel=1e-6)
    assert found.phases[0].duration == pytest.approx(20.0, rel=1e-6)


def test_a_link_carries_the_state_over():
    drop = Phase(lambda x: ca.vertcat(x[1], -9.81), 2, 0, start=[2, 0], end=[0, None], duration=(0.1, 5))
    rise = Phase(
        lambda x: ca.vertcat(x[1], -9.81), 2, 0, end=[None, 0], duration=(0.1, 5), terminal_cost=lambda x: -x[0]
    )
    problem = OptimalControlProblem([drop, rise], link=lambda x: ca.vertcat(x[0], -0.8 * x[1]))
    bounce = solve(build(problem, Radau(3), 3))
    assert bounce.phases[1].states[-1, 0] == pytest.approx(2 * 0.8**2, rel=1e-6)


def test_parameters_keep_their_constraints_and_are_priced():
    problem = OptimalControlProblem(
        pushed(1.0), p_bounds=(0, 60), p_cost=lambda p: 0.1 * p[0], p_constraints=lambda p: p[0] - 2,
    )  # fmt: skip
    held = solve(build(problem, Radau(3), 12))
    assert held.p[0] == pytest.approx(2.0, abs=1e-6)
    row = next(rows for rows in held.program.rows if rows.name == "p_constraints")
    price = held.multipliers["rows"][row.first]
    step = 1e-4
    costs = []
    for limit in (2 - step, 2 + step):
        moved = OptimalControlProblem(
            pushed(1.0), p_bounds=(0, 60), p_cost=lambda p: 0.1 * p[0], p_constraints=lambda p, b=limit: p[0] - b,
        )  # fmt: skip
        costs.append(solve(build(moved, Radau(3), 12)).cost)
    assert -(costs[1] - costs[0]) / (2 * step) == pytest.approx(price, rel=1e-3)


def test_a_given_disturbance_is_met_as_if_it_were_written_in_time():
    given = Phase(lambda x, u, w: -x + u + w, 1, 1, start=[0.0], duration=3.0, stage_cost=lambda x, u: x**2 + u**2,
                  signal=lambda t: np.sin(2 * t)[:, None])  # fmt: skip
    written = Phase(lambda x, u, t: -x + u + ca.sin(2 * t), 1, 1, start=[0.0], duration=3.0,
                    stage_cost=lambda x, u: x**2 + u**2)  # fmt: skip
    for scheme in (Radau(3), MultipleShooting(substeps=2)):
        a, b = (solve(build(phase, scheme, 40)) for phase in (given, written))
        assert a.cost == pytest.approx(b.cost, rel=1e-9)


def test_discrete_dynamics_reach_the_cost_of_lqr():
    from scipy.linalg import solve_discrete_are

    A, B = np.array([[1.0, 0.1], [0.0, 1.0]]), np.array([[0.005], [0.1]])
    Q, R = np.diag([1.0, 0.1]), np.array([[0.2]])
    P = solve_discrete_are(A, B, Q, R)
    phase = Phase(
        dynamics=lambda x, u: ca.DM(A) @ x + ca.DM(B) @ u, states=2, inputs=1, start=[1.0, -0.5], duration=30,
        stage_cost=lambda x, u: ca.bilin(ca.DM(Q), x) + ca.bilin(ca.DM(R), u),
        terminal_cost=lambda x: ca.bilin(ca.DM(P), x), discrete=True,
    )  # fmt: skip
    solution = solve(build(phase))
    x0 = np.array([1.0, -0.5])
    assert solution.cost == pytest.approx(x0 @ P @ x0, rel=1e-9)
    assert solution.phases[0].costates[0] == pytest.approx(2 * P @ x0, rel=1e-6)
    assert solution.u(0.0) == pytest.approx(-np.linalg.solve(R + B.T @ P @ B, B.T @ P @ A) @ x0, rel=1e-6)


def test_solution_starts_another_mesh_near_its_optimum():
    problem = array_problem(1.0, 1.0, 1.0)
    coarse = solve(build(problem, Radau(3), 20))
    fine = build(problem, Radau(3), 50)
    warm, cold = solve(fine, start=coarse, tolerance=1e-10), solve(fine, tolerance=1e-10)
    assert warm.cost == pytest.approx(cold.cost, rel=1e-6)
    assert warm.iterations < cold.iterations


def test_scenarios_that_differ_in_their_data_alone_share_their_derivatives():
    rng = np.random.default_rng(0)
    phases = [
        Phase(
            dynamics=lambda x, u, w, p: ca.vertcat(x[1], u + w - p * x[0]), states=2, inputs=1,
            start=rng.normal(size=2), duration=1.0, stage_cost=lambda x, u: ca.sumsqr(x) + u**2,
            signal=rng.normal(size=(5, 1)),
        )
        for _ in range(6)
    ]  # fmt: skip
    programs = [
        build(OptimalControlProblem(few, p_bounds=(0, 5), linked=False), Radau(3), 8) for few in (phases[:1], phases)
    ]
    assert len(programs[1].derivatives.pieces) == len(programs[0].derivatives.pieces)
    found = solve(programs[1], p=[2.0])
    alone = [solve(build(OptimalControlProblem(phase, p_bounds=(0, 5)), Radau(3), 8), p=[2.0]) for phase in phases]
    assert found.cost == pytest.approx(np.mean([one.cost for one in alone]), rel=1e-8)
    assert found.p_gradient == pytest.approx(np.mean([one.p_gradient for one in alone]), rel=1e-6)
