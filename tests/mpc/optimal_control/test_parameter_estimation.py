"""Parameters from measurements, beside published optima, shooting by SciPy, and closed forms."""

import tracemalloc

import casadi as ca
import numpy as np
import pytest
from estimation_problems import LOTKA_VOLTERRA, PUBLISHED, lotka_volterra_log, lotka_volterra_with_product
from scipy.integrate import solve_ivp
from scipy.optimize import least_squares

from mpc import InputError
from mpc.optimal_control.estimation import EstimationStatus, Experiment, estimate_parameters

DECAY = {"dynamics": lambda x, p: -p * x, "output": lambda x: x, "states": 1, "p_bounds": ([0], [5])}


@pytest.mark.parametrize("name", PUBLISHED)
def test_published_optima(name):
    case = PUBLISHED[name]
    found = estimate_parameters(case.experiment, case.dynamics, case.output, **case.options)
    assert found.solved
    np.testing.assert_allclose(found.residual_variance * found.degrees, case.residuals, rtol=2e-5)
    np.testing.assert_allclose(found.p, case.p, rtol=5e-4)


class Swings:
    """Two swings of a pendulum with held inputs, correlated noise and gaps, and their fit by shooting."""

    noise = np.array([[4e-4, 1e-4], [1e-4, 9e-4]])

    def __init__(self):
        rng = np.random.default_rng(3)
        self.t = np.linspace(0, 5, 21)
        self.u = np.sign(np.sin(2 * self.t))[:, None]
        truth, starts = [1.3, 0.5], [[0.5, 0.0], [-1.0, 0.3]]
        root = np.linalg.cholesky(self.noise)
        self.outputs = [self.course(start, truth) + rng.normal(size=(21, 2)) @ root.T for start in starts]
        self.outputs[0][4, 0] = np.nan
        self.outputs[1][9] = np.nan
        self.first = np.concatenate([truth, *starts])

    def course(self, start, p):
        x = [start]
        for k in range(20):
            rates = lambda s, x, u=self.u[k, 0]: [x[1], -p[0] * np.sin(x[0]) - p[1] * x[1] + u]  # noqa: E731
            x.append(solve_ivp(rates, self.t[k : k + 2], x[-1], rtol=1e-11, atol=1e-12).y[:, -1])
        return np.array(x)

    def missed(self, v):
        rows = []
        for i, y in enumerate(self.outputs):
            for row in y - self.course(v[2 + 2 * i : 4 + 2 * i], v[:2]):
                seen = ~np.isnan(row)
                root = np.linalg.cholesky(self.noise[np.ix_(seen, seen)])
                rows.append(np.linalg.solve(root, row[seen]))
        return np.concatenate(rows)


@pytest.mark.long
def test_two_experiments_with_gaps_and_correlated_noise_are_fitted_as_by_shooting():
    swings = Swings()
    found = estimate_parameters(
        [Experiment(swings.t, y, inputs=swings.u) for y in swings.outputs],
        lambda x, u, p: ca.vertcat(x[1], -p[0] * ca.sin(x[0]) - p[1] * x[1] + u), lambda x: x, states=2,
        p_bounds=([0, 0], [5, 5]), noise=swings.noise, tolerance=1e-8,
    )  # fmt: skip
    shot = least_squares(swings.missed, swings.first, xtol=1e-14, ftol=1e-14, gtol=1e-12, jac="3-point")
    covariance = np.linalg.inv(shot.jac.T @ shot.jac)
    assert found.solved
    np.testing.assert_allclose(found.p, shot.x[:2], atol=1e-8)
    np.testing.assert_allclose(found.starts.ravel(), shot.x[2:], atol=1e-8)
    np.testing.assert_allclose(found.covariance, covariance[:2, :2], rtol=1e-6)
    np.testing.assert_allclose(found.start_deviations.ravel(), np.sqrt(np.diag(covariance))[2:], rtol=1e-6)
    assert found.degrees == 2 * 2 * 21 - 3 - 6
    assert np.isnan(found.residuals[1][9]).all()


