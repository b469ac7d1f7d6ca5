"""The studies that come with the package: one for every plant of the library, each ready to run."""

import inspect
import warnings

import numpy as np
import pytest
from typer.testing import CliRunner

from ccdtools import LinearFeedback, Study, codesign, depth_outside, saturated_lqr, simulate
from ccdtools.cli import app
from ccdtools.co_design import expert_dataset
from ccdtools.plants import library
from ccdtools.plants.library import full_car
from ccdtools.studies import load_study, study_names

PLANTS = [name for name in library.__all__ if inspect.isfunction(getattr(library, name))]


@pytest.mark.long
@pytest.mark.quick(7)
@pytest.mark.parametrize("name", PLANTS)
def test_every_plant_of_the_library_has_a_study_of_its_name(name):
    plant = load_study(name).plant
    own = mass_chain_of_four() if name == "mass_chain" else getattr(library, name)()
    assert plant.state_names == own.state_names
    assert plant.input_names == own.input_names
    assert plant.design.names == own.design.names
    np.testing.assert_array_equal(plant.design.lower, own.design.lower)
    np.testing.assert_array_equal(plant.design.upper, own.design.upper)


def mass_chain_of_four():
    return library.mass_chain(4)


@pytest.mark.long
def test_the_variants_of_the_library_have_studies():
    lagging = load_study("quarter_car_actuator_lag").plant
    assert (lagging.nx, lagging.linear) == (5, True)
    assert not load_study("quarter_car_nonlinear").plant.linear
    assert load_study("mass_chain_10").plant.nx == 20
    assert load_study("full_car_heights").plant.nx == 14


@pytest.mark.long
@pytest.mark.parametrize("name", study_names())
def test_a_study_loads_without_a_warning_and_under_its_own_name(name):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        study = load_study(name)
    assert isinstance(study, Study)
    assert study.name == name


@pytest.mark.parametrize("name", study_names())
def test_a_study_is_well_posed(name):
    """Both starts lie in X, every corner of the designs can be stabilised, and the real plant is another one."""
    study = load_study(name)
    for point in (study.x0, study.real.x0, np.zeros(study.plant.nx)):
        assert study.X.contains(point)
    assert study.U.contains(np.zeros(study.plant.nu))
    for design in (study.p0, study.plant.design.lower, study.plant.design.upper):
        gain = saturated_lqr(study.problem(), design).K
        A, B, _ = study.model.matrices(design)
        assert np.abs(np.linalg.eigvals(A - B @ gain)).max() < 1
    assert not study.real_is_model


@pytest.mark.parametrize("name", study_names())
def test_lqr_at_the_start_keeps_the_real_plant_within_twice_its_limits(name):
    """The limits of a study are those of its plant: the state comes to more than a twentieth of them."""
    study = load_study(name)
    run = simulate(
        study.real.plant, saturated_lqr(study.problem(), study.p0), x0=np.tile(study.real.x0, (3, 1)), steps=100,
        disturbance=study.real.disturbance, design=study.p0, rng=np.random.default_rng(0),
    )  # fmt: skip
    reached = np.abs(run.states).max(axis=(0, 1)) / study.problem().state_scale
    assert not run.diverged.any()
    assert 0.05 < reached.max() < 2.0


def test_a_car_on_heights_rides_as_the_same_car_on_the_speeds_of_its_road():
    rides = []
    for name, plant in (("full_car", full_car(twist_decay=0.0)), ("full_car_heights", full_car(road="height"))):
        study = load_study(name)
        idle = LinearFeedback(np.zeros((4, plant.nx)))
        run = simulate(
            plant, idle, x0=np.zeros((2, plant.nx)), steps=1000, disturbance=study.disturbance, design=study.p0,
            rng=np.random.default_rng(0),
        )  # fmt: skip
        rides.append(study.metrics(run))
    for measure, value in rides[0].items():  # heights that are held over a sample lack some of the shortest waves
        assert rides[1][measure] == pytest.approx(value, rel=0.03 if "tyre" not in measure else 0.15), measure


def test_the_command_line_names_every_study_where_one_looks_for_them():
    runner = CliRunner()
    listed = runner.invoke(app, ["studies"]).output.splitlines()
    assert [line.split()[0] for line in listed] == study_names()
    helped = runner.invoke(app, ["run", "--help"]).output
    refused = runner.invoke(app, ["run", "unheard-of"])
    for name in study_names():
        assert name in helped
        assert name in str(refused.exception)


def test_twenty_states_are_initialised_and_judged_without_the_corners_of_their_limits():
    """X has 2²⁰ of them: the expert is followed from the region that saturated LQR keeps."""
    study = load_study("mass_chain_10")
    data = expert_dataset(study.problem(), samples=15, rng=np.random.default_rng(0), time_limit=1.0)
    assert data.sets.lqr == 15
    assert data.diverged == 0
    assert len(data.inputs) > 50
    assert depth_outside(1.5 * study.X.bounding_box()[1], study.X) == pytest.approx(0.5)


@pytest.mark.long
def test_the_template_prices_its_design_so_that_the_best_one_lies_within_its_bounds(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert CliRunner().invoke(app, ["new", "my_study"]).exit_code == 0
    study = load_study("my_study.py")
    found = codesign(study.problem(), method="nested", rng=np.random.default_rng(0))
    assert found.active_bounds == {}
    assert (study.plant.design.to_unit(found.design) > 0.05).all()
    assert (study.plant.design.to_unit(found.design) < 0.95).all()
