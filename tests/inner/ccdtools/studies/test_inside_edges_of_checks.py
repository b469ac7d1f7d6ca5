"""What a real plant, its recording and its steps are refused or warned for, well below and well above."""

import warnings
from dataclasses import replace
from types import SimpleNamespace

import casadi as ca
import numpy as np
import pytest

from ccdtools import DesignSpace, Gaussian, InputError, Mean, Plant, QuadraticObjective, RealPlant, Recorded, Study
from ccdtools.exceptions import SamplingWarning
from ccdtools.studies import configuration
from ccdtools.studies.evaluation import Evaluation
from ccdtools.studies.plant_checks import check_real_step
from ccdtools.studies.report.landscape import landscape
from invariant_sets import Polytope

UNIT = Polytope.from_bounds([-1.0], [1.0])


def decaying(rate, **more):
    """A plant x⁺ or dx/dt = rate(x, w) of which the design decides nothing."""
    x, u, w, p = ca.SX.sym("x"), ca.SX.sym("u"), ca.SX.sym("w"), ca.SX.sym("p")
    return Plant(x, u, w, p, rate(x, w) + 0.01 * p * u, DesignSpace(["p"], [1.0], [2.0]), dt=1.0, substeps=1, **more)


def error_of_a_step(k):
    """Three times what one Runge–Kutta step of dx/dt = −k x and two of half the length differ by."""
    one, half = (1 - z + z**2 / 2 - z**3 / 6 + z**4 / 24 for z in (k, k / 2))
    return 3 * abs(one - half**2)


def said_of(plant, disturbance=0.0):
    """What is said of the steps of a real plant."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", SamplingWarning)
        try:
            check_real_step(plant, UNIT, UNIT, (np.array([-disturbance]), np.array([disturbance])), guard="warn")
        except InputError as error:
            return error.got
    return str(caught[0].message) if caught else ""


@pytest.mark.parametrize(
    ("k", "least", "most", "said"),
    [(1.0, 0.01, 0.05, ""), (1.8, 0.2, 0.4, "may be wrong by"), (4.0, 10, 15, "may be wrong by"),
     (6.2, 90, 120, "too long for it")],
)  # fmt: skip
def test_steps_of_a_real_plant_are_warned_of_at_a_tenth_and_refused_at_thirty_half_ranges(k, least, most, said):
    """A tenth of the state has a tenth of the error, which thirty bring to three half-widths."""
    assert least < error_of_a_step(k) < most
    found = said_of(decaying(lambda x, w: -k * x))
    assert said in found
    assert ("too long" in found, "may be wrong" in found) == (bool(said), "may be wrong" in said)


@pytest.mark.parametrize(("k", "thrown"), [(10.0, False), (13.0, True)])
def test_a_disturbance_that_throws_the_plant_out_is_not_the_fault_of_the_steps(k, thrown):
    assert 300 < error_of_a_step(10.0) < 1000 < error_of_a_step(13.0) < 4000
    assert bool(said_of(decaying(lambda x, w: -k * w**2 * x), disturbance=1.0)) != thrown


@pytest.mark.parametrize(("share", "refused"), [(0.2, False), (0.8, True)])
def test_a_recording_is_refused_that_keeps_the_plant_outside_for_half_of_its_samples(share, refused):
    plant = decaying(lambda x, w: 0.1 * x + w, continuous=False)
    signal = np.where(np.arange(600) % 10 < 10 * share, 5.0, 0.0)
    noise = Gaussian([0.1])
    study = Study(
        name="one", title="One", plant=plant, X=UNIT, U=UNIT, objective=QuadraticObjective([[1.0]], [[1.0]]),
        disturbance=noise, x0=[0.5], p0=[1.5], steps=20,
        real=RealPlant(plant, Recorded(signal), x0=[0.0], runs=1, steps=600),
    )  # fmt: skip
    evaluation = Evaluation(study, replace(configuration(study), model_runs=20), 0)
    if refused:
        with pytest.raises(InputError, match=r"is outside X in 8.% of the samples"):
            evaluation.check_deployment()
    else:
        evaluation.check_deployment()


@pytest.mark.parametrize(("runs", "refused"), [(79, True), (80, False)])
def test_trials_without_room_are_refused_before_anything_is_trained(runs, refused):
    plant = decaying(lambda x, w: 0.1 * x + w, continuous=False)
    study = Study(
        name="one", title="One", plant=plant, X=UNIT, U=UNIT, objective=QuadraticObjective([[1.0]], [[1.0]]),
        disturbance=Gaussian([0.1]), x0=[0.5], p0=[1.5], steps=20,
        real=RealPlant(plant, Gaussian([0.1]), x0=[0.0], runs=runs, steps=20),
    )  # fmt: skip
    evaluation = Evaluation(study, configuration(study, trial=True), 0)
    if refused:
        with pytest.raises(InputError, match=r"trial: got room for 39 pairs .* expected at least 40"):
            evaluation.check_deployment()
    else:
        evaluation.check_deployment()


@pytest.mark.parametrize(("steps", "enough"), [(170, False), (1500, True)])
def test_a_deployment_logs_five_hundred_samples_at_least(steps, enough):
    plant = decaying(lambda x, w: 0.1 * x + w, continuous=False)
    if enough:
        assert RealPlant(plant, Gaussian([0.1]), x0=[0.0], runs=1, steps=steps).steps == steps
    else:
        with pytest.raises(InputError, match="expected at least 500 samples"):
            RealPlant(plant, Gaussian([0.1]), x0=[0.0], runs=1, steps=steps)


@pytest.mark.parametrize(("diverged", "blank"), [(0.3e-2, False), (3e-2, True)])
def test_a_design_of_the_landscape_is_blank_where_a_hundredth_of_its_runs_diverges(monkeypatch, diverged, blank):
    def returns(run, designs, runs):
        return np.column_stack([-1 - designs[:, 0], 0 * designs[:, 0], np.where(designs[:, 0] > 1.5, diverged, 0.0)])

    monkeypatch.setattr("ccdtools.studies.report.landscape._returns_over", returns)
    space = DesignSpace(["p"], [1.0], [2.0])
    run = SimpleNamespace(problem=SimpleNamespace(design=space, risk=Mean()), histories=[], designs=[np.array([1.2])],
                          chosen=[], quick=True, describe=space.describe)  # fmt: skip
    assert ("more than 1 % of the runs diverge the design is left grey" in landscape(run)[0].caption) == blank
