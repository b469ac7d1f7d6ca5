"""What an estimate says of its parameters: that it is a minimum, and what the data tell, in whatever units."""

import casadi as ca
import numpy as np
import pytest
from scipy.linalg import expm

from mpc import InputError
from mpc.optimal_control.estimation import EstimationStatus, Experiment, estimate_parameters

TIMES = np.linspace(0, 4, 21)
CONSTANT = {"dynamics": lambda x: 0 * x, "states": 1}


def seen_crudely(seed=0):
    """Log of p and of the response to (p - 1)², whose sensors are best explained by p on either side of 1."""
    noise = 0.5 * np.random.default_rng(seed).normal(size=(2, 21))
    return np.column_stack([1 + noise[0] - noise[0].mean(), 2 - 2 * np.exp(-TIMES) + noise[1]])


@pytest.mark.parametrize("guess", [None, [1.0], [1.1], [0.9]])
def test_a_maximum_between_two_minima_is_left(guess):
    y = seen_crudely()
    found = estimate_parameters(
        Experiment(TIMES, y, start=[0.0]), lambda x, p: -x + (p - 1) ** 2, lambda x, p: ca.vertcat(p, x), states=1,
        p_bounds=([-3], [5]), p_guess=guess, noise=[0.25, 0.25],
    )  # fmt: skip
    assert found.solved
    np.testing.assert_allclose(np.abs(found.p - 1), 1.10947, atol=1e-5)


def test_a_product_that_begins_at_zero_is_left_where_its_factors_have_no_bounds():
    """Its slopes vanish there, so that no solver moves: p1 (1 - exp(-p2 t))."""
    t, y = np.array([0, 1, 2, 3, 4, 5, 7]), np.array([np.nan, 8.3, 10.3, 19, 16, 15.6, 19.8])
    found = estimate_parameters(
        Experiment(t, y, start=[0.0]), output=lambda p, t: p[0] * (1 - ca.exp(-p[1] * t)),
        p_bounds=([None] * 2, [None] * 2), **CONSTANT,
    )  # fmt: skip
    assert found.solved
    np.testing.assert_allclose(found.residual_variance * found.degrees, 25.990267, rtol=1e-6)


def test_first_states_of_a_saddle_are_left():
    t = np.linspace(0, 6, 61)
    y = np.cos(0.8 * np.cos(1.3 * t)) + 0.01 * np.random.default_rng(0).normal(size=61)
    found = estimate_parameters(
        Experiment(t, y), lambda x, p: ca.vertcat(x[1], -p * x[0]), lambda x: ca.cos(x[0]), states=2,
        p_bounds=([0], [5]), noise=[1e-4],
    )  # fmt: skip
    assert found.solved
    np.testing.assert_allclose(found.p, 1.69, rtol=0.03)


def test_maxima_of_several_parameters_are_left_at_once():
    t = np.linspace(0, 3, 31)
    y = np.cos(t[:, None] * [1.3, 0.7]) + 0.05 * np.random.default_rng(0).normal(size=(31, 2))
    found = estimate_parameters(
        Experiment(t, y, start=[0.0]), output=lambda p, t: ca.cos(p * t), p_bounds=([-5] * 2, [5] * 2), p_guess=[0, 0],
        noise=[0.0025] * 2, **CONSTANT,
    )  # fmt: skip
    assert found.solved
    np.testing.assert_allclose(np.abs(found.p), [1.3, 0.7], atol=0.05)


def bent(*, beyond, deviation, apart=1e-3):
    """Log of a nearly straight course, whose unbounded fit has p2 = 0.5 - `beyond` deviations, each that large."""
    slopes = np.column_stack([TIMES, TIMES**2])
    noise = np.random.default_rng(0).normal(size=21)
    noise -= slopes @ np.linalg.lstsq(slopes, noise, rcond=None)[0]
    of_bend = np.sqrt(np.linalg.inv(slopes.T @ slopes)[1, 1]) * 2 / apart
    size, p2 = deviation / of_bend, 0.5 - beyond * deviation
    return slopes @ [2, apart * p2 / 2] + noise * size * np.sqrt(19) / np.linalg.norm(noise), size


