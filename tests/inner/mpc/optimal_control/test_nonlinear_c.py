"""The generated C makes the real-time iteration that Python makes, with a solver of its own, and controls alike."""

import subprocess

import casadi as ca
import numpy as np
import pytest
from compiler import CC, needs_compiler

from mpc import InputError
from mpc.optimal_control import NonlinearMPC
from mpc.optimal_control.c_code import real_time_iteration
from mpc.optimal_control.sqp import next_step

N = 8
UNITS = [(np.ones(2), 1.0, 1.0), (np.array([57.3, 57.3]), 1e3, 1e-4), (np.array([1e3, 3.6e6]), 1e-3, 1e6)]


def pendulum(x, u, w, p):
    """Upright at 0; p its inverse length, w a push."""
    rate = x[1] + 0.05 * (9.81 * p * ca.sin(x[0]) + 4 * u + w)
    return ca.vertcat(x[0] + 0.05 * rate, rate)


def law(limits, sx=np.ones(2), su=1.0, cost=1.0, **changes):  # noqa: B008
    """The controller in these units."""
    sizes = {"U": su, "X": sx, "rate_limit": su, "soft": cost}
    stated = {name: sizes[name] * np.array(value) for name, value in limits.items()}
    stated = {name: (-value, value) if name in "UX" else value for name, value in stated.items()}
    return NonlinearMPC(
        lambda x, u, w, p: sx * pendulum(x / sx, u / su, w, p), 2, 1, Q=cost * np.array([3.0, 0.2]) / sx**2,
        R=cost * 0.1 / su**2, horizon=N, disturbances=1, p=[1.1], **stated, **changes,
    )  # fmt: skip


def compiled(controller, folder):
    """The functions of the C file."""
    path = controller.to_c(folder)
    library = folder / "nonlinear_mpc.so"
    strict = ["-Werror=int-conversion", "-Werror=implicit-function-declaration"]
    subprocess.run([CC, "-O1", "-fPIC", "-shared", *strict, str(path), "-o", str(library), "-lm"], check=True)
    return {name: ca.external(name, str(library)) for name in ("iteration", "step", "derivatives")}


def cart_pole(x, u, w, p):
    """Euler's rule, of a pole of the length p upright at 0."""
    sine, cosine = ca.sin(x[2]), ca.cos(x[2])
    push = (u + 0.2 * p * x[3] ** 2 * sine - 0.2 * 9.81 * sine * cosine) / (1 + 0.2 * sine**2)
    return x + 0.04 * ca.vertcat(x[1], push, x[3], (9.81 * sine - push * cosine) / p)


LIMITS = {
    "none": {},
    "inputs": {"U": 3.0},
    "states": {"U": 8.0, "X": [1.5, 3.0]},
    "rates": {"U": 5.0, "rate_limit": 1.5},
    "soft": {"U": 5.0, "X": [0.5, 0.8], "soft": (4.0, 30.0)},
    "states that cannot be kept": {"U": 2.0, "X": [0.6, 1.0]},
}


@pytest.mark.parametrize(("sx", "su", "cost"), UNITS)
@pytest.mark.parametrize("limits", LIMITS.values(), ids=LIMITS)
def test_its_program_is_that_of_python(limits, sx, su, cost):
    controller = law(limits, sx, su, cost)
    x = sx * [0.7, 0.2]
    last = {"u_prev": su * np.array([0.5])} if "rate_limit" in limits else {}
    given = {"w": 0.3 * np.ones(N), "x_ref": np.tile(sx * [0.05, 0.0], N + 1), "u_ref": np.full(N, -0.1 * su)} | last
    plan = controller.solve(x, **last)
    x = x + sx * [0.02, 0.1]
    planner = controller.planner
    at = planner.shifted(plan, given)
    dear = 100 * ca_cost(controller, at, given)
    step = next_step(planner.stages.at(x, at.states, at.inputs, given), dear)
    iteration = real_time_iteration(controller.linear, controller.model)
    arguments = [x, plan.states.T, plan.inputs.T, given["w"][None], controller.p, given["x_ref"].reshape(-1, 2).T,
                 given["u_ref"][None], *last.values()]  # fmt: skip
    states, inputs, residual = (np.asarray(value) for value in iteration(*arguments))
    assert inputs.T / su == pytest.approx((at.inputs + step.inputs) / su, abs=1e-6)
    assert states.T / sx == pytest.approx((at.states + step.states) / sx, abs=1e-6)
    assert residual < 1e-9
    assert step.relaxed == (limits is LIMITS["states that cannot be kept"])


