"""Plans of loops at saddles, and in any units."""

import casadi as ca
import numpy as np
import pytest

from mpc import Status
from mpc.optimal_control import NonlinearMPC, Phase


def heading(x, u):
    """Position, heading and its rate."""
    return ca.vertcat(x[0] + 0.2 * (ca.cos(x[1]) - 1), x[1] + 0.2 * x[2], x[2] + 0.2 * u)


def product(x, u):
    """Two integrators, and a state that only their product moves."""
    return ca.vertcat(x[0] + u[0], x[1] + u[1], x[0] * x[1] ** 2)


PRODUCT = product, (3, 2), {"Q": np.diag([1, 0.3, 1]), "R": 0.1 * np.eye(2), "P": np.diag([1, 0.3, 1]), "horizon": 6}
HEADING = heading, (3, 1), {"Q": np.diag([1, 0.02, 0.02]), "R": 0.02, "P": np.diag([10, 0.02, 0.02]), "horizon": 20}
SYMMETRICAL = pytest.mark.parametrize(
    ("step", "sizes", "stated", "limit", "x_ref", "best"),
    [(*PRODUCT, 5.0, [-2, 0, -1], 7.17824), (*PRODUCT, 5e4, [-2, 0, -1], 7.17824), (*HEADING, 2.0, [-3, 0, 0], 95.5545),
     (*HEADING, 2e4, [-3, 0, 0], 71.1596)],
    ids=["product", "product, loose bounds", "heading", "heading, loose bounds"],
)  # fmt: skip


@SYMMETRICAL
def test_a_symmetrical_start_is_no_trap_for_weights(step, sizes, stated, limit, x_ref, best):
    """All starts led to saddles at twice the cost, which were SOLVED: they are left along what falls there."""
    plan = NonlinearMPC(step, *sizes, U=(-limit, limit), **stated).solve([0, 0, 0], x_ref=x_ref)
    assert plan.status is Status.SOLVED
    assert plan.cost == pytest.approx(best, rel=1e-5 if limit < 10 else 0.1)  # loose bounds say nothing of sizes


@SYMMETRICAL
def test_a_real_time_iteration_stays_at_no_saddle(step, sizes, stated, limit, x_ref, best):
    """The reference jumps while the state rests where it is symmetrical: the saddle was SOLVED there, for ever."""
    controller, x = NonlinearMPC(step, *sizes, U=(-limit, limit), iterations=1, **stated), np.zeros(3)
    for ref in (np.zeros(3), np.zeros(3), *[x_ref] * 5):
        u = controller(x, x_ref=ref)
        x, before = np.array(ca.DM(step(ca.DM(x), ca.DM(u)))).ravel(), x
    assert controller.last_plans[0].cost < 1.5 * controller.solve(before, x_ref=x_ref).cost


@pytest.mark.parametrize("height", [0.1, 0.5, 2.0])
def test_a_reference_that_makes_a_saddle_while_the_cost_falls_is_no_trap(height):
    """Real-time iterations were SOLVED there for ever: no cost rose, as another state still came to rest."""
    step = lambda x, u: ca.vertcat(0.95 * x[0] + 0.1 * u[0], x[1] + 0.1 * u[1], x[1] ** 2)  # noqa: E731
    law, x = NonlinearMPC(step, 3, 2, iterations=1, Q=[1, 0.01, 10], R=[1, 1], horizon=20, U=(-500, 500)), [50.0, 0, 0]
    for k in range(30):
        u = law(x, x_ref=[0, 0, 0 if k < 5 else height])
        x = np.asarray(step(ca.DM(x), ca.DM(u))).ravel()
    assert x[2] == pytest.approx(height, rel=0.1)