@pytest.mark.parametrize("known", [True, False])
@pytest.mark.parametrize("unit", [1e-3, 1.0, 1e3])
@pytest.mark.parametrize("beyond", [1e-3, 0.5, 2.0])
def test_no_bound_tells_what_data_leave_open(beyond, unit, known):
    """Inside their bounds or at one that hardly pushes, such parameters were SOLVED with intervals of no width."""
    y, size = bent(beyond=beyond, deviation=100.0)
    found = estimate_parameters(
        Experiment(TIMES, unit * y, start=[0.0]), lambda p, t: unit * (p[0] + (1 + 1e-3 * t) * p[1]), lambda x: x,
        states=1, p_bounds=([-50, 0.5], [50, 9]), p_guess=[1, 1], noise=[(unit * size) ** 2] if known else None,
    )  # fmt: skip
    assert found.status is EstimationStatus.OPEN
    assert (found.deviations > 50).all()


@pytest.mark.parametrize("known", [True, False])
@pytest.mark.parametrize("unit", [1e-3, 1.0, 1e3])
@pytest.mark.parametrize("limit", ["p_bounds", "x_bounds"])
def test_a_limit_holds_a_parameter_where_it_pushes_by_more_than_the_noise_explains(limit, unit, known):
    rng, slope = np.random.default_rng(1), np.linalg.norm(TIMES)
    noise = 0.1 * rng.normal(size=21)
    best, spread = 2 + TIMES @ noise / slope**2, 0.1 / slope
    for beyond, holds in ((0.5, False), (3.0, True)):
        most = best - beyond * spread
        found = estimate_parameters(
            Experiment(TIMES, unit * (2 * TIMES + noise), start=[0.0]), lambda p: unit * p, lambda x: x, states=1,
            noise=[(0.1 * unit) ** 2] if known else None,
            **{"p_bounds": ([0], [9])} | {limit: ([0], [most if limit == "p_bounds" else 4 * unit * most])},
        )  # fmt: skip
        assert found.solved
        np.testing.assert_allclose(found.p, most, rtol=1e-6)
        expected = 0.0 if holds else spread if known else 10 * spread * np.sqrt(found.residual_variance) / unit
        np.testing.assert_allclose(found.deviations, expected, rtol=1e-4, atol=1e-12)


def test_a_bound_that_hardly_pushes_is_no_saddle_where_the_cost_curves_downwards():
    t, y = [0, 0.201, 0.676, 0.7, 1.779, 2.846, 2.859, 3.457], [np.nan, 4.832, 4.594, 4.444, 4.022, 3.405, 3.337, 2.956]
    found = estimate_parameters(
        Experiment(t, y, start=[5.0]), lambda x, p: -p[0] * x / (p[1] + x), lambda x: x, states=1,
        p_bounds=([0.953, 5.35], [2.854, 36.8]), noise=[0.003],
    )  # fmt: skip
    assert found.solved
    np.testing.assert_allclose(found.p[1], 5.35, rtol=1e-5)
    assert (found.deviations > 0.1 * found.p).all()


def test_growth_on_a_substrate_leaves_open_what_it_hardly_depends_on():
    """All deviations were 0 in 11 of 20 such logs, of parameters inside their bounds."""
    t = np.linspace(0, 4, 9)
    y = 100 * np.exp(0.39 * t) + 2 * np.random.default_rng(1).normal(size=9)

    def rates(x, p):
        growth = p[0] * x[1] / (p[1] + x[1]) * x[0]
        return ca.vertcat(growth, -growth / p[2])

    found = estimate_parameters(
        Experiment(t, y, start=[0.1, 50.0]), rates, lambda x: 1000 * x[0], states=2,
        p_bounds=([0.05, 0.05, 0.1], [2, 9, 1]), noise=[4.0],
    )  # fmt: skip
    assert found.status is EstimationStatus.OPEN
    assert (found.deviations > 1e-3).all()