@pytest.mark.parametrize(
    ("start", "goal", "track", "others"),
    [([0, 0, 0.35, 0], 0, 0.6, 1), ([-0.2, 0, -0.25, 0], 0.55, 0.6, 1), ([0, 0, 0.35, 0], 0, 1e8, 1e7)],
)
def test_a_loop_costs_as_much_as_that_of_python(start, goal, track, others):
    """At the end of the track, and within loose bounds."""
    most = np.array([track, 9 * others, 9 * others, 99 * others])
    controller = NonlinearMPC(
        cart_pole, 4, 1, Q=[4, 0.25, 25, 0.25], R=0.01, horizon=30, X=(-most, most), U=(-10, 10), p=[0.5], iterations=1
    )
    aim = np.tile([goal, 0, 0, 0], (31, 1))
    iteration = real_time_iteration(controller.linear, controller.model)
    plan = controller.solve(start, x_ref=aim)
    states, inputs = plan.states.T, plan.inputs.T
    states, inputs = np.hstack([states[:, :1], states[:, :-1]]), np.hstack([inputs[:, :1], inputs[:, :-1]])
    costs, at = [0.0, 0.0], [np.array(start, dtype=float)] * 2
    for _ in range(50):
        states, inputs, residual = (
            np.asarray(value) for value in iteration(at[0], states, inputs, [0.5], aim.T, np.zeros((1, 30)))
        )
        assert residual < 1e-8
        for i, u in enumerate((inputs[:, 0], controller(at[1], x_ref=aim))):
            assert abs(u).max() <= 10 + 1e-8
            assert abs(at[i][0]) <= track + 1e-6
            costs[i] += (at[i] - aim[0]) ** 2 @ [4, 0.25, 25, 0.25] + 0.01 * u @ u
            at[i] = controller.model.next(at[i], u, np.zeros(0), np.array([0.5]))
    assert costs[0] == pytest.approx(costs[1], rel=1e-5)


@pytest.mark.parametrize("seed", [0, 3, 14, 16, 18])
def test_weights_far_apart_and_prices_give_the_optimum_of_a_linear_plant(seed):
    rng = np.random.default_rng(seed)
    nx, nu, N = 3, 2, 12
    A = rng.normal(size=(nx, nx))
    A *= 1.02 / np.abs(np.linalg.eigvals(A)).max()
    B = rng.normal(size=(nx, nu))
    Q = 10 ** rng.uniform(-4, 4, nx) * [seed % 2, 1, 1]
    P, R = 10 ** rng.uniform(2, 6), 10 ** rng.uniform(-4, 1, nu)
    controller = NonlinearMPC(
        lambda x, u: ca.DM(A) @ x + ca.DM(B) @ u, nx, nu, Q=Q, R=R, P=P * np.eye(nx), horizon=N, soft=(10.0, 1e4),
        X=(-np.full(nx, 2.0), np.full(nx, 2.0)), U=(-np.ones(nu), np.ones(nu)), rate_limit=np.full(nu, 0.4),
    )  # fmt: skip
    x = rng.uniform(-1.5, 1.5, nx)
    iteration = real_time_iteration(controller.linear, controller.model)
    _, inputs, residual = iteration(x, np.tile(x[:, None], N + 1), np.zeros((nu, N)), 0, 0, np.zeros(nu))
    costs = []
    for plan in (np.asarray(inputs).T, controller.solve(x, u_prev=np.zeros(nu)).inputs):
        assert np.abs(plan).max() <= 1 + 1e-9
        assert np.abs(np.diff(plan, axis=0, prepend=0)).max() <= 0.4 + 1e-9
        states = [x]
        for u in plan:
            states.append(A @ states[-1] + B @ u)
        over = np.maximum(np.abs(states[1:]).max(axis=1) - 2, 0)
        along = sum(Q @ state**2 for state in states[:-1]) + sum(R @ u**2 for u in plan)
        costs.append(along + P * states[-1] @ states[-1] + 10 * over.sum() + 1e4 * over @ over)
    assert costs[0] == pytest.approx(costs[1], rel=1e-9)
    assert residual < 1e-9


