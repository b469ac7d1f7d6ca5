"""The gallery's studies and their second statement say the same, and the independent optima are optima."""

from dataclasses import replace
from pathlib import Path

import gallery
import numpy as np
import pytest
from gallery.oracle.cost import highest_linear_return, linear_return, model_step, real_step, saturated_return, simulated
from gallery.oracle.dynamic_programming import clipped_optimum
from gallery.oracle.optimum import landscape
from gallery.oracle.receding_horizon import RecedingHorizon
from gallery.oracle.truth import best_feedback
from gallery.reference import CLIPPED, LIMITED, STUDIES, reference, statement

from ccdtools import saturated_lqr, simulate
from ccdtools.studies import load_study

FILES = Path(gallery.__file__).parent / "studies"
EXACT = tuple(name for name in STUDIES if name not in CLIPPED + LIMITED)


def study_of(name):
    """The study that a file of the gallery declares."""
    return load_study(FILES / f"{name}.py")


def random_designs(name, count, seed=0):
    """Designs (count, np) anywhere in the box."""
    s = statement(name)
    return [s.from_unit(v) for v in np.random.default_rng(seed).random((count, len(s.lower)))]


@pytest.mark.parametrize("name", STUDIES)
def test_a_study_and_its_statement_hold_the_same_numbers(name):
    study = study_of(name)
    s = statement(name)
    pairs = {
        "Q": (study.objective.Q, np.diag(s.Q)), "R": (study.objective.R, np.diag(s.R)),
        "std": (study.disturbance.std, s.std), "x0": (study.x0, s.x0), "p0": (study.p0, s.p0),
        "lower": (study.plant.design.lower, s.lower), "upper": (study.plant.design.upper, s.upper),
        "X": (study.X.bounding_box(), (-s.x_max, s.x_max)), "U": (study.U.bounding_box(), (-s.u_max, s.u_max)),
        "dt": (study.plant.dt, s.dt), "steps": (study.steps, s.steps),
    }  # fmt: skip
    for what, (own, other) in pairs.items():
        np.testing.assert_allclose(own, other, rtol=1e-12, err_msg=what)


@pytest.mark.parametrize("name", STUDIES)
def test_the_sampled_model_agrees_with_matrices_written_down_without_casadi(name):
    study = study_of(name)
    for p in random_designs(name, 3):
        for own, other in zip(study.model.matrices(p), statement(name).sampled(p)):
            np.testing.assert_allclose(own, other, rtol=0, atol=1e-9 * np.abs(other).max())


@pytest.mark.long
@pytest.mark.parametrize("name", STUDIES)
def test_the_real_plant_agrees_with_dynamics_written_down_without_casadi(name):
    s = statement(name)
    rng = np.random.default_rng(1)
    x, u, w = (
        0.3 * scale * rng.standard_normal((20, len(scale))) for scale in (s.x_max, s.u_max, np.maximum(s.std, 1e-3))
    )
    plant = study_of(name).real.plant
    for p in random_designs(name, 2, seed=1):
        own = plant.stepper(p, batch=20)(x, u, w)
        np.testing.assert_allclose((own - real_step(s, p)(x, u, w)) / s.x_max, 0, atol=1e-7)


@pytest.mark.parametrize("name", EXACT)
def test_the_simulated_return_of_lqr_is_the_exact_one_within_its_standard_error(name):
    study = study_of(name)
    p = np.array(reference(name)["designs"][0])
    problem = study.problem()
    x0, w = problem.scenarios.sample(400, study.steps, np.random.default_rng(3))
    run = simulate(study.model, saturated_lqr(problem, p), x0=x0, steps=study.steps, disturbance=w, design=p)
    returns = run.returns(study.objective)
    error = returns.std(ddof=1) / np.sqrt(len(returns))
    assert abs(returns.mean() - linear_return(statement(name), p)) < 4 * error
    assert error < 0.02 * abs(returns.mean())