def test_a_drift_is_told_from_random_walk_by_generalised_least_squares():
    rng, q, s2 = np.random.default_rng(1), 0.3, 0.04
    t = np.sort(np.r_[0, rng.uniform(0, 4, 14)])
    walk = np.r_[0, np.cumsum(rng.normal(size=14) * np.sqrt(q * np.diff(t)))]
    y = 1 + 0.7 * t + walk + np.sqrt(s2) * rng.normal(size=15)
    statement = {"states": 1, "p_bounds": ([-5], [5]), "noise": [s2], "disturbance": [q]}
    found = estimate_parameters(Experiment(t, y), lambda x, p, w: p + w, lambda x: x, **statement)
    X, S = np.c_[t, np.ones(15)], s2 * np.eye(15) + q * np.minimum(t[:, None], t)
    covariance = np.linalg.inv(X.T @ np.linalg.solve(S, X))
    np.testing.assert_allclose(found.p[0], (covariance @ X.T @ np.linalg.solve(S, y))[0], rtol=1e-8)
    np.testing.assert_allclose(found.covariance[0, 0], covariance[0, 0], rtol=1e-8)


@pytest.mark.parametrize("unit", [1e-6, 1.0, 1e6])
def test_units_change_nothing_but_units(unit):
    t = np.linspace(0, 2, 15)
    y = np.exp(-1.4 * t) + 0.01 * np.random.default_rng(0).normal(size=15)
    plain = estimate_parameters(Experiment(t, y), **DECAY)
    other = estimate_parameters(Experiment(t, y * unit), **DECAY)
    np.testing.assert_allclose(other.p, plain.p, rtol=1e-7)
    np.testing.assert_allclose(other.intervals(), plain.intervals(), rtol=1e-5)
    np.testing.assert_allclose(other.starts, plain.starts * unit, rtol=1e-7)


@pytest.mark.parametrize(
    ("unit", "offset", "ramp"), [(1e-6, 0, 0), (1e-2, 0, 0), (1e4, 0, 0), (1.0, 5.3e6, 0), (1.0, 0, 1e4)]
)
def test_small_outputs_tell_a_frequency_as_large_ones_do(unit, offset, ramp):
    """It was 20.8, OPEN, from outputs of 0.1 and less, of a northing, and beside a known ramp."""
    t = np.linspace(0, 6, 41)
    y = np.cos(2 * t) + 0.02 * np.random.default_rng(0).normal(size=41)
    shot = least_squares(lambda z: z[1] * np.cos(z[0] * t) + z[2] * np.sin(z[0] * t) - y, [2.0, 1.0, 0.0])
    spring = {"states": 2, "p_bounds": ([0], [50])}
    found = estimate_parameters(
        Experiment(t, unit * y + offset + ramp * t),
        lambda x, p: ca.vertcat(x[1], -p * x[0]),
        lambda x, t: x[0] + offset + ramp * t,
        **spring,
    )
    assert found.solved
    np.testing.assert_allclose(found.p, shot.x[:1] ** 2, rtol=1e-5)
    np.testing.assert_allclose(found.residual_variance, unit**2 * 2 * shot.cost / 38, rtol=1e-4)


def test_intervals_are_students_where_the_noise_is_estimated():
    from scipy.stats import norm, t

    log = lotka_volterra_log(0)
    known = estimate_parameters(log, **LOTKA_VOLTERRA.statement, noise=[1.0, 1.0])
    fitted = estimate_parameters(log, **LOTKA_VOLTERRA.statement)
    np.testing.assert_allclose(fitted.deviations, known.deviations * np.sqrt(fitted.residual_variance), rtol=1e-5)
    np.testing.assert_allclose(known.residual_variance, fitted.residual_variance, rtol=1e-6)
    for found, factor in ((known, norm.ppf(0.95)), (fitted, t.ppf(0.95, 2 * 31 - 4 - 2))):
        np.testing.assert_allclose(np.diff(found.intervals(0.9))[:, 0], 2 * factor * found.deviations, rtol=1e-9)


