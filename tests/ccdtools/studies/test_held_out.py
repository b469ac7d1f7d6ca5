"""Roads that no generation has met, and what each source has brought."""

from dataclasses import replace

import numpy as np
import pytest
from small_runs import SPRING

from ccdtools import Gaussian, InputError, RealPlant, Recorded, load_study
from ccdtools.disturbances import Sum


@pytest.fixture(scope="module")
def study():
    """A mass on a spring whose real plant makes one long run."""
    scope: dict = {}
    exec(SPRING, scope)
    spring = scope["study"]
    return replace(spring, real=replace(spring.real, runs=1, steps=600))


# ── what is held out ──


def with_real(study, **changes):
    """The real plant of a study, changed."""
    return replace(study.real, **changes)


def test_a_single_run_of_a_generated_disturbance_is_drawn_afresh(study):
    assert study.real.fresh == {"fresh draws": study.real.disturbance}


def test_a_recording_alone_or_in_a_sum_cannot_be_drawn_afresh(study):
    recording = Recorded(np.zeros(600))
    assert with_real(study, disturbance=recording).fresh == {}
    assert with_real(study, disturbance=Sum((recording, Gaussian([0.1])))).fresh == {}


def test_several_runs_are_fresh_in_every_comparison_and_hold_nothing_out(study):
    assert with_real(study, runs=30).fresh == {}


def test_what_a_study_names_is_held_out_whatever_was_deployed(study):
    named = {"calm": Gaussian([0.01]), "rough": Gaussian([1.0])}
    real = with_real(study, disturbance=Recorded(np.zeros(600)), held_out=named)
    assert real.fresh == named
    assert set(load_study("suspension").real.fresh) == {"mild driver", "aggressive driver"}


@pytest.mark.parametrize(
    ("held_out", "message"),
    [
        ([Gaussian([0.1])], r"real\.held_out: got .*, expected a mapping of names to disturbances"),
        ({"": Gaussian([0.1])}, r"real\.held_out: got '', expected names of one line"),
        ({"two": Gaussian([0.1, 0.1])}, r"real\.held_out\['two'\]: got 2 channels, expected 1"),
        ({"none": 3.0}, r"real\.held_out\['none'\]: got 3\.0, expected an object with sample"),
    ],
)
def test_a_wrong_held_out_disturbance_is_named(study, held_out, message):
    with pytest.raises(InputError, match=message):
        RealPlant(study.plant, Gaussian([0.1]), np.zeros(2), 1, 600, held_out)


# ── what brought the gain ──
