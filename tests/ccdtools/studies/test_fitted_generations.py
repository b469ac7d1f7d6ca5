"""Generations whose logs hold outputs, or states, and inputs."""

from dataclasses import replace

import casadi as ca
import numpy as np
import pytest
from small_plants import clone_of

from ccdtools import (
    CoDesignConfig,
    CoDesignProblem,
    DesignSpace,
    FixedStart,
    Gaussian,
    InputError,
    Learned,
    Measurement,
    Nested,
    OutputLimits,
    Plant,
    QuadraticObjective,
    RealPlant,
    Recorded,
    Scenario,
    discretise,
)
from ccdtools.studies import fitted_generations

BOX = DesignSpace(["k"], [0.5], [4.0], ["N/m"])


def spring(gain=1.0):
    """Mass on a spring, with an actuator that may be weaker than its data sheet says."""
    x, u, w, k = ca.SX.sym("x", 2), ca.SX.sym("u"), ca.SX.sym("w"), ca.SX.sym("k")
    return Plant(x, u, w, k, [x[1], -k * x[0] - 0.3 * x[1] + gain * u + w], BOX, dt=0.33)


def stated(**changes):
    """Problem whose position is measured."""
    given = {
        "X": (-4, 4), "U": (-3, 3), "steps": 50, "limit_tolerance": "off",
        "objective": QuadraticObjective(np.eye(2), [[0.1]], design_cost=lambda p: 2 * p[0]),
        "scenarios": FixedStart([1.0, 0.0], Gaussian([0.3])), "measurement": Measurement([[1.0, 0.0]], noise=[0.1]),
    }  # fmt: skip
    return CoDesignProblem(discretise(spring()), **(given | changes))


def real(gain):
    return RealPlant(spring(gain), Gaussian([0.3]), [1.0, 0.0], 40, 50)


def run(problem, gain, method=None, seed=0, **options):
    method = Nested("lqg", starts=1) if method is None else method
    return fitted_generations(problem, real(gain), method=method, rng=np.random.default_rng(seed), **options)


def returned(one, runs=1500):
    """Returns of a generation on the real plant, on runs of this test's own."""
    w = Gaussian([0.3]).sample(runs, 50, np.random.default_rng(77))
    scenario = Scenario(spring(0.5), [1.0, 0.0], w, output=stated().measurement, seed=5)
    return scenario.run(one.controller, design=one.design).returns(stated().objective)


@pytest.mark.long
def test_a_second_generation_on_outputs_earns_what_it_says():
    first, second = run(stated(), 0.5, seed=2)
    assert first.fit is None
    assert first.accepted
    assert first.gain is None
    assert second.accepted
    assert second.fit.status.name == "SOLVED"
    assert second.predicted.ci95[0] > 0
    gain = returned(second) - returned(first)
    error = 3 * gain.std() / len(gain) ** 0.5
    assert second.gain.ci95[0] - error < gain.mean() < second.gain.ci95[1] + error
    assert gain.mean() > 5 * error
    assert second.log.outputs.shape == (40, 50, 1)
    assert "measured +" in str(second)


@pytest.mark.long
def test_the_same_seed_is_the_same_run_and_fits_take_all_logs():
    one, other = (run(stated(), 0.5, generations=count, draws=4) for count in (3, 2))
    for mine, its in zip(one, other):
        np.testing.assert_array_equal(mine.log.outputs, its.log.outputs)
        np.testing.assert_array_equal(mine.design, its.design)
    assert one[2].fit.deviations[2] < 0.9 * one[1].fit.deviations[2]


@pytest.mark.long
def test_a_redesign_for_a_plant_that_the_log_leaves_open_serves_where_the_real_plant_shows_it_better():
    x, u, w, p = ca.SX.sym("x", 2), ca.SX.sym("u"), ca.SX.sym("w"), ca.SX.sym("p", 3)
    space = DesignSpace(["k", "one", "other"], [0.5, 0.3, 0.3], [4, 2, 2])
    rates = [x[1], -p[0] * x[0] - 0.3 * x[1] + p[1] * p[2] * u + w]  # their product is told, each is not
    first, second = run(stated(), 0.5, plant=Plant(x, u, w, p, rates, space, dt=0.33))
    assert second.fit.status.name == "OPEN"
    assert second.gain.ci95[0] > 0
    assert second.accepted
    gain = returned(second) - returned(first)
    assert gain.mean() > 5 * gain.std() / len(gain) ** 0.5
    assert "Open: " in str(second)


