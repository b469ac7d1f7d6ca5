"""Studies of plants that are not linear: how exact the model is, and which steps the real plant takes."""

import warnings

import casadi as ca
import numpy as np
import pytest

from ccdtools import (
    DesignSpace,
    Gaussian,
    InputError,
    Plant,
    QuadraticObjective,
    RealPlant,
    Recorded,
    Study,
    discretise,
    saturated_lqr,
    simulate,
)
from ccdtools.exceptions import SamplingWarning
from ccdtools.plants import SampledModel

NOISE = Gaussian([0.1])
X = ([-2.0, -2.0], [2.0, 2.0])


def tank(*, rate=3000.0, cubic=0.2, substeps=10) -> Plant:
    """A tank behind a valve whose servo follows the input at a rate [1/s]; its outlet is the design."""
    x, u, w, p = ca.SX.sym("x", 2), ca.SX.sym("u"), ca.SX.sym("w"), ca.SX.sym("p")
    level = x[0] + w - p * (x[1] + cubic * x[1] ** 3)
    space = DesignSpace(["k"], [1.0], [4.0])
    return Plant(x, u, w, p, ca.vertcat(-rate * (x[0] - u), level), space, dt=0.05, substeps=substeps)


def study(plant, **changes) -> Study:
    fields = {
        "name": "tank", "title": "A tank", "plant": plant, "disturbance": NOISE, "x0": [0.0, 0.5], "X": X,
        "U": (-1.0, 1.0), "objective": QuadraticObjective(np.eye(2), [[0.1]]), "p0": [2.0], "steps": 100,
    }  # fmt: skip
    return Study(**(fields | changes))


def real(plant, **changes) -> RealPlant:
    return RealPlant(**({"plant": plant, "disturbance": NOISE, "x0": [0.0, 0.5], "runs": 20, "steps": 50} | changes))


@pytest.mark.check
def test_without_a_real_plant_the_steps_are_those_of_the_model():
    """The plant's own ten Runge–Kutta steps diverge in the first sample."""
    own = study(tank())
    assert own.real.plant is own.model
    assert own.real_is_model
    assert own.started(x0=[0.1, 0.1]).real_is_model
    run = simulate(
        own.real.plant, saturated_lqr(own.problem(), [2.0]), x0=[0.0, 0.5], steps=50, design=[2.0], disturbance=NOISE,
        rng=np.random.default_rng(0),
    )  # fmt: skip
    assert not run.diverged.any()
    assert study(tank(cubic=0.0, rate=30.0)).real_is_model
    assert not study(tank(rate=30.0), real=real(tank(rate=30.0))).real_is_model
    same = tank(rate=30.0)
    assert study(same, real=real(same)).real_is_model
    assert not study(same, real=real(same, later=[real(same), real(tank(rate=30.0, cubic=0.3))])).real_is_model


@pytest.mark.long
@pytest.mark.parametrize("cubic", [0.0, 0.2])
def test_a_real_plant_that_its_steps_do_not_follow_is_refused_with_steps_that_do(cubic):
    nominal = tank(rate=30.0)
    with pytest.raises(InputError, match=r"real.plant: got 10 Runge–Kutta steps a sample.*substeps=80\.") as refused:
        study(nominal, real=real(tank(cubic=cubic)))
    assert refused.value.argument == "real.plant"
    kept = study(nominal, real=real(tank(cubic=cubic, substeps=80)))
    assert kept.real.plant.substeps == 80
    with pytest.raises(InputError, match=r"Shorten dt, or give discretise.* as the real plant"):
        study(nominal, real=real(tank(cubic=0.2, rate=1e6)))
    model = discretise(tank(rate=1e6), X=X, U=(-1.0, 1.0), W=(-0.5, 0.5), accuracy=1e-3)
    assert study(nominal, real=real(model)).real.plant is model


def test_steps_that_are_coarse_somewhere_in_X_are_warned_of():
    """A stop that is hard at the border of X only."""
    x, u, w, p = ca.SX.sym("x", 2), ca.SX.sym("u"), ca.SX.sym("w"), ca.SX.sym("p")

    def mass(stop, **options):
        force = u + w - p * x[0] - x[1] - x[0] ** 3 - stop * x[0] ** 21
        return Plant(x, u, w, p, ca.vertcat(x[1], force), DesignSpace(["k"], [1.0], [4.0]), dt=0.05, **options)

    coarse = real(mass(0.01), x0=[0.5, 0.0])
    with pytest.warns(SamplingWarning, match=r"real.plant: 10 Runge.* the worst at x = \[.*substeps=") as warned:
        study(mass(0.0), real=coarse, x0=[0.5, 0.0])
    assert warned[0].filename == __file__
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        study(mass(0.0), real=coarse, x0=[0.5, 0.0], sampling_guard="ignore")
        study(mass(0.0), real=real(mass(0.0), x0=[0.5, 0.0]), x0=[0.5, 0.0])


def test_a_short_recording_says_how_large_the_disturbance_is():
    signal = Recorded(0.1 * np.random.default_rng(0).standard_normal(600))
    one = study(tank(rate=30.0), disturbance=signal, real=real(tank(rate=30.0), disturbance=signal, runs=1, steps=600))
    assert isinstance(one.model, SampledModel)


@pytest.mark.check
def test_accuracy_and_method_are_those_of_the_model():
    plant = tank(rate=30.0)
    fine, coarse = (study(plant, accuracy=accuracy).model for accuracy in (1e-9, 1e-3))
    assert coarse.substeps < fine.substeps
    assert fine.error.relative <= 1e-9 < coarse.error.relative <= 1e-3
    assert study(plant, method="collocation", sampling_guard="ignore").model.method == "collocation"
    with pytest.raises(InputError, match=r"accuracy: got 1e-18, where .* is reached"):
        study(plant, accuracy=1e-18, method="rk4")


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"accuracy": 0.0}, "accuracy: got 0"), ({"accuracy": "fine"}, "accuracy: got 'fine'"),
        ({"method": "euler"}, "method: got 'euler'"), ({"method": None}, "method: got nothing"),
    ],
)  # fmt: skip
@pytest.mark.parametrize("cubic", [0.0, 0.2])
def test_a_wrong_accuracy_or_method_is_named_on_any_plant(wrong, message, cubic):
    with pytest.raises(InputError, match=message):
        study(tank(rate=30.0, cubic=cubic), **wrong)
