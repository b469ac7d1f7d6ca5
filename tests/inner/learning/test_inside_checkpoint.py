"""What test_checkpoint.py claims, seen from inside."""

import torch

from learning import load, save
from learning.quantile import QuantileNetwork


def test_quantiles_come_back_as_they_were(tmp_path):
    net = QuantileNetwork(3, 2, (0.1, 0.5, 0.9), (6,), seed=1)
    net.calibration.mul_(1.3)
    net.input_lower.fill_(-2.0)
    save(str(tmp_path / "q.safetensors"), net)
    again, extra = load(str(tmp_path / "q.safetensors"))
    assert extra == {}
    assert again.levels == net.levels
    x = 5 * torch.randn(9, 3)
    assert torch.equal(again(x), net(x))
