"""From a log to a controller that keeps its limits, with the price; the filter and the sets that know W."""

from dataclasses import replace
from functools import cache

import casadi as ca
import numpy as np
import pytest

from ccdtools import (
    CoDesignProblem,
    DesignSpace,
    FixedStart,
    Gaussian,
    InputError,
    LinearFeedback,
    Plant,
    QuadraticObjective,
    deploy,
    discretise,
    linear_mpc,
    saturated_lqr,
)
from ccdtools.co_design import admissible_inputs, closed_loop_returns, feasible_sets
from ccdtools.controllers import Filtered
from ccdtools.estimation import Measurement
from ccdtools.twin import DigitalTwin, deploy_and_update, disturbance_set, robust_mpc, switchback_on, updated_problem
from invariant_sets import Polytope
from mpc import InfeasibleError, Status

P = np.array([3.0])


@pytest.fixture(scope="module")
def problem(illustrative):
    return illustrative.problem()


@pytest.fixture(scope="module")
def log(illustrative, problem):
    real, rng = illustrative.real, np.random.default_rng(0)
    return deploy(real.plant, saturated_lqr(problem, P), P, real.disturbance.sample(60, 100, rng), x0=illustrative.x0)


@pytest.fixture(scope="module")
def found(problem, log):
    return robust_mpc(problem, P, log, rng=np.random.default_rng(1), level=0.95, runs=20)


def stepped(problem, W, law, x, rng, steps=60):
    """States of a loop on the linear model with errors at vertices of W, stepped here."""
    A, B, _ = problem.model.matrices(P)
    states = []
    for _ in range(steps):
        x = x @ A.T + law(x) @ B.T + W.vertices[rng.integers(len(W.vertices), size=len(x))]
        states.append(x)
    return np.array(states)


def test_the_controller_keeps_its_limits_under_errors_of_the_set(found, problem):
    rng = np.random.default_rng(2)
    starts = found.robust_set.set.sample(40, rng=rng)
    starts = np.array([x for x in starts if found.controller.solve(x).status is Status.SOLVED])
    assert len(starts) > 30
    low, high = problem.state_limits(P).bounding_box()
    states = stepped(problem, found.W, found.controller, starts, rng)
    assert (states >= low - 1e-8).all()
    assert (states <= high + 1e-8).all()


def test_the_price_is_the_difference_on_common_runs(found, problem):
    again = closed_loop_returns(problem, found.controller, P, np.random.default_rng(0), runs=20)
    assert len(again.values) == len(found.tightened.values) == len(found.nominal.values) == 20
    assert found.price.mean == pytest.approx(np.mean(found.nominal.values - found.tightened.values), abs=1e-9)
    assert "at a return of" in str(found)


def test_w_holds_what_the_linearisation_of_a_nonlinear_model_leaves_out():
    x, u, w = ca.SX.sym("x", 2), ca.SX.sym("u"), ca.SX.sym("w")
    k, space = ca.SX.sym("k"), DesignSpace(["k"], lower=[0.5], upper=[2.0], units=["N/m"])
    hardens = ca.vertcat(x[1], -k * x[0] - 20 * x[0] ** 3 - 0.4 * x[1] + u + w)
    plant = Plant(x, u, w, k, hardens, space, dt=0.05)
    X, U, gusts = ([-1, -1], [1, 1]), (-2, 2), Gaussian([0.02])
    objective = QuadraticObjective(np.diag([10.0, 1.0]), [[0.1]])
    own = CoDesignProblem(discretise(plant, X=X, U=U, W=(-0.1, 0.1)), X=X, U=U, objective=objective,
                          scenarios=FixedStart([0.2, 0.0], gusts), steps=20)  # fmt: skip
    rng = np.random.default_rng(0)
    starts = rng.uniform(-0.8, 0.8, (40, 2))
    logged = deploy(plant, saturated_lqr(own, [1.0]), [1.0], gusts.sample(40, 100, rng), x0=starts)
    robust = robust_mpc(own, [1.0], logged, rng=rng, level=0.95, runs=3)
    A, B, _ = own.model.matrices([1.0])
    errors = logged.states[:, 1:] - logged.states[:, :-1] @ A.T - logged.inputs @ B.T
    assert robust.W.contains(errors.reshape(-1, 2)).mean() > 0.92


