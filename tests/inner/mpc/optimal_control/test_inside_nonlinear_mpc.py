"""What test_nonlinear_mpc.py claims, seen from inside."""

from dataclasses import replace
from types import SimpleNamespace

import casadi as ca
import numpy as np
import pytest

from mpc import Status
from mpc.optimal_control import NonlinearMPC, Phase
from mpc.optimal_control.ipopt import once, solver_of
from mpc.optimal_control.loop_phase import LoopPhase
from mpc.optimal_control.loop_planner import LoopPlanner
from mpc.optimal_control.paths import contracted
from mpc.optimal_control.planning import until_most_agree
from mpc.optimal_control.solving import as_settings


def cart_pole(x, u, p):
    """A pole of length p on a cart, upright at 0, sampled by two Runge–Kutta steps of 25 ms."""

    def rate(z):
        s, c = ca.sin(z[1]), ca.cos(z[1])
        free = 1.0 + 0.2 * s**2
        push = (u + 0.2 * s * (9.81 * c - p[0] * z[3] ** 2)) / free
        return ca.vertcat(z[2], z[3], push, (u * c + 1.2 * 9.81 * s - 0.2 * p[0] * z[3] ** 2 * s * c) / (p[0] * free))

    for _ in range(2):
        h = 0.025
        k1 = rate(x)
        k2 = rate(x + h / 2 * k1)
        k3 = rate(x + h / 2 * k2)
        x = x + h / 6 * (k1 + 2 * k2 + 2 * k3 + rate(x + h * k3))
    return x


def pole(**changes):
    """The controller of the cart-pole."""
    return NonlinearMPC(
        cart_pole, 4, 1,
        **({"Q": [1, 5, 0.1, 0.1], "R": 0.05, "horizon": 30, "U": (-10, 10), "p": [0.5],
            "X": ([-2, -4, -np.inf, -np.inf], [2, 4, np.inf, np.inf])} | changes),
    )  # fmt: skip


@pytest.mark.long
def test_where_no_program_is_solved_the_shifted_plan_stands_in(monkeypatch):
    controller = pole()
    x = np.array([0.0, 0.3, 0.0, 0.0])
    controller(x)
    before = controller.last_plans[0]
    monkeypatch.setattr("mpc.optimal_control.paths.next_step", lambda *a, **k: None)
    u = controller(before.states[1])
    plan = controller.last_plans[0]
    assert u == pytest.approx(before.inputs[1], abs=1e-6)
    assert (plan.status, plan.solver) == (Status.REPLACED, "shifted plan")
    assert "sample before" in plan.status.advice
    controller.reset()
    controller(x)
    assert (controller.last_plans[0].status, controller.last_plans[0].solver) == (Status.REPLACED, "linear law")
    assert controller.last_plans[0].inputs[0] == pytest.approx(np.clip(-controller.linear.gain @ x, -10, 10))


@pytest.mark.parametrize(
    ("starts", "costs", "tried"),
    [(3, [2.0, 2.0, 1.0], 2), (3, [2.0, 1.0, 2.0], 3), (3, [np.nan, np.nan, 1.0], 3), (1, [2.0], 1),
     (5, [2.0, 2.0, 2.0, 1.0, 1.0], 3)],
)  # fmt: skip
def test_starts_end_where_more_than_half_are_one_optimum(starts, costs, tried):
    ends = [SimpleNamespace(status=Status.REPLACED if np.isnan(cost) else Status.SOLVED, cost=cost) for cost in costs]
    assert list(until_most_agree(iter(ends), starts)) == ends[:tried]


def test_costs_without_an_optimum_do_not_agree():
    ends = [SimpleNamespace(status=Status.SOFTENED, cost=1.0)] * 3
    assert len(list(until_most_agree(ends, 3))) == 3


@pytest.mark.parametrize(
    ("errors", "taken", "best"),
    [([0.5**i for i in range(20)], 20, 19), ([1.0, *[0.6] * 20], 9, 1), ([1.0, *[0.6] * 7, 0.4, *[0.3] * 20], 17, 9),
     ([1.0, 1e-12, 1.0], 2, 1), ([np.nan] * 20, 8, 0)],
)  # fmt: skip
def test_paths_go_on_while_their_error_is_halved_within_eight_and_the_best_is_taken(errors, taken, best):
    paths = [SimpleNamespace(error=error) for error in errors]
    left = iter(paths)
    assert contracted(left, 50) is paths[best]
    assert len(list(left)) == len(paths) - taken
    assert contracted(iter(paths), 0) is None


def test_ipopt_gets_no_rows_without_a_bound():
    phase = Phase(lambda x, u, w: x + u + w, 1, 1, duration=4, discrete=True, signal=np.ones((5, 1)),
                  stage_cost=lambda x, u: x**2 + u**2, x_bounds=(-3, 3))  # fmt: skip
    program = LoopPhase(phase, 4, np.zeros(0), None).program
    solver, _ = solver_of(program, as_settings(1e-8, 100, None, None))
    free = np.isinf(program.row_lower) & np.isinf(program.row_upper)
    assert free.sum() >= 4  # of the signal
    assert solver.size1_out("g") == len(free) - free.sum()
    assert len(NonlinearMPC(phase).solve([1.0]).inputs) == 4


@pytest.mark.parametrize(
    ("kick", "limit", "status", "last", "count"),
    [(1.35, None, Status.SOFTENED, "SQP", 4), (0.9, None, Status.SOLVED, "Ipopt", 1), (1.35, 1e-5, Status.LATE, "", 1)],
)  # fmt: skip
def test_where_a_plan_cannot_be_followed_ipopt_is_asked_once_and_elsewhere_if_limits_are_passed(
    kick, limit, status, last, count, monkeypatch
):
    phase = Phase(
        lambda x, u: x + 0.1 * u, 1, 1, discrete=True, duration=12, u_bounds=(-1, 1),
        stage_cost=lambda x, u: (x - 2) ** 2 + 0.1 * u**2, path=lambda x: x - 1,
    )  # fmt: skip
    law, asked = NonlinearMPC(phase, time_limit=limit), []
    law._last[:] = [NonlinearMPC(phase).solve([0.5])]
    law._last[0] = replace(law._last[0], costates=None)
    monkeypatch.setattr("mpc.optimal_control.solving.once", lambda *given: asked.append(given) or once(*given))
    law([kick])
    plan = law.last_plans[0]
    assert (plan.status, len(asked)) == (status, count)
    if limit is None:
        assert plan.solver == last
        assert plan.states[1, 0] == pytest.approx(max(kick - 0.1, 1.0), rel=1e-4)


def test_a_start_whose_programs_lead_to_an_optimum_is_not_solved_again(monkeypatch):
    near, begun = LoopPlanner.near, []
    monkeypatch.setattr(LoopPlanner, "near", lambda *given: begun.append(given) or near(*given))
    law = NonlinearMPC(lambda x, u: x + 0.1 * (ca.sin(x) + u), 1, 1, Q=[1], R=[0.01], horizon=20, U=(-2, 2))
    plan = law.solve([1.5])
    assert plan.status is Status.SOLVED
    assert len(begun) == 1  # from the straight way, which agrees with the linear law's
    assert law.solve(plan.states[2], start=plan).status is Status.SOLVED