@pytest.mark.parametrize("guess", [None, [1, 1e-6], [1, 100.0], [1, 1e6]])
@pytest.mark.parametrize("unit", [1e-9, 1.0, 1e9])
def test_an_offset_beside_a_steep_course_is_told_in_whatever_units(unit, guess):
    """It was called not told, its deviation infinite, without a guess of about its size."""
    t = np.linspace(0, 6, 60)
    y = np.exp(2 * t) + 1 + np.random.default_rng(0).normal(size=60)
    slopes = np.column_stack([t * np.exp(2 * t), np.ones(60), np.exp(2 * t)])
    found = estimate_parameters(
        Experiment(t, y), lambda x, p: p[0] * x, lambda x, p: x + unit * p[1], states=1,
        p_bounds=([None] * 2, [None] * 2), noise=[1.0], p_guess=None if guess is None else [guess[0], guess[1] / unit],
    )  # fmt: skip
    deviations = np.sqrt(np.diag(np.linalg.inv(slopes.T @ slopes)))[:2]
    np.testing.assert_allclose(found.deviations * [1, unit], deviations, rtol=1e-4)


def test_a_parameter_that_nothing_depends_on_takes_no_degree_of_freedom():
    y = 1 + 0.1 * np.random.default_rng(3).normal(size=6)
    for count in (1, 3, 5):
        found = estimate_parameters(
            Experiment(np.arange(6.0), y, start=[0.0]), output=lambda p: p[0], p_bounds=([0] * count, [5] * count),
            **CONSTANT,
        )  # fmt: skip
        assert found.degrees == 5
        np.testing.assert_allclose(found.deviations[0], y.std(ddof=1) / np.sqrt(6), rtol=1e-5)


def test_an_input_may_be_a_function_that_returns_one_number_a_time():
    given = {"dynamics": lambda x, u, p: -p * x + u, "output": lambda x: x, "states": 1, "p_bounds": ([0], [5])}
    y = np.exp(-TIMES)
    flat, column = (
        estimate_parameters(Experiment(TIMES, y, inputs=one), **given)
        for one in (np.sin, lambda times: np.sin(times)[:, None])
    )
    np.testing.assert_array_equal(flat.p, column.p)


@pytest.mark.parametrize(
    "inputs",
    [
        lambda times: np.zeros((2, len(times))), lambda times: 1.0, lambda times: np.full((len(times), 1), np.nan),
        lambda times: times[100],
    ],
)  # fmt: skip
def test_functions_that_return_no_inputs_are_named(inputs):
    with pytest.raises(InputError, match=r"^inputs: "):
        estimate_parameters(
            Experiment(TIMES, np.exp(-TIMES), inputs=inputs), lambda x, u, p: -p * x + u[0], lambda x: x, states=1,
            p_bounds=([0], [5]),
        )  # fmt: skip


def test_experiments_whose_functions_return_other_numbers_of_inputs_are_named():
    logs = [Experiment(TIMES, np.exp(-TIMES), inputs=lambda times, nu=nu: np.zeros((len(times), nu))) for nu in (1, 2)]
    with pytest.raises(InputError, match=r"^experiments: got \[1, 2\] inputs"):
        estimate_parameters(logs, lambda x, u, p: -p * x + u[0], lambda x: x, states=1, p_bounds=([0], [5]))


def test_a_guess_at_which_a_function_is_not_finite_is_called_p_guess():
    with pytest.raises(InputError, match=r"^p_guess: .*Give a `p_guess`"):
        estimate_parameters(
            Experiment(TIMES, np.exp(-TIMES)), lambda x, p: -x / p, lambda x: x, states=1, p_bounds=([None], [None])
        )


