"""The tolerance by MPC of a nonlinear plant, whatever the precision that the design comes in."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from ccdtools import load_study
from ccdtools.co_design.differentiable_model import scenario_tensors
from ccdtools.co_design.limits import measured, mpc_episodes


def test_mpc_of_a_nonlinear_plant_takes_designs_in_single_and_scenarios_in_double_precision():
    problem = replace(load_study("pendulum_on_cart").problem(), steps=15)
    x0, w = scenario_tensors(problem, 4, np.random.default_rng(0))
    v = torch.tensor([0.25, 0.5])
    double = measured(mpc_episodes(problem, v, (x0.double(), w.double()))).values()
    single = measured(mpc_episodes(problem, v, (x0, w))).values()
    assert double == pytest.approx(single, abs=1e-4)