def test_a_loop_of_terminal_weights_far_above_the_others_is_that_of_python():
    controller = NonlinearMPC(
        lambda x, u: ca.vertcat(x[0] + 0.1 * x[1] + 0.005 * u, x[1] + 0.1 * u), 2, 1, Q=[1e-4, 1e-4], R=1e-4,
        P=1e4 * np.eye(2), horizon=15, U=(-1, 1), iterations=1,
    )  # fmt: skip
    iteration = real_time_iteration(controller.linear, controller.model)
    at = [np.array([0.4, 0.0])] * 2
    states, inputs = np.tile(at[0][:, None], 16), np.zeros((1, 15))
    for _ in range(20):
        states, inputs, residual = (np.asarray(value) for value in iteration(at[0], states, inputs, 0, 0))
        for i, u in enumerate((inputs[:, 0], controller(at[1]))):
            at[i] = controller.model.next(at[i], u, np.zeros(0), np.zeros(0))
        assert at[0] == pytest.approx(at[1], abs=2e-6)
        assert residual < 1e-9


def ca_cost(controller, plan, given):
    """Cost of a plan, summed up anew."""
    linear = controller.linear
    error, effort = plan.states - given["x_ref"].reshape(-1, 2), plan.inputs - given["u_ref"][:, None]
    cost = sum(e @ linear.Q @ e + v @ linear.R @ v for e, v in zip(error, effort))
    return cost + error[-1] @ linear.P @ error[-1]


@pytest.mark.long
@needs_compiler
def test_compiled_it_is_the_same_and_controls_like_the_optimum(tmp_path):
    controller = law({"U": 4.0, "X": [1.5, 3.0], "rate_limit": 2.0}, iterations=1)
    c = compiled(controller, tmp_path)
    x, w, p = np.array([0.6, 0.2]), np.zeros((1, N)), controller.p
    states, inputs = np.tile(x[:, None], N + 1), np.zeros((1, N))
    optimum = law({"U": 4.0, "X": [1.5, 3.0], "rate_limit": 2.0})
    first = real_time_iteration(controller.linear, controller.model)(x, states, inputs, w, p, 0, 0, 0)
    found = c["iteration"](x, states, inputs, w, p, 0, 0, 0)
    for one, other in zip(first, found):
        assert np.asarray(one) == pytest.approx(np.asarray(other), abs=1e-9)
    assert np.asarray(c["step"](x, 0.3, 0.1, p)).ravel() == pytest.approx(controller.model.next(x, [0.3], [0.1], p))
    slopes = controller.model.linearised_at(x, np.array([0.3]), np.array([0.1]), p)
    for one, other in zip(c["derivatives"](x, 0.3, 0.1, p), slopes):
        assert np.asarray(one).ravel() == pytest.approx(np.ravel(other))
    for _ in range(10):  # towards the optimum of the first sample, with the shift taken back
        states, inputs, _ = c["iteration"](x, states, inputs, w, p, 0, 0, 0)
        states, inputs = (np.hstack([np.asarray(v)[:, :1], np.asarray(v)[:, :-1]]) for v in (states, inputs))
    costs = [0.0, 0.0]
    at, last = [x, x], [np.zeros(1), np.zeros(1)]
    for _ in range(60):
        states, inputs, residual = c["iteration"](at[0], states, inputs, w, p, 0, 0, last[0])
        assert float(residual) < 1e-8
        answers = [np.asarray(inputs)[:, 0], optimum(at[1], u_prev=last[1])]
        for i, u in enumerate(answers):
            costs[i] += at[i] @ np.diag([3.0, 0.2]) @ at[i] + 0.1 * u @ u
            at[i], last[i] = np.asarray(pendulum(at[i], u, 0.0, 1.1)).ravel(), u
    assert costs[0] == pytest.approx(costs[1], rel=0.01)
    assert at[0] == pytest.approx([0.0, 0.0], abs=1e-3)


def test_what_cannot_be_written_is_refused(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(InputError) as caught:
        law({"U": 3.0}).to_c(tmp_path / "file")
    assert caught.value.argument == "folder"
    with pytest.raises(InputError) as caught:
        law({"U": 3.0}).to_c(3)
    assert caught.value.argument == "folder"
