"""Training on a graphics processor: what a CPU does, kept, gone on with and read elsewhere."""

import pytest
import torch
from toys import DoubleIntegrator, agent

from learning import load, save, train

pytestmark = pytest.mark.skipif(not torch.cuda.is_available(), reason="this machine has no CUDA device")


def trained(device, *, runs=64, iterations=3, env=None, **options):
    env = DoubleIntegrator(runs=runs) if env is None else env
    options = {"iterations": iterations, "steps": 20, "generator": torch.Generator().manual_seed(1), **options}
    return train(env, agent(), device=device, **options)


def weights(net):
    return torch.cat([tensor.double().flatten() for tensor in net.state_dict().values()])


def test_a_training_on_cuda_ends_where_one_on_the_cpu_does():
    here, there = trained("cpu"), trained("cuda")
    assert there.agent.log_std.device.type == there.best.log_std.device.type == "cpu"
    torch.testing.assert_close(weights(there.agent), weights(here.agent), atol=2e-3, rtol=2e-2)
    for a, b in zip(here.rows, there.rows):
        assert b.mean_return == pytest.approx(a.mean_return, rel=1e-3)
        assert b.update.kl == pytest.approx(a.update.kl, rel=0.1)


def test_a_broken_training_goes_on_and_the_agent_is_read_on_a_cpu(tmp_path):
    def stop(row):
        if row.iteration == 1:
            raise KeyboardInterrupt

    whole, file = trained("cuda", iterations=4), tmp_path / "training.pt"
    with pytest.raises(KeyboardInterrupt):
        trained("cuda", iterations=4, checkpoint=file, callback=stop)
    again = trained("cuda", iterations=4, checkpoint=file)
    torch.testing.assert_close(weights(again.agent), weights(whole.agent), atol=2e-3, rtol=2e-2)
    save(tmp_path / "agent", again.agent)
    read, _ = load(tmp_path / "agent")
    x = torch.randn(50, 2)
    assert torch.equal(read(x), again.agent(x))


def test_an_environment_on_the_device_is_trained_in_without_leaving_it():
    class There(DoubleIntegrator):
        def reset(self):
            self.k = 0
            self.x = (2 * torch.rand(self.runs, 2, generator=self.generator) - 1).cuda()
            return self.x

    found = trained("cuda", env=There(runs=512), iterations=30)
    returns = [row.mean_return for row in found.rows if row.judged]
    assert returns[-1] > returns[0] / 2