def test_logs_of_several_designs_are_carried_to_the_newest(problem, illustrative, log):
    law, rng = saturated_lqr(problem, P), np.random.default_rng(5)
    draws = illustrative.real.disturbance.sample(30, 100, rng)
    elsewhere = deploy(illustrative.real.plant, law, [2.0], draws, x0=illustrative.x0)
    twin = DigitalTwin(problem.model).remembering(elsewhere).remembering(log)
    W = disturbance_set(twin.carried(), level=0.95)
    assert 0.9 < W.contains(twin.logs[1].e_next.reshape(-1, 2)).mean() < 0.99
    assert robust_mpc(problem, P, twin.carried(), rng=rng, level=0.95, runs=2).W.equals(W, tol=1e-9)


def test_the_robust_set_is_part_of_the_nominal_one_and_shrinks_with_the_level(found, problem):
    assert found.robust_set.set.is_subset(found.nominal_set.set, tol=1e-6)
    assert 0 < found.volume_left < 1
    wider = feasible_sets(problem, W=found.W.scale(1.2)).at(P)
    assert wider.is_subset(found.robust_set.set, tol=1e-6)


def test_w_as_a_function_of_the_design_is_asked_at_each(problem, found):
    sets = feasible_sets(problem, W=lambda p: found.W.scale(float(p[0]) / P[0]))
    assert sets.at(P).equals(found.robust_set.set)
    assert sets.at([1.5]).equals(feasible_sets(problem, W=found.W.scale(0.5)).at([1.5]))


@pytest.mark.parametrize("known", [True, False])
def test_the_filter_that_knows_w_keeps_any_law_within_x_and_the_other_does_not(known, found, problem):
    rng = np.random.default_rng(3)
    filtered = Filtered(lambda x: np.ones((len(x), 1)), admissible_inputs(problem, P, W=found.W if known else None))
    states = stepped(problem, found.W, filtered, found.robust_set.set.sample(50, rng=rng), rng)
    low, high = problem.state_limits(P).bounding_box()
    kept = bool(((states >= low - 1e-7) & (states <= high + 1e-7)).all())
    assert kept == known
    assert filtered.counts.changed > 0
    assert not known or filtered.counts.helpless == 0


@pytest.mark.parametrize("unit", [1e200, 1e-200])
def test_the_set_of_a_log_in_extreme_units_is_the_same_set(problem, log, unit):
    given = DigitalTwin(problem.model).remembering(log).logs[0]
    own = disturbance_set(given, level=0.95)
    scaled = disturbance_set(replace(given, e_next=unit * given.e_next), level=0.95)
    directions = np.array([[1.0, 0.0], [0.0, -1.0], [1.0, 2.0]])
    np.testing.assert_allclose(scaled.support(directions) / unit, own.support(directions), rtol=1e-6)


# ── each limit with a probability ──

CART = np.array([[1.0, 0.1], [0.0, 0.95]]), np.array([[0.005], [0.1]])


def cart(unit):
    """A cart in units of its own, X = ±1 of them, and how it is stepped here."""
    x, u, w, p = (ca.SX.sym(name, size) for name, size in (("x", 2), ("u", 1), ("w", 2), ("p", 1)))
    after = unit * (ca.DM(CART[0]) @ (x / unit) + p * ca.DM(CART[1]) @ u) + w
    plant = Plant(x, u, w, p, after, DesignSpace(["p"], [0.5], [1.5]), dt=0.1, continuous=False)
    scale = np.array([unit, unit])
    return CoDesignProblem(
        discretise(plant), X=(-scale, scale), U=(-20, 20), objective=QuadraticObjective(np.eye(2) / unit**2, [[0.01]]),
        scenarios=FixedStart(0 * scale, Gaussian(0.02 * scale)), steps=20,
    )  # fmt: skip


def noise(kind, shape, rng):
    """Disturbances of a cart in its units: rare large ones to one side, normal ones, or ones that last."""
    if kind == "skewed":
        return 0.02 * (rng.exponential(size=(*shape, 2)) - 1)
    steps = 0.02 * rng.standard_normal((*shape, 2))
    if kind == "lasting":
        for k in range(1, shape[1]):
            steps[:, k] = 0.8 * steps[:, k - 1] + 0.6 * steps[:, k]
    return steps


