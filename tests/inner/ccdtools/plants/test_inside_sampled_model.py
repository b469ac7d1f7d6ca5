"""What test_sampled_model.py claims, seen from inside."""

import numpy as np
import pytest
import torch
from nonlinear_plants import hot_plate

from ccdtools import equilibrium
from ccdtools.plants import deviations
from ccdtools.plants.collocation import ImplicitStep


@pytest.mark.long
@pytest.mark.parametrize("size", [1.0, 1e-4, 1e-8, 1e-10, 1e-14, 0.0])
def test_collocation_converges_where_rest_is_rest_but_for_rounding(size):
    plant = hot_plate()
    hanging = deviations(plant, equilibrium(plant, [1000.0], guess=([300, 300.0], [0.0])))
    rng = np.random.default_rng(0)
    x, u, p = (rng.uniform(*box) for box in ((-50, 50, (200, 2)), (-100, 100, (200, 1)), (500, 5000, (200, 1))))
    for parts in (1, 4, 64):
        step = ImplicitStep(hanging.right_hand_side, 1.0, parts, np.array([50.0, 50.0]))
        points = (size * x, size * u, np.zeros((200, 1)), p)
        reached = step(*points)
        assert np.isfinite(reached).all()
        native = np.asarray(step.function(*(a[:20].T for a in points))).T
        np.testing.assert_allclose(reached[:20], native, atol=2e-9)
        tensors = step(*(torch.tensor(a) for a in points)).numpy()
        np.testing.assert_allclose(tensors, reached, atol=1e-12)