@pytest.mark.parametrize("units", [(1.0, 1e6, 1.0), (2e3, 1.0, 1.0), (1e-6, 57.3, 1e3)])
def test_without_limits_of_states_units_change_nothing(units):
    """A state that no input moves at once had the size 1: after the jump 64.5 was SOLVED in µrad, 2.80 in radians."""
    _, sizes, stated = HEADING
    weights = {name: stated[name] / np.outer(units, units) for name in ("Q", "P")}
    step = lambda x, u: heading(x / ca.DM(units), u) * ca.DM(units)  # noqa: E731
    own = NonlinearMPC(heading, *sizes, U=(-2, 2), **stated)
    other = NonlinearMPC(step, *sizes, U=(-2, 2), **(stated | weights))
    x = np.zeros(3)
    for x_ref in ([-2, 0, 0], [-2, 0, 0], [0, 0, 0]):
        u = own(x, x_ref=x_ref)
        other(x * units, x_ref=np.multiply(x_ref, units))
        assert other.last_plans[0].cost == pytest.approx(own.last_plans[0].cost, rel=1e-6)
        x = np.array(heading(ca.DM(x), ca.DM(u))).ravel() + np.array([0.1, 0.05, -0.3])


@pytest.mark.parametrize("stiffness", [1e4, 1e6, 1e9])
def test_a_stiff_coupling_hides_no_saddle(stiffness):
    """Two axes held together, between two wells that a signal makes of one: 3.77 was SOLVED, not -8.71."""
    cost = lambda x, w: w * x[0] ** 2 + 0.5 * x[0] ** 4 + stiffness * (x[0] - x[1]) ** 2  # noqa: E731
    phase = Phase(
        lambda x, u: x + 0.1 * u, 3, 3, discrete=True, duration=12, u_bounds=(-2, 2), signal=np.ones((13, 1)),
        stage_cost=lambda x, u, w: cost(x, w) + 0.1 * ca.sumsqr(u) + (x[2] - 1) ** 2, terminal_cost=cost,
    )  # fmt: skip
    controller = NonlinearMPC(phase)
    for w in (1, 1, 1, -2):
        controller([0, 0, 0], w=[w])
    (plan,) = controller.last_plans
    assert plan.status is Status.SOLVED
    assert plan.cost == pytest.approx(-8.706, abs=2e-3)


@pytest.mark.parametrize("unit", [1.0, 1e3, 1e4])
def test_saddles_of_inputs_without_limits_are_left_in_any_unit(unit):
    """In thousandths what a saddle saves was less than the rounding of the cost by inputs of size 1: 48 was SOLVED."""
    Q = np.diag([0.2, 1.0])
    controller = NonlinearMPC(
        lambda x, u: ca.vertcat(0.6 * x[0] + 0.5 * u / unit, 0.5 * x[1] + (u / unit) ** 2), 2, 1, Q=Q, P=5 * Q,
        R=[[0.1 / unit**2]], horizon=7,
    )  # fmt: skip
    plan = controller.solve([0, 0], x_ref=[0, 2])
    assert plan.status is Status.SOLVED
    assert plan.cost < 5.3


@pytest.mark.parametrize(("seed", "saddle"), [(2, 4.56554), (50, 4.67976)])
def test_saddles_along_limits_of_changes_are_left(seed, saddle):
    """Where such limits act a saddle was looked for without them, and SOLVED; two optima lie beside the second."""
    rng = np.random.default_rng(seed)
    nu, N = int(rng.integers(1, 4)), int(rng.integers(4, 16))
    decay, ref = rng.uniform(0.3, 0.8), np.append(np.zeros(nu), rng.uniform(0.5, 3))
    Q, R = np.diag(10 ** rng.uniform(-1, 1, nu + 1)), np.diag(10 ** rng.uniform(-2, 0, nu))
    controller = NonlinearMPC(
        lambda x, u: ca.vertcat(decay * x[:nu] + 0.5 * u, 0.5 * x[nu] + ca.sumsqr(u)), nu + 1, nu, Q=Q, R=R, P=5 * Q,
        horizon=N, rate_limit=np.full(nu, 0.5), U=(-3 * np.ones(nu), 3 * np.ones(nu)),
    )  # fmt: skip
    plan = controller.solve(np.zeros(nu + 1), x_ref=ref, u_prev=np.zeros(nu))
    assert plan.status is Status.SOLVED
    assert plan.cost < 0.99 * saddle