def driven(controller, kind, seed, runs=30, steps=50, bound=1.0):
    """Positions (runs, steps) and their bound, on which the reference lies; stepped here."""
    rng = np.random.default_rng(seed)
    w, x = noise(kind, (runs, steps), rng), np.zeros((runs, 2))
    positions = np.zeros((runs, steps))
    for k in range(steps):
        u = controller(x * bound, x_ref=np.array([bound, 0.0]))
        x = x @ CART[0].T + u @ CART[1].T + w[:, k]
        positions[:, k] = x[:, 0]
    return positions[:, 20:]


def left(held):
    """Share of samples, and its standard error over runs."""
    shares = held.mean(axis=1)
    return shares.mean(), shares.std(ddof=1) / np.sqrt(len(shares))


@cache
def of_cart(kind, errors, unit=1.0, level=0.9):
    own, rng = cart(unit), np.random.default_rng(7)
    w = unit * noise(kind, (4, 1500), rng)
    log = deploy(own.model, saturated_lqr(own, [1.0]), [1.0], w, x0=np.zeros(2))
    return robust_mpc(own, [1.0], log, rng=rng, level=level, errors=errors, runs=2, horizon=8)


@pytest.mark.long
@pytest.mark.parametrize(("kind", "unit"), [("skewed", 1.0), ("lasting", 1e-4)])
def test_a_limit_that_is_driven_along_is_kept_as_asked_at_less_distance_than_by_a_tube(kind, unit):
    found = of_cart(kind, "quantiles", unit, level=0.98)
    laws = (
        linear_mpc(cart(unit), [1.0], horizon=8),
        found.controller,
        of_cart(kind, "set", unit, level=0.95).controller,
    )
    nominal, quantiles, tube = (driven(law, kind, 8, bound=unit) for law in laws)
    share, error = left(nominal > 1)
    assert share > 0.02 + 2 * error
    share, error = left(quantiles > 1)
    assert share <= 0.02 + 2 * error
    assert tube.mean() < quantiles.mean()
    assert "probability of each limit" in str(found)


def fresh(controller, kind, seed):
    """Errors (n, 2) that the loop of the tube gathers over eight fresh steps."""
    loop = CART[0] - CART[1] @ controller.tube_gain
    w, e = noise(kind, (4000, 9), np.random.default_rng(seed)), np.zeros((4000, 2))
    for k in range(1, 9):
        e = e @ loop.T + w[:, k]
    return e


@pytest.mark.parametrize("kind", ["skewed", "normal", "lasting"])
@pytest.mark.parametrize("errors", ["quantiles", "normal"])
def test_what_errors_gather_stays_within_its_room_as_often_as_asked(kind, errors):
    own = of_cart(kind, errors, level=0.98).controller
    H, h = own.state_rows
    outside = (fresh(own, kind, 9) @ H.T > h - own.bounds["state"][8]).mean(axis=0)
    if (kind, errors) == ("skewed", "normal"):
        assert outside.max() > 0.03  # rare large errors are none of a normal distribution
    else:
        assert (np.abs(outside - 0.02) < 0.015).all()


def test_the_room_of_normal_errors_is_that_of_their_covariance():
    for errors in ("quantiles", "normal"):
        own = of_cart("normal", errors).controller
        loop = CART[0] - CART[1] @ own.tube_gain
        gathered, expected = np.zeros((2, 2)), []
        for _ in range(8):
            gathered = loop @ gathered @ loop.T + 0.02**2 * np.eye(2)
            expected.append(1.2816 * np.sqrt(np.diag(own.state_rows[0] @ gathered @ own.state_rows[0].T)))
        np.testing.assert_allclose(own.state_rows[1] - own.bounds["state"][1:], expected, rtol=0.12)