class Disturbed:
    """Linear plant dx/dt = A x + B u + w, y = x + noise, with logs of it and their likelihood by the Kalman filter."""

    def __init__(self, matrices, density, noise, truth, starts, samples, seed=0):
        self.matrices, self.density, self.noise, self.truth = matrices, density, np.atleast_2d(noise), np.array(truth)
        self.starts, nx = starts, len(noise)
        rng, self.logs = np.random.default_rng(seed), []
        for n, start in zip(samples, starts):
            t, u, x = np.sort(np.r_[0, rng.uniform(0, 0.25 * n, n)]), np.sign(rng.normal(size=n + 1)), [np.ones(nx)]
            x[0] = x[0] if start is None else np.array(start)
            for k in range(n):
                F, G, Q = self.step(self.truth, t[k + 1] - t[k])
                x.append(F @ x[-1] + G * u[k] + np.linalg.cholesky(Q) @ rng.normal(size=nx))
            y = np.array(x) + rng.normal(size=(n + 1, nx)) @ np.linalg.cholesky(self.noise).T
            y[rng.uniform(size=y.shape) < 0.1] = np.nan
            self.logs.append(Experiment(t, y, inputs=u, start=start))

    def step(self, p, h):
        """Exact transition, input and covariance over a time (Van Loan 1978)."""
        A, B = self.matrices(p)
        nx = len(A)
        whole = np.zeros((2 * nx + 1, 2 * nx + 1))
        whole[:nx, :nx], whole[:nx, nx:-1], whole[nx:-1, nx:-1] = -A, np.diag(self.density(p)), A.T
        turned = expm(whole * h)
        driven = np.zeros((nx + 1, nx + 1))
        driven[:nx, :nx], driven[:nx, nx] = A, B
        moved = expm(driven * h)
        Q = moved[:nx, :nx] @ turned[:nx, nx:-1]
        return moved[:nx, :nx], moved[:nx, nx], (Q + Q.T) / 2

    def unlikely(self, p):
        """Negative logarithm of the likelihood of p, but a constant; a free start may be anywhere."""
        total, eye = 0.0, np.eye(len(self.noise))
        for log, start in zip(self.logs, self.starts):
            x, P = (0 * eye[0], 1e7 * eye) if start is None else (np.array(start), 0 * eye)
            for k, y in enumerate(log.outputs):
                if k:
                    F, G, Q = self.step(p, log.times[k] - log.times[k - 1])
                    x, P = F @ x + G * log.inputs[k - 1, 0], F @ P @ F.T + Q
                seen = ~np.isnan(y)
                H, V = eye[seen], self.noise[np.ix_(seen, seen)]
                S, error = H @ P @ H.T + V, y[seen] - x[seen]
                gain = np.linalg.solve(S, H @ P).T
                total += (np.linalg.slogdet(S)[1] + error @ np.linalg.solve(S, error)) / 2
                x, rest = x + gain @ error, eye - gain @ H
                P = rest @ P @ rest.T + gain @ V @ gain.T
        return total

    def newton(self, p, deviations):
        """Step to the largest likelihood and its covariance, in deviations, by differences."""
        h, eye = 0.05, np.eye(len(p))
        at = lambda *ways: self.unlikely(p + h * deviations * sum(ways))  # noqa: E731
        slope = np.array([at(i) - at(-i) for i in eye]) / (2 * h)
        curvature = [[at(i, j) - at(i, -j) - at(-i, j) + at(-i, -j) for j in eye] for i in eye]
        covariance = np.linalg.inv(np.array(curvature) / (4 * h**2))
        return -covariance @ slope, covariance


FIRST_ORDER = {
    "dynamics": lambda x, u, w, p: -p[0] * x + p[1] * u + w, "disturbance": [0.3],
    "plant": (lambda p: (-p[:1, None], p[1:2]), lambda p: [0.3], [0.3], [0.8, 1.5]), "p_guess": [1, 1],
}  # fmt: skip
TANKS = {
    "dynamics": lambda x, u, w, p: ca.vertcat(-p[0] * x[0] + u + w[0], p[0] * x[0] - p[1] * x[1] + w[1]),
    "disturbance": [0.05, 0.02], "p_guess": [1, 1],
    "plant": (lambda p: (np.array([[-p[0], 0], [p[0], -p[1]]]), np.array([1.0, 0])), lambda p: [0.05, 0.02],
              [[0.02, 0.005], [0.005, 0.03]], [0.7, 0.4]),
}  # fmt: skip
LOUDNESS = {
    "dynamics": lambda x, u, w, p: -p[0] * x + u + p[1] * w, "disturbance": [1.0], "p_guess": [1, 1],
    "plant": (lambda p: (-p[:1, None], np.ones(1)), lambda p: [p[1] ** 2], [0.1], [0.8, 0.5]),
}  # fmt: skip


