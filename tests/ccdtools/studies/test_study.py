"""Declaring a study, finding one, and starting it elsewhere."""

from dataclasses import replace

import numpy as np
import pytest

from ccdtools import Gaussian, InputError
from ccdtools.disturbances import Uniform
from ccdtools.studies import Study, load_study
from invariant_sets import Polytope

THIRD = '''
"""A mass on a spring whose stiffness is the design."""
import casadi as ca
import numpy as np
from ccdtools import DesignSpace, Plant, QuadraticObjective
from ccdtools.disturbances.disturbance import Gaussian
from ccdtools.studies import RealPlant, Study
from invariant_sets import Polytope

x, u, w, p = ca.SX.sym("x", 2), ca.SX.sym("u"), ca.SX.sym("w"), ca.SX.sym("p")
plant = Plant(x, u, w, p, ca.vertcat(x[1], -p * x[0] + u + w), DesignSpace(["k"], [1], [4]), dt=0.1)
noise = Gaussian([0.1])
study = Study(
    name="spring", title="Spring", plant=plant, X=Polytope.from_bounds([-1, -2], [1, 2]),
    U=Polytope.from_bounds([-1], [1]), objective=QuadraticObjective(np.eye(2), [[0.1]]), disturbance=noise,
    x0=[0.5, 0], p0=[2], real=RealPlant(plant, noise, x0=[0, 0], runs=1, steps=600),
)
'''


@pytest.mark.parametrize("name", ["illustrative", "suspension"])
def test_a_study_is_found_by_its_name(name):
    study = load_study(name)
    assert study.name == name
    assert study.problem().model is study.model


def test_a_study_in_a_file_needs_no_other_file(tmp_path):
    path = tmp_path / "spring.py"
    path.write_text(THIRD)
    study = load_study(str(path))
    assert study.name == "spring"
    assert study.problem().design.names == ("k",)
    np.testing.assert_allclose(study.weight, 0.1 * np.eye(2))


def test_the_start_may_be_elsewhere(illustrative):
    moved = illustrative.started(x0=[-2, -2], p0=[0.8])
    np.testing.assert_array_equal(moved.x0, [-2, -2])
    np.testing.assert_array_equal(moved.p0, [0.8])
    np.testing.assert_array_equal(moved.real.x0, [-2, -2])
    np.testing.assert_array_equal(illustrative.x0, [-3.5, -2])
    assert illustrative.started() is illustrative
    x0, _ = moved.problem().scenarios.sample(1, 5, np.random.default_rng(0))
    np.testing.assert_array_equal(x0, [[-2, -2]])


@pytest.mark.parametrize(
    "starts",
    [
        Polytope.from_bounds([-1, -1], [1, 0]),
        Uniform([-1, -1], [1, 0]),
        [[-1, 0], [1, -1], [0.5, -0.5]],
        Gaussian([0.1, 0]),
    ],
)
def test_episodes_may_start_anywhere_in_a_set(illustrative, starts):
    study = replace(illustrative, starts=starts)
    x0, w = study.problem().scenarios.sample(50, 4, np.random.default_rng(0))
    assert np.abs(x0).max() <= 1
    assert len(np.unique(x0, axis=0)) > 2
    assert w.shape == (50, 4, 2)
    assert len(np.unique(study.model_starts(9, np.random.default_rng(0)), axis=0)) > 2
    np.testing.assert_array_equal(study.real.x0, illustrative.real.x0)
    np.testing.assert_array_equal(study.started(x0=[-2, -2]).problem().scenarios.x0, [-2, -2])
    assert study.started(p0=[0.8]).starts is not None


@pytest.mark.parametrize(
    ("starts", "message"),
    [
        (Uniform([0, 0], [6, 0]), "starts: got .* reaches outside X"),
        ([[0, 0], [9, 0]], "starts: got .* as state 2, which is outside X"),
        (Uniform([0], [1]), r"starts: got states of shape \(1,\)"),
        ([0.0, 0.0], r"starts: got shape \(2,\)"),
        ("X", "starts: got 'X'"),
    ],
)
def test_starts_outside_the_limits_are_refused(illustrative, starts, message):
    with pytest.raises(InputError, match=message):
        replace(illustrative, starts=starts)


def test_a_real_start_of_its_own_stays(suspension):
    moved = suspension.started(x0=np.ones(4) * 0.01)
    np.testing.assert_array_equal(moved.real.x0, np.zeros(4))


@pytest.mark.parametrize(
    ("start", "message"),
    [
        ({"x0": [1.0]}, r"x0: got shape \(1,\), expected 2 numbers, one per state"),
        ({"x0": [np.nan, 0.0]}, "x0: got (nan|-?inf) at index"),
        ({"p0": [7.0]}, "p0: got p = 7, expected a value in"),
        ({"p0": [1.0, 2.0]}, r"p0: got shape \(2,\), expected 1 number, one per design parameter"),
        ({"x0": [9.0, 0.0]}, r"x0: got \[9.0, 0.0\], which is outside X, expected a state within X"),
    ],
)
def test_bad_starts_are_refused(illustrative, start, message):
    with pytest.raises(InputError, match=message):
        illustrative.started(**start)


def test_unknown_studies_and_files_are_refused(tmp_path):
    with pytest.raises(
        InputError, match=r"study: got 'bridge', expected one of backlash_servo, .*, wind_turbine, or a"
    ):
        load_study("bridge")
    with pytest.raises(InputError, match=r"study: got nothing.py, which is not a file"):
        load_study("nothing.py")
    empty = tmp_path / "empty.py"
    empty.write_text("study = 3")
    with pytest.raises(InputError, match=r"study: got .*empty.py, which declares no `study`, expected a ccdtools"):
        load_study(str(empty))


def test_the_constants_are_those_of_the_literature(suspension, illustrative):
    assert isinstance(suspension, Study)
    np.testing.assert_array_equal(suspension.plant.design.lower, [1e4, 500])
    np.testing.assert_array_equal(suspension.plant.design.upper, [4e4, 3000])
    np.testing.assert_array_equal(suspension.x0, [-0.1, -1, -0.1, -0.5])
    np.testing.assert_array_equal(np.diag(suspension.objective.Q), [10, 1, 50, 5])
    np.testing.assert_array_equal(suspension.objective.R, [[1e-6]])
    np.testing.assert_array_equal(illustrative.X.bounding_box(), [[-10, -5], [5, 2]])
    np.testing.assert_array_equal(illustrative.plant.design.lower, [0.5])