def gauged(gauge=1.0, names=()):
    """The spring with a gauge of its position; with `names` in its design their product is what it shows."""
    x, u, w, p = ca.SX.sym("x", 2), ca.SX.sym("u"), ca.SX.sym("w"), ca.SX.sym("p", 1 + len(names))
    space = DesignSpace(["k", *names], [0.5] + [0.3] * len(names), [4.0] + [2.0] * len(names))
    shown = p[1] * p[2] if names else gauge
    return Plant(x, u, w, p, [x[1], -p[0] * x[0] - 0.3 * x[1] + u + w], space, dt=0.33, outputs=[shown * x[0]])


@pytest.mark.long
def test_a_redesign_that_leaves_limits_further_on_the_real_plant_is_taken_back_and_says_which():
    """For a weaker actuator more is asked of it, beyond 0.9 N in 3 in place of 2 of 100 samples."""
    tight = {"output_limits": OutputLimits(lambda x, u, p: u, -0.9, 0.9), "limit_tolerance": (0.0, 0.0)}
    _, second = run(stated(**tight), 0.5, seed=2)
    assert second.gain.ci95[0] > 0
    assert not second.accepted
    assert "y1" in second.violation.exceeded
    assert "taken back" in str(second)
    assert str(second.violation) in str(second)


@pytest.mark.check
def test_the_former_law_behind_the_filter_of_what_logs_tell_serves_where_a_redesign_is_no_better():
    costs = QuadraticObjective(np.diag([20.0, 1.0]), [[0.01]], design_cost=lambda p: 200 * p[0])  # k stays least
    problem = stated(objective=costs, measurement=Measurement(gauged(), noise=[0.05]))
    elsewhere = replace(real(1.0), plant=gauged(0.5))
    first, second = fitted_generations(
        problem, elsewhere, method=Nested("lqg", starts=1), plant=gauged(names=("one", "other")),
        rng=np.random.default_rng(0),
    )  # fmt: skip
    assert second.fit.status.name == "OPEN"
    assert np.prod(second.fit.values[:2]) == pytest.approx(0.5, abs=0.03)
    assert not second.accepted
    assert second.controller.controller is first.controller.controller
    assert "filter of the fit measured +" in str(second)
    w = Gaussian([0.3]).sample(1500, 50, np.random.default_rng(77))
    fresh = Scenario(elsewhere.plant, [1.0, 0.0], w, output=replace(problem.measurement, output=gauged(0.5)), seed=5)
    before, after = (fresh.run(one.controller, design=one.design).returns(costs) for one in (first, second))
    assert second.update.mean == pytest.approx((after - before).mean(), rel=0.25)
    assert second.update.ci95[0] > 0


@pytest.mark.long
def test_a_plant_that_is_as_modelled_is_not_made_worse():
    first, second = run(stated(), 1.0, draws=4)
    w = Gaussian([0.3]).sample(1500, 50, np.random.default_rng(77))
    runs = Scenario(spring(1.0), [1.0, 0.0], w, output=stated().measurement, seed=5)
    before, after = (runs.run(one.controller, design=one.design).returns(stated().objective) for one in (first, second))
    assert (after - before).mean() > -0.005 * abs(before.mean())


@pytest.mark.check
def test_mpc_and_a_policy_of_outputs_are_redesigned_too():
    config = CoDesignConfig(iterations=25, starts=1, pathwise_runs=128, evaluation_runs=256)
    for method in (Nested("mpc", starts=1, evaluations=6), Learned(history=6, config=config)):
        _, second = run(stated(), 0.5, method, noise="known")
        assert second.fit.status.name == "SOLVED"
        assert second.accepted, str(second)
        assert second.gain.ci95[0] > 0


