"""Random and recorded disturbances."""

import casadi as ca
import numpy as np
import pytest

from ccdtools import (
    CoDesignProblem,
    DesignSpace,
    FixedStart,
    Gaussian,
    InputError,
    Measurement,
    Plant,
    QuadraticObjective,
    Recorded,
    discretise,
)
from ccdtools.disturbances import Sum, Uniform
from ccdtools.vehicles import GeneratedRoad, ISORoad


def test_gaussian_noise_has_the_stated_moments_and_is_white(rng):
    w = Gaussian([0.1, 2.0], mean=[1.0, 0.0]).sample(200, 500, rng)
    assert w.shape == (200, 500, 2)
    np.testing.assert_allclose(w.std(axis=(0, 1)), [0.1, 2.0], rtol=0.01)
    np.testing.assert_allclose(w.mean(axis=(0, 1)), [1.0, 0.0], atol=0.03)
    assert abs(np.mean((w[:, 1:, 0] - 1) * (w[:, :-1, 0] - 1))) < 1e-4


def test_uniform_noise_fills_its_interval(rng):
    w = Uniform([-1.0, 3.0], [0.0, 3.0]).sample(50, 200, rng)
    assert w[..., 0].min() > -1
    assert w[..., 0].max() < 0
    assert w[..., 0].std() == pytest.approx(1 / np.sqrt(12), rel=0.02)
    assert (w[..., 1] == 3).all()


def test_independent_terms_add_their_variances(rng):
    w = Sum((Gaussian([0.3]), Uniform([-1.0], [1.0]))).sample(100, 500, rng)
    assert w.std() == pytest.approx(np.sqrt(0.3**2 + 1 / 3), rel=0.02)


def test_one_run_replays_a_recording_from_its_start(rng):
    w = Recorded(np.arange(10.0)).sample(1, 4, rng)
    np.testing.assert_array_equal(w[0, :, 0], [0, 1, 2, 3])


def test_several_runs_take_windows_of_a_recording(rng):
    w = Recorded(np.arange(10.0)).sample(500, 4, rng)
    np.testing.assert_array_equal(np.diff(w[..., 0], axis=1), 1)
    assert set(w[:, 0, 0]) == set(range(7))


def test_a_recording_is_copied(rng):
    signal = np.zeros(5)
    recorded = Recorded(signal)
    signal[:] = 1
    assert not recorded.sample(1, 5, rng).any()


@pytest.mark.parametrize("disturbance", [Gaussian([1.0]), Uniform([0.0], [1.0]), Recorded(np.arange(99.0))])
def test_the_generator_decides(disturbance):
    a, b, c = (disturbance.sample(3, 5, np.random.default_rng(seed)) for seed in (1, 1, 2))
    np.testing.assert_array_equal(a, b)
    assert not np.array_equal(a, c)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Gaussian([-1.0]), "std: got .* expected standard deviations ≥ 0"),
        (lambda: Gaussian([np.nan]), "std: got (nan|-?inf) at index"),
        (lambda: Uniform([1.0], [0.0]), "lower, upper: got .* expected lower ≤ upper"),
        (lambda: Uniform([0.0], [1.0, 2.0]), "upper: got shape"),
        (lambda: Recorded([1.0, np.nan]), "signal: got (nan|-?inf) at index"),
        (lambda: Recorded(np.zeros((2, 2, 2))), r"signal: got shape \(2, 2, 2\)"),
        (lambda: Recorded(np.zeros(3)).sample(1, 4, np.random.default_rng(0)), "steps: got 4, expected at most 3"),
    ],
)
def test_bad_disturbances_are_refused(make, message):
    with pytest.raises(InputError, match=message):
        make()


class Mine:
    gain = 1e-3

    def sample(self, runs, steps, rng):
        return self.gain * rng.standard_normal((runs, steps, 1))


class Gust(Gaussian):
    gain = 1e-3

    def sample(self, runs, steps, rng):
        return self.gain * super().sample(runs, steps, rng)


@pytest.mark.parametrize(("kind", "given"), [(Mine, ()), (Gust, ([1.0],))])
def test_moments_of_starts_follow_a_disturbance_that_changes_and_know_none(monkeypatch, kind, given):
    x, u, w = ca.SX.sym("x", 2), ca.SX.sym("u"), ca.SX.sym("w")
    rates = [x[1], -x[0] - 0.3 * x[1] + u]
    sensors = {"measurement": Measurement([[1.0, 0.0]], noise=[0.1]), "X": (-4, 4), "U": (-3, 3), "steps": 50}

    def stated(scenarios, *driven):
        plant = Plant(
            x, u, w if driven else None, None, [rates[0], rates[1] + sum(driven)], DesignSpace([], [], []), dt=0.33
        )
        return CoDesignProblem(
            discretise(plant), objective=QuadraticObjective(np.eye(2), [[0.1]]), scenarios=scenarios, **sensors
        )

    mine = FixedStart([1.0, 0.0], kind(*given))
    before = stated(mine, w).moments[2]
    monkeypatch.setattr(kind, "gain", 1.0)
    assert stated(mine, w).moments[2] == pytest.approx(1e6 * before)
    kept = FixedStart([1.0, 0.0], Gaussian([0.3]))
    assert stated(kept, w).moments[2] == stated(kept, w).moments[2] == pytest.approx(0.09, rel=0.02)
    assert stated(FixedStart([1.0, 0.0])).moments[2].shape == (0, 0)


@pytest.mark.parametrize("road", [ISORoad("C", dt=0.1), GeneratedRoad(dt=0.1)])
def test_roads_are_drawn_once_for_the_moments_of_a_problem(monkeypatch, road):
    drawn = []

    def sample(self, runs, steps, rng):
        drawn.append(runs)
        return rng.standard_normal((runs, steps, 1))

    monkeypatch.setattr(type(road), "sample", sample)
    x, u, w = ca.SX.sym("x", 2), ca.SX.sym("u"), ca.SX.sym("w")
    plant = Plant(x, u, w, None, [x[1], u + w - x[0]], DesignSpace([], [], []), dt=0.1)
    start = FixedStart([1.0, 0.0], Sum((road, Gaussian([0.1]))))
    one, other = (
        CoDesignProblem(
            discretise(plant), objective=QuadraticObjective(np.eye(2), [[0.1]]), scenarios=start, X=(-4, 4), U=(-3, 3),
            steps=20, measurement=Measurement([[1.0, 0.0]], noise=[0.1]),
        )
        for _ in range(2)
    )  # fmt: skip
    np.testing.assert_array_equal(one.moments[2], other.moments[2])
    assert drawn.count(max(drawn)) == 1