@pytest.mark.parametrize(
    ("case", "starts", "samples"),
    [
        (FIRST_ORDER, [None], [60]), (TANKS, [None, [0.0, 0.0]], [40, 20]),
        pytest.param(FIRST_ORDER, [None], [400], marks=pytest.mark.check),
        pytest.param(LOUDNESS, [None], [60], marks=pytest.mark.check),
    ],
)  # fmt: skip
def test_beside_a_disturbance_parameters_are_those_of_the_largest_kalman_likelihood(case, starts, samples):
    """The first rate was 0.45 instead of 0.8, a joint maximum, and its interval held the truth in 2.5 % of logs."""
    plant = Disturbed(*case["plant"], starts=starts, samples=samples)
    found = estimate_parameters(
        plant.logs, case["dynamics"], lambda x: x, states=len(plant.noise), p_bounds=([-5, 0], [9, 9]),
        p_guess=case["p_guess"], noise=plant.noise if len(plant.noise) > 1 else plant.noise[0],
        disturbance=case["disturbance"],
    )  # fmt: skip
    away, covariance = plant.newton(found.p, found.deviations)
    assert found.solved
    np.testing.assert_allclose(away, 0, atol=1e-3)
    np.testing.assert_allclose(np.diag(covariance), 1, rtol=5e-4)


def test_a_pair_that_is_not_told_apart_stays_beside_a_disturbance():
    plant = Disturbed(*FIRST_ORDER["plant"], starts=[None], samples=[60])
    given = {"output": lambda x: x, "states": 1, "noise": [0.3], "disturbance": [0.3]}
    whole, pair = (
        estimate_parameters(plant.logs, rate, p_bounds=([-5] + [0.1] * more, [9] * (1 + more)), **given)
        for rate, more in (
            (lambda x, u, w, p: -p[0] * x + p[1] * u + w, 1), (lambda x, u, w, p: -p[0] * x + p[1] * p[2] * u + w, 2),
        )
    )  # fmt: skip
    assert whole.solved
    assert [set(one) for one in pair.open] == [{"p2", "p3"}]
    np.testing.assert_allclose(pair.p[1] * pair.p[2], whole.p[1], rtol=1e-3)
    np.testing.assert_allclose(pair.deviations[0], whole.deviations[0], rtol=1e-3)


def test_a_bound_that_only_the_joint_maximum_reaches_is_left():
    plant = Disturbed(*FIRST_ORDER["plant"], starts=[None], samples=[60])
    given = {"dynamics": FIRST_ORDER["dynamics"], "output": lambda x: x, "states": 1, "noise": [0.3]}
    wide, narrow = (
        estimate_parameters(plant.logs, p_bounds=([low, 0], [9, 9]), disturbance=[0.3], **given) for low in (-5, 0.6)
    )
    assert wide.p[0] > 0.6
    np.testing.assert_allclose(narrow.p, wide.p, atol=0.01 * wide.deviations.max())
    np.testing.assert_allclose(narrow.deviations, wide.deviations, rtol=0.01)


@pytest.mark.long
def test_a_maximum_of_the_likelihood_over_all_courses_is_not_solved():
    # the disturbance is loudest at p2 = 0, where the joint cost is least and the likelihood a maximum of its logarithm
    rng, a, dt = np.random.default_rng(0), 0.8, 0.2
    u, x, gain = np.sign(rng.normal(size=(80, 1))), [1.0], 2 / (1 + 1.7**2)
    decay = np.exp(-a * dt)
    for k in range(79):
        loud = gain * np.sqrt((1 - decay**2) / (2 * a)) * rng.normal()
        x.append(decay * x[-1] + (1 - decay) / a * u[k, 0] + loud)
    sensor = 3 * rng.normal(size=80)
    y = np.column_stack([np.array(x) + 0.22 * rng.normal(size=80), sensor - sensor.mean() + 0.001])
    found = estimate_parameters(
        Experiment(dt * np.arange(80), y, inputs=u), lambda x, u, w, p: -p[0] * x + u + 2 / (1 + p[1] ** 2) * w,
        lambda x, p: ca.vertcat(x, p[1]), states=1, noise=[0.05, 9.0], disturbance=[1.0], p_bounds=([-5, -9], [9, 9]),
        p_guess=[0.8, 1.7],
    )  # fmt: skip
    assert not found.solved or abs(found.p[1]) > 0.5