def wide():
    """The spring with an actuator whose gain is unknown."""
    x, u, w, p = ca.SX.sym("x", 2), ca.SX.sym("u"), ca.SX.sym("w"), ca.SX.sym("p", 2)
    space = DesignSpace(["k", "gain"], [0.5, 0.2], [4, 2])
    return Plant(x, u, w, p, [x[1], -p[0] * x[0] - 0.3 * x[1] + p[1] * u + w], space, dt=0.33)


@pytest.mark.long
@pytest.mark.parametrize("method", ["nested", Nested("mpc", starts=1, evaluations=6)])
def test_where_states_are_seen_the_model_of_any_method_is_the_one_that_they_tell(method):
    problem = replace(stated(), measurement=None)
    first, second = run(problem, 0.5, method, plant=wide())
    assert second.fit.values[0] == pytest.approx(0.5, abs=0.05)
    assert second.accepted
    assert second.gain.ci95[0] > 0
    assert first.log.outputs is None


@pytest.mark.long
@pytest.mark.parametrize("held_out", [None, {"calm": Gaussian([0.1])}, {"calm": Gaussian([1e200])}])
def test_a_redesign_that_costs_more_on_a_held_out_drive_is_taken_back(held_out):
    """A weak actuator asks for a stiff spring, which costs the same where nothing pushes; lost runs tell nothing."""
    costs = QuadraticObjective(np.eye(2), [[0.1]], design_cost=lambda p: p[0] ** 2)
    start = FixedStart([0.0, 0.0], Gaussian([0.7]))
    elsewhere = RealPlant(spring(0.4), start.disturbance, start.x0, 40, 50, held_out=held_out)
    first, second = fitted_generations(
        stated(objective=costs, scenarios=start, measurement=None), elsewhere, method=Nested("lqr", starts=1),
        plant=wide(), rng=np.random.default_rng(2),
    )  # fmt: skip
    assert second.gain.ci95[0] > 0
    assert second.accepted == (held_out is None)
    assert list(second.elsewhere) == list(held_out or {})
    if held_out:
        assert not second.elsewhere["calm"].ci95[1] >= 0
        assert "taken back" in str(second)
        assert "on calm " in str(second)
        np.testing.assert_array_equal(second.design, first.design)


@pytest.mark.parametrize(
    ("drive", "held_out", "name"),
    [
        (Gaussian([0.7]), {"ride": Recorded(np.zeros((30, 1)))}, r"held_out\['ride'\]"),
        (Recorded(np.zeros((30, 1))), None, "disturbance"),
    ],
)
def test_a_recording_that_is_shorter_than_a_deployment_is_refused_first(drive, held_out, name):
    real = RealPlant(spring(0.4), drive, [0.0, 0.0], 40, 50, held_out=held_out)
    with pytest.raises(InputError, match=rf"real.{name}: steps: got 50, expected at most 30"):
        fitted_generations(replace(stated(), measurement=None), real, method="nested", rng=np.random.default_rng(2))


def test_plants_that_no_generation_would_meet_are_refused():
    real = RealPlant(spring(0.4), Gaussian([0.7]), [0.0, 0.0], 40, 50)
    with pytest.raises(InputError, match=r"real\.later"):
        fitted_generations(stated(), replace(real, later=[real]), rng=np.random.default_rng(2))


@pytest.mark.check
def test_a_learned_policy_goes_on_from_the_one_in_service():
    config = CoDesignConfig(iterations=25, starts=1, pathwise_runs=128, evaluation_runs=256)
    problem = replace(stated(), measurement=None)
    first, second = run(problem, 0.5, Learned(agent=clone_of(problem), config=config), plant=wide())
    assert second.accepted, str(second)
    assert first.agent is not None
    assert second.gain.ci95[0] > 0


def test_another_kind_of_plant_is_named():
    with pytest.raises(InputError, match="a RealPlant"):
        fitted_generations(stated(), spring(), rng=np.random.default_rng(0))
    elsewhere = RealPlant(spring(0.5), Gaussian([0.3]), [1.2, 0.0], 40, 50)
    with pytest.raises(InputError, match="the start that the filter knows"):
        fitted_generations(stated(), elsewhere, rng=np.random.default_rng(0))