@pytest.mark.parametrize("name", CLIPPED + LIMITED)
def test_the_clipped_lqr_returns_the_same_in_both_simulations(name):
    study = study_of(name)
    s = statement(name)
    w = s.disturbance(50, seed=4)
    for p in (s.p0, s.upper):
        run = simulate(
            study.model, saturated_lqr(study.problem(), p), x0=s.x0, steps=s.steps, disturbance=w, design=p,
            limit=study.problem().limit,
        )  # fmt: skip
        assert not run.diverged.any()
        np.testing.assert_allclose(run.returns(study.objective).mean(), saturated_return(s, p, w), rtol=1e-8)


@pytest.mark.parametrize("name", EXACT)
def test_no_design_is_better_than_the_optimum_that_is_kept(name):
    s = statement(name)
    kept = reference(name)
    best = kept["returns"][0]
    assert linear_return(s, np.array(kept["designs"][0])) == pytest.approx(best, rel=1e-9)
    assert all(linear_return(s, p) < best for p in [s.p0, *random_designs(name, 40, seed=2)])
    corners = [linear_return(s, p) for p in s.corners()]
    assert kept["worst_return"] == pytest.approx(min(corners), rel=1e-9)
    assert highest_linear_return(s, np.array(kept["designs"][0])) == pytest.approx(best, rel=0.01)


def test_both_valleys_of_the_beam_are_kept_and_lie_far_apart():
    kept = reference("beam")
    s = statement("beam")
    assert len(kept["designs"]) == 2
    assert kept["returns"][0] > 0.95 * kept["returns"][1] > kept["returns"][1]
    for design, value in zip(kept["designs"], kept["returns"]):
        for step in (-0.02, 0.02):
            assert linear_return(s, np.array(design) + step) < value


def test_the_optimum_of_the_mass_is_where_a_coarser_search_finds_it():
    s = statement("mass_spring_damper")
    found = landscape(s, lambda p: linear_return(s, p), points=31)
    np.testing.assert_allclose(found.designs[0], reference("mass_spring_damper")["designs"][0], rtol=1e-4)


@pytest.mark.check
def test_dynamic_programming_is_the_riccati_equation_where_no_input_saturates():
    s = replace(statement("two_unstable_modes"), steps=8, u_max=np.array([6.0]), x0=np.array([0.3, 0.2]))
    p = np.array([0.8])
    w = s.disturbance(20_000, seed=6)
    returns = clipped_optimum(s, p).returns(w)
    assert abs(returns.mean() - highest_linear_return(s, p)) < 4 * returns.std() / np.sqrt(len(w))


def test_the_feedback_kept_for_saturated_inputs_lies_between_lqr_and_what_dynamic_programming_allows():
    kept = reference("two_unstable_modes")
    assert kept["lqr"] < 1.03 * kept["returns"][0] < kept["returns"][0] < kept["by_time"]


def test_what_dynamic_programming_gains_it_gains_by_letting_go_before_the_end():
    kept = reference("two_unstable_modes")
    assert kept["stationary"] == pytest.approx(kept["returns"][0], rel=0.02)
    assert kept["by_time"] > kept["stationary"] + 0.2 * abs(kept["stationary"])


@pytest.mark.slow
def test_the_search_for_a_feedback_finds_lqr_where_no_input_saturates():
    s = replace(statement("servo"), real=None)
    p = np.array(reference("servo")["designs"][0])
    w = s.disturbance(50, seed=8)
    A, B, _ = s.sampled(p)
    lqr = simulated(s, model_step(s, p), lambda x: -x @ s.gain(A, B).T, w)[0].mean()
    alone, _, _ = best_feedback(s, p, w)
    assert 0 <= alone - lqr < 0.002 * abs(lqr)


def test_the_mpc_of_the_oracle_is_lqr_inside_the_limits_and_keeps_them_near_the_edge():
    s = statement("rail_mass")
    p = np.array([1.0])
    A, B, _ = s.sampled(p)
    mpc = RecedingHorizon(s, p)
    inside = np.array([[0.05, 0.02], [-0.03, 0.04]])
    np.testing.assert_allclose(mpc(inside), -inside @ s.gain(A, B).T, atol=1e-3)
    x = s.x0
    speeds = []
    for _ in range(40):
        x = A @ x + B @ mpc(x[None])[0]
        speeds.append(x[1])
    assert max(speeds) < 1.002 * s.x_max[1]
    assert max(speeds) > 0.99 * s.x_max[1]
    assert abs(x[0]) < 0.15
