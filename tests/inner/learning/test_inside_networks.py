"""What test_networks.py claims, seen from inside."""

import numpy as np
import pytest
import torch

from learning import ActorCritic, checkpoint, load, save
from learning.exceptions import CheckpointError
from learning.networks import FeedForward


def test_a_skip_is_a_linear_map_beside_the_hidden_layers():
    torch.manual_seed(0)
    net = FeedForward(3, 2, (5,), skip=True)
    x = torch.randn(7, 3)
    torch.testing.assert_close(net(x), net.head(net.body(x)) + x @ net.skip.weight.T)
    assert FeedForward(3, 2, (5,), skip=False).skip is None
    assert [layer.out_features for layer in FeedForward(3, 2, (5, 4), skip=False).body[::2]] == [5, 4]


class Widening:
    """Two actions whose bounds grow with the last two observations."""

    entries = 2
    box = (np.array([-4.0, -1.0]), np.array([2.0, 9.0]))

    def bounds(self, p):
        return -p * p.new_tensor([2.0, 0.5]), p * p.new_tensor([1.0, 4.5])

    def as_dict(self):
        return {"kind": "widening"}


def test_such_a_policy_comes_back_with_its_bounds(tmp_path):
    net = ActorCritic([-1] * 3, [1] * 3, *Widening.box, action_limits=Widening())
    save(tmp_path / "net.safetensors", net)
    with pytest.raises(CheckpointError, match="action limits"):
        load(tmp_path / "net.safetensors")
    again, _ = checkpoint.load(tmp_path / "net.safetensors", action_limits=lambda kept: Widening())
    seen = torch.randn(4, 3)
    torch.testing.assert_close(again.action(again.latent(seen), seen), net.action(net.latent(seen), seen))
