"""A damper that is set between two bounds: the plant, the laws of engineers beside it, and the study."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.linalg import expm, solve_discrete_are

from ccdtools import InputError, Scenario, baselines, discretise, saturated_lqr
from ccdtools.plants.library import QuarterCar, quarter_car
from ccdtools.studies import load_study
from ccdtools.vehicles import RealStrut, SemiActive, clipped_lqr, comfort

DESIGN = np.array([20000.0, 3000.0])


@pytest.fixture(scope="module")
def study():
    return load_study("semi_active_damper")


@pytest.mark.parametrize("u", [-1.0, 0.0, 0.3, 1.0])
def test_the_plant_is_the_passive_car_with_the_damping_that_is_set(u):
    x = np.random.default_rng(0).normal(size=4)
    set_ = quarter_car(semi_active=True).right_hand_side(x, [u], [0.2], DESIGN)
    passive = quarter_car().right_hand_side(x, [0.0], [0.2], [DESIGN[0], DESIGN[1] * (0.55 + 0.45 * u)])
    np.testing.assert_allclose(np.array(set_), np.array(passive), rtol=1e-12)


def test_bump_stops_push_back_beyond_their_clearance_alone():
    strut = {"hardening": 0.0, "asymmetry": 0.0, "clearance": 0.04}
    cars = [quarter_car(nonlinear=True, strut=RealStrut(**strut, stop=stop)) for stop in (0.0, 2e5)]
    pushed = []
    for travel in (0.0, 0.02, 0.08, -0.08):
        free, stopped = (np.array(car.right_hand_side([0, 0, travel, 0], [0], [0], DESIGN)) for car in cars)
        pushed.append(-QuarterCar().sprung * (stopped - free)[3, 0])
    squeezed = 2e5 * 0.04**2 / (0.04 + 0.008)
    np.testing.assert_allclose(pushed, [0.0, 0.0, squeezed, -squeezed], rtol=1e-9)


def test_a_damper_that_is_set_has_no_actuator_whose_lag_could_be_meant():
    with pytest.raises(InputError, match="semi_active, actuator_lag"):
        quarter_car(semi_active=True, actuator_lag=True)


def test_the_force_is_the_demanded_one_where_the_damper_can_give_it_and_else_the_nearest():
    law = SemiActive([3.0, -2000.0, 50.0, 1500.0], 3000.0)
    x = np.random.default_rng(0).normal(size=(200, 4))
    rate, demanded = x[:, 3] - x[:, 1], -x @ law.F
    given = -3000.0 * (0.55 + 0.45 * law(x)[:, 0]) * rate
    ends = np.sort(np.stack([-300.0 * rate, -3000.0 * rate]), axis=0)
    np.testing.assert_allclose(given, np.clip(demanded, *ends), rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(law(np.zeros(4)), [0.0], atol=1e-12)


@pytest.mark.parametrize("frequency", [3.15, 8.0, 20.0])
def test_the_felt_acceleration_of_the_study_is_that_of_the_standard(study, frequency):
    time = 1e-3 * np.arange(20_000)
    felt = comfort(np.sin(2 * np.pi * frequency * time), 1e-3)
    slopes = np.array([study.plant.right_hand_side(x, [0], [0], DESIGN) for x in np.eye(6)])[:, :, 0].T
    column = slopes[4:, :4] @ np.linalg.pinv(slopes[3:4, :4])  # of the filter's rates, by the body's acceleration
    s = 2j * np.pi * frequency
    response = np.linalg.solve(s * np.eye(2) - slopes[4:, 4:], column)[0, 0]
    assert abs(response) / 2**0.5 == pytest.approx(felt, rel=0.06)


@pytest.mark.parametrize(("car", "dt"), [(QuarterCar(), 0.01), (QuarterCar(sprung=300.0, tyre=1.5e5), 0.02)])
def test_clipped_lqr_demands_what_lqr_of_an_actuator_in_the_place_of_the_damper_does(study, car, dt):
    k = DESIGN[0]
    A = np.array([[0, 1, 0, 0], [-car.tyre / car.unsprung, 0, k / car.unsprung, 0], [0, -1, 0, 1],
                  [0, 0, -k / car.sprung, 0]])  # fmt: skip
    B = np.array([[0], [-1 / car.unsprung], [0], [1 / car.sprung]])
    both = expm(dt * np.block([[A, B], [np.zeros((1, 5))]]))[:4]
    A, B = both[:, :4], both[:, 4:]
    row = np.array([0, 0, -k / car.sprung, 0])  # body acceleration, 1 m/s² of which is tolerable
    Q = np.outer(row, row) + np.diag([4e4, 0, 400, 0])
    S, R = row[:, None] / car.sprung, np.array([[car.sprung**-2]])
    P = solve_discrete_are(A, B, Q, R, s=S)
    K = np.linalg.solve(R + B.T @ P @ B, B.T @ P @ A + S.T)
    model = discretise(quarter_car(semi_active=True, car=car, dt=dt))
    linear = SimpleNamespace(model=model)
    law = clipped_lqr(lambda design: (Q, R, S))(linear, DESIGN)
    np.testing.assert_allclose(law.F, K[0], rtol=1e-6, atol=1e-6 * np.abs(K).max())


@pytest.mark.check
def test_laws_of_the_field_gain_what_lqr_of_the_tangent_cannot(study):
    problem = study.problem()
    x0, w = problem.scenarios.sample(20, 300, np.random.default_rng(1))
    scenario = Scenario(problem.model, x0, w)
    laws = {name: law(problem, study.p0) for name, law in study.laws.items()} | {
        "LQR": saturated_lqr(problem, study.p0)
    }
    mean = {name: scenario.run(law, design=study.p0).returns(problem.objective).mean() for name, law in laws.items()}
    for tuned in ("skyhook", "clipped LQR, tuned"):
        assert mean["LQR"] < 1.1 * mean[tuned]
        assert mean["clipped LQR"] < 1.03 * mean[tuned]  # it knows nothing of the stops


@pytest.mark.long
def test_a_pid_is_tuned_where_no_input_pushes_a_state_at_rest(study):
    short = replace(study.problem(), steps=40)
    found = baselines(short, study.p0, rng=np.random.default_rng(0))["PID"]
    assert all(np.isfinite(getattr(found, name)).all() for name in ("kp", "ki", "kd"))


@pytest.mark.parametrize("laws", [{"LQR": len}, {"mine": 3}, {3: len}, [len]])
def test_wrong_laws_are_named(study, laws):
    with pytest.raises(InputError, match="laws"):
        replace(study, laws=laws)
