"""What the first policy of a run imitates."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from ccdtools.studies import configuration, load_study
from ccdtools.studies.evaluation import Evaluation
from ccdtools.studies.stages import LoopStages
from learning import CloningConfig


def initialised(name, **options):
    study = load_study(name)
    config = replace(configuration(study, quick=True, **options), samples=40, cloning=CloningConfig(steps=20))
    config = replace(config, mpc_runs=2)
    return LoopStages(Evaluation(study, config, seed=0), progress=False).initialise(np.random.default_rng(0))


@pytest.mark.check
def test_a_swing_up_begins_with_an_imitation_of_mpc():
    stage = initialised("swing_up")
    assert stage.values["expert"] in ("nonlinear MPC", "economic MPC")
    assert "sets" not in stage.values
    assert stage.values["report"] == [
        f"LQR brings nothing to rest: {stage.values['expert']} of the model imitated in "
        f"{stage.values['samples']} samples"
    ]


@pytest.mark.long
def test_an_expert_that_is_asked_for_is_imitated_in_a_swing_up_too():
    stage = initialised("swing_up", expert="lqr", sets="none")
    assert stage.values["expert"] == "lqr"
    assert stage.values["candidates"] == 40


@pytest.mark.long
def test_where_lqr_is_an_expert_it_is_imitated_as_if_asked_for():
    chosen, asked = (initialised("illustrative", **options) for options in ({}, {"expert": "lqr"}))
    assert chosen.values["expert"] == "lqr"
    for one, other in zip(chosen.networks["agent"].parameters(), asked.networks["agent"].parameters()):
        assert torch.equal(one, other)