def test_a_parameter_that_is_held_or_at_its_bound_has_no_spread():
    t = np.linspace(0, 2, 15)
    y = np.exp(-1.4 * t) + 0.01 * np.random.default_rng(0).normal(size=15)
    held = estimate_parameters(Experiment(t, y), **(DECAY | {"p_bounds": ([1.2], [1.2])}))
    stopped = estimate_parameters(Experiment(t, y), **(DECAY | {"p_bounds": ([0], [1.2])}))
    for found in (held, stopped):
        assert found.solved
        np.testing.assert_allclose(found.p, 1.2, atol=1e-7)
        assert found.deviations[0] == 0
    np.testing.assert_allclose(held.start_deviations, stopped.start_deviations, rtol=1e-4)


@pytest.mark.parametrize("slower", [1.0, 1e4, 1e6])
def test_a_parameter_within_wide_bounds_keeps_its_spread(slower):
    t = np.linspace(0, 2, 15)
    y = np.exp(-1.4 * t) + 0.01 * np.random.default_rng(0).normal(size=15)
    shot = least_squares(lambda z: z[1] * np.exp(-z[0] * t) - y, [1.0, 1.0], xtol=1e-14, ftol=1e-14, gtol=1e-14)
    covariance = np.linalg.inv(shot.jac.T @ shot.jac) * 2 * shot.cost / 13
    found = estimate_parameters(Experiment(slower * t, y), **(DECAY | {"p_guess": [1 / slower]}))
    assert found.solved
    np.testing.assert_allclose(found.p * slower, shot.x[:1], rtol=1e-5)
    np.testing.assert_allclose(found.deviations * slower, np.sqrt(covariance[0, 0]), rtol=1e-4)


def test_outputs_that_are_nothing_but_zero_leave_a_rate_open():
    found = estimate_parameters(Experiment([0, 1, 2], [0, 0, 0]), **DECAY)
    assert found.status is EstimationStatus.OPEN
    assert np.isinf(found.deviations).all()
    assert [set(one) for one in found.open] == [{"p1"}]


def test_outputs_that_are_constant_but_for_rounding_are_fitted():
    found = estimate_parameters(
        Experiment(np.linspace(0, 2, 41), np.full(41, 0.1)), **(DECAY | {"p_bounds": ([0.2], [5])})
    )
    assert found.solved
    np.testing.assert_allclose(found.p, 0.2, rtol=1e-6)


def test_a_pair_that_the_data_cannot_tell_apart_is_named_and_nothing_else():
    found = estimate_parameters(lotka_volterra_log(1), **lotka_volterra_with_product(), noise=[1.0, 1.0])
    assert found.status is EstimationStatus.OPEN
    assert [set(one) for one in found.open] == [{"p2", "p5"}]
    assert np.isinf(found.deviations[[1, 4]]).all()
    assert np.isfinite(found.deviations[[0, 2, 3]]).all()
    assert "p2" in found.advice


@pytest.mark.parametrize(("share", "tells"), [(0.5, True), (2.0, False)])
def test_a_parameter_is_open_where_its_deviation_is_larger_than_itself(share, tells):
    t = np.linspace(0, 1, 21)
    noise = share * np.sqrt(np.sum(t**2))
    statement = {"states": 1, "p_bounds": ([-50], [50]), "p_guess": [1.0], "noise": [noise**2]}
    found = estimate_parameters(Experiment(t, 1.0 * t, start=[0.0]), lambda p: p, lambda x: x, **statement)
    np.testing.assert_allclose(found.deviations, [share], rtol=1e-6)
    assert found.solved is tells


@pytest.mark.parametrize(("apart", "told"), [(1e-6, True), (1e-7, False)])
def test_parameters_that_differ_by_rounding_alone_are_not_told_apart(apart, told):
    t = np.linspace(0, 1, 21)
    y = 2 * t + 1e-3 * np.sin(9 * t)
    statement = {"states": 1, "p_bounds": ([-50] * 2, [50] * 2), "p_guess": [1, 1], "noise": [1e-6]}
    rates = lambda t, p: p[0] + (1 + apart * t) * p[1]  # noqa: E731
    found = estimate_parameters(Experiment(t, y, start=[0.0]), rates, lambda x: x, **statement)
    assert np.isfinite(found.deviations).all() == told


