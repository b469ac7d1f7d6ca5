"""Derivatives put together from pieces are those of the whole, and what is made once is not made again."""

import casadi as ca
import numpy as np
import pytest

from mpc.optimal_control import HermiteSimpson, MultipleShooting, OptimalControlProblem, Phase, Radau, build, solve


def swing(**change):
    """A pendulum with everything that a phase may have."""
    given = {
        "dynamics": lambda x, u, w, p, t: ca.vertcat(x[1], u - p[0] * ca.sin(x[0]) - p[1] * x[1] + w * ca.cos(t)),
        "states": 2, "inputs": 1, "stage_cost": lambda x, u, p: x[0] ** 2 * p[1] + u**2 * ca.exp(x[1]),
        "terminal_cost": lambda x, t, p: x[1] ** 4 * t + p[0] * x[0], "start": [1.0, None], "duration": 2.0,
        "path": lambda x, u: ca.vertcat(x[0] * u - 3, x[1] ** 2 - 9), "x_bounds": (-5, 5),
        "boundary": lambda x0, x, t0, t, p: x0[1] * x[0] - 0.1 * t * p[1] * t0, "boundary_bounds": (-9, 9),
        "signal": [[0.0], [1.0], [0.5]],
    }  # fmt: skip
    return Phase(**(given | change))


def free(**change):
    """The same, of a free duration."""
    still = {"dynamics": lambda x, u, p, t: ca.vertcat(x[1], u * ca.sin(t) - p[0] * x[0] ** 3), "signal": None}
    return swing(**(still | {"duration": (0.5, 4), "start": None} | change))


SHARED = {"p_bounds": ([0, 0], [3, 2]), "p_cost": lambda p: p[0] ** 3 * p[1],
          "p_constraints": lambda p: p[0] * p[1] - 2}  # fmt: skip
