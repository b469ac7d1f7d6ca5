"""What test_codesign_statements.py claims, seen from inside."""

from dataclasses import replace

import casadi as ca
import numpy as np
import pytest
from scipy.linalg import expm, solve_discrete_are
from small_plants import mass

import ccdtools as cc
from ccdtools.co_design.closed_loop import ClosedLoopReturns
from ccdtools.co_design.differentiable_model import scenario_tensors
from ccdtools.co_design.methods.open_loop import drawn, open_loop_problem
from ccdtools.co_design.methods.trajectory_cost import TrajectoryCost

TRAJECTORIES = [cc.Simultaneous(runs=2, starts=1), cc.Nested("trajectory", runs=2, starts=1),
                cc.Sequential("open_loop", starts=1)]  # fmt: skip


def codesigned(problem, method, seed=0, **given):
    """The result of a method."""
    return cc.codesign(problem, method=method, rng=np.random.default_rng(seed), **given)


def weak(illustrative):
    """An actuator that cannot stop the second state within its limit at any design."""
    return replace(
        illustrative.problem(), X=([-10, -2], [5, 0.05]), U=([-0.05], [0.05]), steps=20,
        scenarios=cc.FixedStart([-1, -0.5], cc.Gaussian([0.1, 0.4])),
    )  # fmt: skip


@pytest.mark.long
def test_designs_that_were_looked_at_in_vain_are_counted_from_every_start(monkeypatch, illustrative):
    looked = []

    class Counted(TrajectoryCost):
        def __call__(self, v):
            looked.append(v)
            return super().__call__(v)

        def first_point(self, v):
            looked.append(v)
            return super().first_point(v)

    monkeypatch.setattr("ccdtools.co_design.methods.trajectory_cost.TrajectoryCost", Counted)
    found = codesigned(weak(illustrative), cc.Nested("trajectory", runs=1, starts=3), design=[0.5])
    assert found.status.name == "INFEASIBLE"
    assert found.evaluations == len(looked) > 2


@pytest.mark.check
def test_a_state_that_is_called_like_a_parameter_of_the_program_keeps_its_name():
    x, u, w, p = ca.SX.sym("x", 2), ca.SX.sym("u"), ca.SX.sym("w"), ca.SX.sym("p")
    plant = cc.Plant(x, u, w, p, ca.vertcat(x[1], -p * ca.sin(x[0]) - x[1] + u + w), cc.DesignSpace(["k"], [1], [3]),
                     dt=0.1, state_names=["p1", "v"], input_names=["valve"])  # fmt: skip
    problem = replace(mass(), model=cc.discretise(plant), scenarios=cc.FixedStart([0.1, 3.0], cc.Gaussian([0.5])),
                      X=([-0.2, -5], [0.2, 5]), U=([-0.1], [0.1]), steps=20)  # fmt: skip
    program = open_loop_problem(problem, drawn(problem, 2, np.random.default_rng(0)), design=np.array([2.0]))
    assert program.phases[0].input_names == ("valve",)
    for method in TRAJECTORIES[:2]:
        found = codesigned(problem, method)
        assert found.status.name == "INFEASIBLE"
        assert "p1 ≤ 0.2" in "\n".join(found.notes)


def test_of_many_starts_one_that_breaks_the_limits_is_not_the_best():
    good = codesigned(mass(), cc.Nested(runs=50, starts=1))
    better = replace(good, status=type(good.status)["LIMITS_BROKEN"],
                     closed_loop=ClosedLoopReturns(good.closed_loop.values + 1, good.closed_loop.lost))  # fmt: skip
    starts = cc.MultiStart(starts=np.zeros((2, 1)), results=(better, good), space=mass().design)
    assert starts.best is good


def depths(p, x0, w, bounds):
    """Fraction outside |x| ≤ bounds and mean peak in half-widths, a standard error above each, and mean cost of LQR."""
    M = np.zeros((4, 4))
    M[:2] = [[0, 1, 0, 0], [-p[0], -p[1], 1, 1]]
    D = expm(0.1 * M)
    A, B = D[:2, :2], D[:2, 2:3]
    Q, R = np.diag([1.0, 0.2]), 0.1
    P = solve_discrete_are(A, B, Q, [[R]])
    K = np.linalg.solve(R + B.T @ P @ B, B.T @ P @ A)
    x, cost, outside = x0, np.zeros(len(x0)), []
    for k in range(w.shape[1]):
        u = np.clip(-x @ K.T, -8, 8)
        x = x @ A.T + (u + w[:, k]) @ B.T
        cost += np.einsum("ni,ij,nj->n", x, Q, x) + R * u[:, 0] ** 2
        outside.append(np.maximum((np.abs(x) - bounds) / bounds, 0).max(axis=1))
    beyond = np.array(outside)
    measures = ((beyond > 0).mean(axis=0), beyond.max(axis=0))
    often, far = (part.mean() + part.std(ddof=1) / np.sqrt(len(x0)) for part in measures)
    return often, far, cost.mean() + 0.4 * p[0] ** 2 + 0.5 * p[1]


@pytest.mark.check
@pytest.mark.parametrize("unit", [1.0, 1e3])
@pytest.mark.parametrize("tolerance", [(0.02, 0.015), (0.2, 0.008)], ids=["how often", "how far"])
def test_a_design_goes_up_to_the_limit_that_binds_and_no_further(unit, tolerance):
    x, u, w, p = ca.SX.sym("x", 2), ca.SX.sym("u"), ca.SX.sym("w"), ca.SX.sym("p", 2)
    space = cc.DesignSpace(["k", "c"], [0.5, 0.1], [4, 2])
    plant = cc.Plant(x, u, w, p, ca.vertcat(x[1], -p[0] * x[0] - p[1] * x[1] + u + w), space, dt=0.1)
    objective = cc.QuadraticObjective(np.diag([1, 0.2]) / unit**2, [[0.1 / unit**2]],
                                      design_cost=lambda p: 0.4 * p[0] ** 2 + 0.5 * p[1])  # fmt: skip
    problem = cc.CoDesignProblem(
        cc.discretise(plant), X=([-1.6 * unit, -1.3 * unit], [1.6 * unit, 1.3 * unit]), U=([-8 * unit], [8 * unit]),
        objective=objective, steps=30, scenarios=cc.FixedStart([1.5 * unit, -1.0 * unit], cc.Gaussian([0.4 * unit])),
        limit_tolerance=tolerance,
    )  # fmt: skip
    found = codesigned(problem, cc.Nested(runs=200, starts=1))
    rng = np.random.default_rng(0)
    rng.spawn(1)
    x0, w = (part.double().numpy() / unit for part in scenario_tensors(problem, 200, rng))
    limit = np.array([1.6, 1.3])
    designs = [(k, c) for k in np.linspace(0.5, 0.7, 3) for c in np.linspace(0.1, 2.0, 77)]
    seen = [depths(p, x0, w, limit) for p in designs]
    best = min(cost for often, far, cost in seen if often <= tolerance[0] and far <= tolerance[1])
    free = min(cost for _, _, cost in seen)
    often, far, cost = depths(found.design, x0, w, limit)
    assert best > free + 0.002 * free  # the limit binds
    assert often <= tolerance[0] * (1 + 1e-6)
    assert far <= tolerance[1] * (1 + 1e-6)
    assert cost <= best + 0.001 * best
    assert found.status.settled
    assert found.evaluations < 250