@pytest.mark.parametrize(("weight", "named"), [(0.3, {"p1", "p2", "p3"}), (0.03, {"p1", "p2"})])
def test_parameters_of_a_small_share_are_not_named(weight, named):
    t = np.linspace(0, 1, 21)
    statement = {"states": 1, "p_bounds": ([-9] * 3, [9] * 3), "p_guess": [1, 1, 1], "noise": [1e-4]}
    rates = lambda t, p: p[0] + p[1] + (p[2] + weight * p[0]) * t  # noqa: E731
    found = estimate_parameters(Experiment(t, 2 * t + t**2 / 2, start=[0.0]), rates, lambda x: x, **statement)
    assert [set(one) for one in found.open] == [named]


def test_no_optimum_has_no_intervals():
    found = estimate_parameters(
        Experiment([0, 1, 2], [1, 0.5, 0.2], start=[5.0]), **(DECAY | {"p_bounds": ([1], [5])}), x_bounds=([4.9], [6])
    )
    assert found.status is EstimationStatus.UNSOLVED
    assert np.isnan(found.intervals()).all()


WRONG = [
    ({"times": [0, 1], "outputs": [1, np.nan]}, "experiments"),
    ({"times": [0, 1], "outputs": [1, 0.5]}, "experiments"),
    ({"times": [0, np.nan], "outputs": [1, 2]}, "times"),
    ({"times": [0, 0], "outputs": [1, 2]}, "times"),
    ({"times": [0, 1], "outputs": [np.nan] * 2}, "outputs"),
    ({"times": [0, 1], "outputs": [1, np.inf]}, "outputs"),
    ({"times": [0, 1, 2], "outputs": [1, 2, 3], "inputs": [1, np.nan, 1]}, "inputs"),
    ({"times": [0, 1, 2], "outputs": [1, 2, 3], "inputs": [1, 2]}, "inputs"),
    ({"times": [0, 1, 2], "outputs": [1, 2, 3], "guess": [1, 2, 3]}, "guess"),
]


@pytest.mark.parametrize(("data", "name"), WRONG)
def test_wrong_data_are_named(data, name):
    with pytest.raises(InputError, match=f"^{name}: "):
        estimate_parameters(Experiment(**data), **DECAY)


@pytest.mark.parametrize(
    ("wrong", "name"),
    [
        ({"noise": [0.0]}, "noise"), ({"noise": [1.0, 1.0]}, "noise"), ({"noise": "loud"}, "noise"),
        ({"disturbance": [1.0]}, "noise"), ({"states": 0}, "states"), ({"p_guess": [1, 2]}, "p_guess"),
        ({"p_guess": [5.1]}, "^p_guess: .*within p_bounds"), ({"noise": [-1.0]}, "^noise: .*variances > 0"),
        ({"tolerence": 1e-6}, "^options: .*mean tolerance"), ({"p_bound": 3}, "^options: .*mean p_bounds"),
        ({"x_bound": 3}, "^options: .*mean x_bounds"),
        ({"p_bounds": ([2], [1])}, "p_bounds"), ({"output": lambda x: ca.vertcat(x, x)}, "output"),
        ({"dynamics": lambda x, q: -q * x}, "dynamics"), ({"noise": [1.0], "disturbance": [1.0]}, "dynamics"),
    ],
)  # fmt: skip
def test_wrong_statements_are_named(wrong, name):
    with pytest.raises(InputError, match=name):
        estimate_parameters(Experiment([0, 1, 2], [1, 0.5, 0.2]), **(DECAY | wrong))


@pytest.mark.long
def test_memory_grows_in_proportion_to_the_samples_of_a_disturbed_course():
    most = []
    for samples in (100, 400):
        times, rng = np.linspace(0, samples / 20, samples), np.random.default_rng(0)
        log = Experiment(times, np.exp(-0.3 * times) + 0.01 * rng.normal(size=samples))
        tracemalloc.start()
        estimate_parameters(log, **DECAY | {"dynamics": lambda x, w, p: w - p * x}, noise=[1e-4], disturbance=[1e-4],
                            rounds=1)  # fmt: skip
        most.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
    assert most[1] <= 6 * most[0]