SLIDE = DesignSpace(["m"], [0.5], [4.0], ["kg"])
UNKNOWN = DesignSpace(["m", "actuator", "slope"], [0.5, 0.3, -0.2], [4.0, 1.5, 0.2])


def slide(values=(), actuator=1.0, slope=0.0):
    """Carriage whose mass is designed; with `values` in its design its actuator and slope are unknown."""
    x, u, w, p = ca.SX.sym("x", 2), ca.SX.sym("u"), ca.SX.sym("w"), ca.SX.sym("p", 3 if values else 1)
    actuator, slope = (p[1], p[2]) if values else (actuator, slope)
    rate = (actuator * u + w - 0.5 * x[1]) / p[0] - 9.81 * slope
    return Plant(x, u, w, p, [x[1], rate], UNKNOWN if values else SLIDE, dt=0.05)


def on_a_slope():
    """Problem on the level, the real slide, and the plant with what is unknown of it."""
    problem = CoDesignProblem(
        discretise(slide()), X=([-1, -3], [1, 3]), U=(-20, 20), steps=100, limit_tolerance="off",
        objective=QuadraticObjective(np.diag([20.0, 1.0]), [[0.05]]),
        scenarios=FixedStart([0.3, 0.0], Gaussian([1.5])),
    )  # fmt: skip
    real = RealPlant(slide(actuator=0.7, slope=0.05), Gaussian([1.5]), [0.3, 0.0], 60, 100)
    return problem, real, slide(("actuator", "slope"))


@pytest.mark.long
def test_a_slope_that_is_unknown_is_designed_for():
    problem, real, wide = on_a_slope()
    first, second = fitted_generations(
        problem, real, method=Nested("lqr"), plant=wide, design=[2.0], rng=np.random.default_rng(1)
    )
    assert second.accepted
    away = second.fit.values[:2] - [0.7, 0.05]
    assert (np.abs(away) < 4 * second.fit.deviations[:2]).all()
    w = Gaussian([1.5]).sample(1000, 100, np.random.default_rng(9))
    own, other = (
        Scenario(real.plant, [0.3, 0.0], w).run(one.controller, design=one.design).returns(problem.objective)
        for one in (second, first)
    )
    assert (own - other).mean() > 0.1 * abs(other.mean())
    assert second.predicted.mean == pytest.approx((own - other).mean(), rel=0.2)


@pytest.mark.long
def test_a_slope_enters_the_updated_plant_with_a_disturbance_of_one():
    problem, real, wide = on_a_slope()
    _, second = fitted_generations(
        problem, real, method=Nested("lqr"), plant=wide, design=[2.0], rng=np.random.default_rng(1)
    )
    updated = second.fit.updated(problem)
    _, B, E = updated.model.matrices(np.array([1.3]))
    w = updated.scenarios.sample(500, 100, np.random.default_rng(0))[1]
    assert w.shape[2] == 2
    assert (w[:, :, 1] == 1).all()
    assert B[1, 0] == pytest.approx(second.fit.values[0] * 0.05 / 1.3, rel=0.02)
    assert E[1, 1] == pytest.approx(-9.81 * second.fit.values[1] * 0.05, rel=0.02)


@pytest.mark.long
def test_where_nothing_unknown_is_stated_least_squares_tell():
    problem, real, _ = on_a_slope()
    first, second = fitted_generations(problem, real, method=Nested("lqr"), design=[2.0], rng=np.random.default_rng(1))
    assert second.accepted or second.update.ci95[0] > 0
    w = Gaussian([1.5]).sample(1000, 100, np.random.default_rng(9))
    own, other = (
        Scenario(real.plant, [0.3, 0.0], w).run(one.controller, design=one.design).returns(problem.objective)
        for one in (second, first)
    )
    assert (own - other).mean() > 0.08 * abs(other.mean())