def test_with_sensors_nothing_is_promised_of_states_that_a_log_does_not_hold():
    own = replace(cart(1.0), measurement=Measurement([[1.0, 0.0]], noise=[0.01]))
    law, rng, w = LinearFeedback([[1.0, 1.0]]), np.random.default_rng(0), np.zeros((2400, 2))
    log = deploy(own.model, law, [1.0], w, x0=[0, 0])
    for asked in (
        lambda: robust_mpc(own, [1.0], log, rng=rng),
        lambda: updated_problem(own, DigitalTwin(own.model).remembering(log)),
        lambda: switchback_on(own, own.model, law, law, [1.0], x0=[0, 0], disturbance=w, rng=rng),
        lambda: deploy_and_update(own, own.model, None, [1.0], x0=np.zeros((1, 2)), disturbance=w[None], rng=rng),
    ):
        with pytest.raises(InputError, match="one with sensors"):
            asked()


def test_a_log_too_short_for_the_horizon_is_named():
    own = cart(1.0)
    log = deploy(
        own.model, saturated_lqr(own, [1.0]), [1.0], noise("normal", (1, 60), np.random.default_rng(0)), x0=[0, 0]
    )
    with pytest.raises(InputError, match="7 stretches of 8 steps"):
        robust_mpc(own, [1.0], log, rng=np.random.default_rng(0), level=0.9, errors="quantiles", horizon=8)


@pytest.mark.parametrize(
    ("change", "error", "says"),
    [
        ({"errors": "all"}, InputError, "errors"),
        ({"horizon": 0}, InputError, "horizon"),
        ({"design": [2.0]}, InputError, "carried"),
        ({"level": 0.99999}, InputError, "at least"),
        ({"rng": 1}, InputError, "rng"),
        ({"problem": 1}, InputError, "problem"),
        ({"logs": []}, InputError, "logs"),
    ],
)
def test_wrong_calls_are_named(change, error, says, problem, log):
    given = {"problem": problem, "design": P, "logs": log, "rng": np.random.default_rng(0)} | change
    with pytest.raises(error, match=says):
        robust_mpc(given.pop("problem"), given.pop("design"), given.pop("logs"), **given)


def test_a_filter_for_errors_that_nothing_can_hold_is_refused(problem):
    with pytest.raises(InputError, match="no control invariant set"):
        admissible_inputs(problem, P, W=Polytope.from_bounds([-5, -5], [5, 5]))
    with pytest.raises(InfeasibleError, match="Shrink W"):
        linear_mpc(problem, P, W=Polytope.from_bounds([-5, -5], [5, 5]))


@pytest.mark.check
def test_a_small_sample_of_the_benchmark_finds_no_violation(capsys):
    from robust_mpc import main

    main(["dc_servo"], draws=500, leaves=20)
    row = next(line for line in capsys.readouterr().out.splitlines() if line.startswith("| dc_servo | 0."))
    cells = [cell.strip() for cell in row.strip("|").split("|")]
    assert cells[4] == "0; 0"
    assert cells[7] == "0"


@pytest.mark.long
@pytest.mark.filterwarnings("ignore:.*states lie outside X")
def test_a_start_without_a_plan_is_told_and_has_one_over_a_longer_horizon():
    # 1 m at 0.1 m/s and 0.1 s a sample takes a hundred samples
    x, u, w, p = ca.SX.sym("x", 2), ca.SX.sym("u"), ca.SX.sym("w"), ca.SX.sym("m")
    space = DesignSpace(["m"], [0.5], [2.0])
    plant = Plant(x, u, w, p, ca.vertcat(x[1], (u + w) / p), space, dt=0.1)
    far = CoDesignProblem(
        discretise(plant), X=([-0.1, -0.1], [1.1, 0.1]), U=(-1, 1), objective=QuadraticObjective(np.eye(2), [[0.1]]),
        scenarios=FixedStart([1.0, 0.0], Gaussian([0.02])), steps=40,
    )  # fmt: skip
    w = Gaussian([0.02]).sample(20, 40, np.random.default_rng(0))
    log = deploy(plant, linear_mpc(far, [1.0]), [1.0], w, x0=[1.0, 0.0])
    short, long = (
        robust_mpc(far, [1.0], log, rng=np.random.default_rng(0), level=0.9, runs=4, horizon=steps)
        for steps in (20, 150)
    )
    assert "starts that have a plan: 0.0%" in str(short)
    assert (short.planned, long.planned) == (0.0, 1.0)
    assert long.controller.solve([1.0, 0.0]).status is Status.SOLVED