PROGRAMS = {
    "Radau": lambda: build(OptimalControlProblem(swing(), **SHARED), Radau(3), 4),
    "Hermite-Simpson": lambda: build(OptimalControlProblem(swing(), **SHARED), HermiteSimpson(), 3),
    "shooting": lambda: build(OptimalControlProblem(swing(), **SHARED), MultipleShooting(2), 3),
    "linked phases of free duration": lambda: build(
        OptimalControlProblem([free(), free(), free()], link=lambda x, p: ca.vertcat(x[0] ** 2, p[0] * x[1]), **SHARED),
        Radau(2), (2, 3, 1),
    ),
    "the worst of scenarios": lambda: build(
        OptimalControlProblem([swing(), free()], linked=False, risk="worst", **SHARED), Radau(2), (2, 3)
    ),
    "a table": lambda: build(
        Phase(
            lambda x, u: ca.interpolant("drag", "bspline", [np.linspace(-2, 2, 9)], np.linspace(-2, 2, 9) ** 2)(x) + u,
            1, 1, start=[0.5], stage_cost=lambda x, u: x**2 + u**2,
        ),
        Radau(2), 3,
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", PROGRAMS)
def test_derivatives_of_pieces_are_those_of_the_whole(name):
    program = PROGRAMS[name]()
    random = np.random.default_rng(1)
    v = program.guess + 0.1 * random.standard_normal(len(program.guess))
    multipliers = random.standard_normal(len(program.row_lower))
    f, slope = program.derivatives.jacobian[0](v)
    g, rows = program.derivatives.jacobian[1](v)
    curvature = np.array(program.derivatives.hessian(v, 0.7, multipliers))
    lagrangian = 0.7 * program.f + ca.dot(multipliers, program.g)
    whole = ca.Function("whole", [program.v], [
        program.f, program.g, ca.gradient(program.f, program.v), ca.jacobian(program.g, program.v),
        ca.hessian(lagrangian, program.v)[0],
    ])(v)  # fmt: skip
    for found, expected in zip((f, g, slope, rows), whole):
        assert np.array(found) == pytest.approx(np.array(expected), rel=1e-10, abs=1e-10)
    assert curvature + np.triu(curvature, 1).T == pytest.approx(np.array(whole[4]), rel=1e-9, abs=1e-9)
    assert np.array(program.derivatives.jacobian[1](v)[1].sparsity().nnz()) <= ca.DM(whole[3]).nnz()


@pytest.mark.parametrize("name", PROGRAMS)
def test_derivatives_are_differences_of_values(name):
    program = PROGRAMS[name]()
    random = np.random.default_rng(2)
    v = program.guess + 0.1 * random.standard_normal(len(program.guess))
    way = random.standard_normal(len(v))
    step = 1e-5
    ahead, behind = (np.array(program.derivatives.values(v + sign * step * way)[1]).ravel() for sign in (1, -1))
    rows = np.array(program.derivatives.jacobian[1](v)[1]) @ way
    assert rows == pytest.approx((ahead - behind) / (2 * step), rel=1e-5, abs=1e-6)


def test_solvers_are_made_once_whatever_is_held():
    phase = Phase(
        lambda x, u, p: ca.vertcat(x[1], u - p[0] * x[0]), 2, 1, start=[1, 0],
        stage_cost=lambda x, u: ca.sumsqr(x) + u**2,
    )  # fmt: skip
    program = build(OptimalControlProblem(phase, p_bounds=(0, 5)), Radau(3), 10)
    costs = [solve(program, p=[p]).cost for p in (1.0, 2.0, 1.0)]
    assert costs[0] == costs[2] != costs[1]
    assert len(program.derivatives.solvers) <= 2  # one for a guess, one for going on from a solution
    limited = [solve(program, p=[p], time_limit=limit).cost for p, limit in ((1.0, 60.0), (2.0, 50.0), (1.0, 40.0))]
    assert limited[:2] == pytest.approx(costs[:2])
    assert len(program.derivatives.solvers) <= 4  # the same with a clock, for any time


def test_graphs_do_not_grow_with_the_mesh():
    def size(intervals):
        program = build(OptimalControlProblem(swing(), **SHARED), Radau(3), intervals)
        return program.derivatives.hessian.n_instructions() + program.derivatives.jacobian[1].n_instructions()

    assert size(400) == size(40)


def scenario(a, b, c, **change):
    """A scenario with constants of its own, some of which vanish or become one for some of them."""

    def rates(x, u, p):
        return ca.vertcat(x[1] * a, u - ca.pi * p[0] * ca.if_else(x[0] > b, x[0] ** c, -b * x[0]))

    given = {
        "dynamics": rates, "states": 2, "inputs": 1,
        "stage_cost": lambda x, u: a * x[0] ** 2 + (u - b) ** 2 - 3e-9 * x[1] * c,
        "terminal_cost": lambda x: c * ca.exp(b * x[1]), "start": [1.0, 0.5], "path": lambda x: a * x[1] ** 2 - 9 - b,
    }  # fmt: skip
    return Phase(**(given | change))


@pytest.mark.parametrize("scheme", [Radau(2), HermiteSimpson(), MultipleShooting(2)])
def test_scenarios_of_other_constants_are_each_what_they_are_alone(scheme):
    constants = [
        (1.0, 0.3, 2.5), (2.0, 0.3, 3.0), (-1e-3, 0.7, 1.5), (1e6, -0.2, 2.0), (2.5, 0.0, 2.5), (7.0, 1.0, 2.2)
    ]  # fmt: skip
    weights = [0.1, 0.2, 0.3, 0.1, 0.2, 0.1]
    phases = [scenario(*own) for own in constants]
    together = build(OptimalControlProblem(phases, p_bounds=(0, 2), linked=False, weights=weights), scheme, 3)
    random = np.random.default_rng(3)
    v = together.guess + 0.1 * random.standard_normal(len(together.guess))
    f, g = (np.array(value).ravel() for value in together.derivatives.values(v))
    cost, rows = 0.0, []
    for phase, weight, part in zip(phases, weights, together.parts):
        alone = build(OptimalControlProblem(phase, p_bounds=(0, 2)), scheme, 3)
        own = np.r_[v[part.first : part.last], v[together.parameters]]
        values = [np.array(value).ravel() for value in alone.derivatives.values(own)]
        cost += weight * values[0][0]
        rows.append(values[1])
    assert f[0] == pytest.approx(cost, rel=1e-12)
    assert g == pytest.approx(np.concatenate(rows), rel=1e-12, abs=1e-12)
    assert len(together.derivatives.pieces) < 3 * len(phases)


@pytest.mark.long
def test_graphs_do_not_grow_with_scenarios_of_other_constants():
    def size(scenarios, weights=None):
        phases = [scenario(1.5 + k, 0.1 + 0.01 * k, 2.5 + k) for k in range(scenarios)]
        program = build(OptimalControlProblem(phases, p_bounds=(0, 2), linked=False, weights=weights), Radau(3), 4)
        return program.derivatives.hessian.n_instructions() + program.derivatives.jacobian[1].n_instructions()

    assert size(20) == size(5) == size(5, [0.1, 0.2, 0.3, 0.2, 0.2])