def valve(asymmetry=0.0, unknown=None):
    """Mass on a spring and a damper that is designed; a valve may make it harder one way, so that motion has a mean."""
    x, u, w, p = ca.SX.sym("x", 2), ca.SX.sym("u"), ca.SX.sym("w"), ca.SX.sym("p", 2 if unknown else 1)
    space = DesignSpace(["c"], [0.2], [3.0])
    stiffness, load = (p[1], 0) if unknown == "stiffness" else (1, p[1] if unknown else 0)
    if unknown:
        space = DesignSpace(["c", unknown], [0.2, -2.0], [3.0, 4.0])
    force = load - stiffness * x[0] - p[0] * (x[1] + asymmetry * ca.fabs(x[1])) + u + w
    return Plant(x, u, w, p, [x[1], force], space, dt=0.1)


def behind_a_valve(unknown, **changes):
    """Two generations, and fresh returns of both."""
    problem = CoDesignProblem(
        discretise(valve()), U=(-6, 6), steps=50, objective=QuadraticObjective(np.diag([4.0, 1.0]), [[0.5]]),
        scenarios=FixedStart([0.5, 0.0], Gaussian([2.0])), **({"X": (-6, 6), "limit_tolerance": "off"} | changes),
    )  # fmt: skip
    real = RealPlant(valve(0.8), Gaussian([2.0]), [0.5, 0.0], 100, 50)
    generations = fitted_generations(
        problem, real, method=Nested("lqr", starts=1, runs=100), plant=valve(unknown=unknown),
        rng=np.random.default_rng(0),
    )  # fmt: skip
    fresh = Scenario(real.plant, [0.5, 0.0], Gaussian([2.0]).sample(2000, 50, np.random.default_rng(9)))
    before, after = (fresh.run(one.controller, design=one.design).returns(problem.objective) for one in generations)
    return generations, before, after


@pytest.mark.long
def test_where_errors_last_the_law_by_the_logs_goes_into_service_at_the_former_design():
    (first, second), before, after = behind_a_valve("stiffness")
    assert second.fit.status.name == "LASTING"
    assert not second.accepted
    np.testing.assert_array_equal(second.design, first.design)
    assert (after - before).mean() > 0.05 * abs(before.mean())
    assert second.update.mean == pytest.approx((after - before).mean(), rel=0.25)
    assert "LQR by the logs" in str(second)


@pytest.mark.check
def test_the_law_by_the_logs_stays_out_where_it_breaks_a_limit():
    (first, second), *_ = behind_a_valve("stiffness", X=([-6, -6], [0.52, 6]), limit_tolerance=(0.001, 0.001))
    assert second.update is None
    assert second.controller is first.controller


@pytest.mark.check
def test_a_redesign_that_gains_less_than_the_law_by_the_logs_is_taken_back():
    (first, second), before, after = behind_a_valve("load")
    assert second.predicted.ci95[0] > 0
    assert second.gain.ci95[0] > 0
    assert not second.accepted
    np.testing.assert_array_equal(second.design, first.design)
    assert second.update.mean > second.gain.mean
    assert second.update.mean == pytest.approx((after - before).mean(), rel=0.25)
    assert "taken back" in str(second)


@pytest.mark.parametrize("measurement", [None, stated().measurement])
def test_a_deployment_that_loses_every_run_is_the_last_and_says_so(measurement):
    x, u, w, k = ca.SX.sym("x", 2), ca.SX.sym("u"), ca.SX.sym("w"), ca.SX.sym("k")
    pushed_away = Plant(x, u, w, k, [x[1], (30 - k) * x[0] + u + w], BOX, dt=0.33)  # stronger than U
    problem, elsewhere = replace(stated(), measurement=measurement), replace(real(1.0), plant=pushed_away)
    rng = np.random.default_rng(0)
    (only,) = fitted_generations(
        problem, elsewhere, method=Nested("lqr", starts=1) if measurement is None else Nested("lqg", starts=1),
        generations=3, rng=rng,
    )  # fmt: skip
    assert only.status.name == "LOST"
    assert only.log.states.shape[0] == 40
    assert "design=, method=" in str(only)
    assert "Every run diverged" in only.status.advice
