"""Training: from scratch or refined, with running scales, resumed with the same numbers, best and last agent."""

import copy
import os
import signal
import subprocess
import sys

import numpy as np
import pytest
import torch
from toys import DoubleIntegrator, agent

from learning import ActorCritic, CloningConfig, Collector, NetworkConfig, PPOConfig, fit_actor_critic, train
from learning.exceptions import CheckpointError, DivergedError, InputError


def generator(seed=1):
    return torch.Generator().manual_seed(seed)


def short(net, env=None, **options):
    options = {"iterations": 4, "steps": 30, "generator": generator(), **options}
    return train(DoubleIntegrator() if env is None else env, net, **options)


def weights(net):
    return torch.cat([tensor.double().flatten() for tensor in net.state_dict().values()])


def test_a_rollout_goes_on_where_the_last_one_ended():
    collector = Collector(DoubleIntegrator(horizon=50), agent(), generator=generator())
    first, second = collector.rollout(20), collector.rollout(20)
    torch.testing.assert_close(second.observations[0], first.successors[-1])
    assert not collector.ended
    collector.rollout(20)
    assert len(collector.ended) == 8


def test_returns_of_episodes_are_the_sums_of_their_rewards():
    collector = Collector(DoubleIntegrator(horizon=10), agent(), generator=generator(), gamma=0.9)
    rewards = torch.cat([collector.rollout(5).rewards, collector.rollout(5).rewards]).double()
    returns, discounted, lengths, terminated, ends = np.array(collector.ended).T
    np.testing.assert_allclose(returns, rewards.sum(0), rtol=1e-6)
    np.testing.assert_allclose(discounted, 0.9 ** np.arange(10) @ rewards.numpy(), rtol=1e-6)
    assert set(lengths) == set(ends) == {10}
    assert not terminated.any()


def test_observations_seen_in_parts_are_normalised_by_their_mean_and_spread():
    net = agent()
    x = torch.randn(7, 11, 2) * torch.tensor([1e4, 1e-3]) + torch.tensor([5e4, 2.0])
    for part in x.split([1, 2, 4]):
        net.see(part)
    z = net.normalise(x).flatten(0, 1)
    torch.testing.assert_close(z.mean(0), torch.zeros(2), atol=1e-3, rtol=0)
    torch.testing.assert_close(z.std(0, correction=0), torch.ones(2), atol=1e-3, rtol=0)


def test_an_observation_that_stays_the_same_is_normalised_to_nothing_in_any_precision():
    net = agent()
    net.see(torch.stack([torch.randn(100), torch.full((100,), 2.45)], dim=-1))
    seen = (np.array([0.0, 2.45]) - net.observation_offset.double().numpy()) / net.observation_scale.double().numpy()
    assert abs(seen[1]) < 1e-3


def test_without_an_ended_episode_the_best_agent_is_the_last_after_a_break_too(tmp_path):
    options = {"checkpoint": tmp_path / "training.pt", "steps": 2}
    short(agent(), env=DoubleIntegrator(horizon=99), iterations=2, **options)
    again = short(agent(), env=DoubleIntegrator(horizon=99), iterations=3, **options)
    assert again.best is again.agent
    assert "0 episodes ended, too few" in again.describe()


@pytest.mark.parametrize(("skip", "imitates", "keep"), [(True, True, None), (False, True, None), (True, False, True)])
def test_new_scales_leave_an_agent_that_imitates_or_is_to_be_kept_as_it_was(skip, imitates, keep):
    shape = NetworkConfig(skip=skip, std_network=True)
    net = ActorCritic([-1, -1], [1, 1], [-2], [2], config=shape, imitates=imitates)
    torch.nn.init.normal_(net.std_network.head.weight)
    x = torch.randn(50, 2) * torch.tensor([30.0, 1e-3]) + torch.tensor([70.0, 2.0])
    answers = (net.latent, net.value, net.std)
    before = [answer(x).detach() for answer in answers]
    for part in x[:20], x[20:]:
        net.see(part, keep=keep)
    for answer, same in zip(answers, before):
        torch.testing.assert_close(answer(x).detach(), same, atol=1e-3, rtol=1e-3)


def test_the_episodes_that_end_first_do_not_say_which_agent_is_best():
    class Costly(DoubleIntegrator):
        """Every step costs 1, and two of eight environments end early."""

        def step(self, actions):
            *_, ends = result = super().step(actions)
            early = torch.arange(8) < 2
            return (*result[:2], torch.full((8,), -1.0), early & (self.k % 5 == 0), ends)

    result = short(agent(), env=Costly(horizon=60), iterations=9, steps=15)
    assert [row.judged for row in result.rows][:3] == [False] * 3
    assert all(row.mean_return < -10 for row in result.rows if row.judged)
    assert result.rows[0].mean_return == pytest.approx(-5)


@pytest.mark.long
def test_recent_returns_do_not_swing_with_the_time_limit_that_all_episodes_share():
    class Half(DoubleIntegrator):
        """Every step costs 1; half of the environments end every five steps, and all at the time limit."""

        def step(self, actions):
            *_, ends = result = super().step(actions)
            early = (torch.arange(8) < 4) & (self.k % 5 == 0)
            return (*result[:2], torch.full((8,), -1.0), early & ~ends, ends)

    rows = short(agent(), env=Half(horizon=40), iterations=30, steps=8).rows
    judged = [row.mean_return for row in rows if row.judged]
    assert len(judged) > 15
    assert np.ptp(judged) < 1  # every 40 steps 32 episodes of five steps end and four of 40: −8.9 in the mean


@pytest.mark.long
def test_episodes_that_grow_longer_are_judged_by_those_that_have_ended():
    class Growing(DoubleIntegrator):
        """All end together, first after five steps, then after 40."""

        def step(self, actions):
            self.total = getattr(self, "total", 0) + 1
            *_, ends = result = super().step(actions)
            return (*result[:4], torch.full_like(ends, self.total == 5 or (self.total > 5 and self.total % 40 == 5)))

    rows = short(agent(), env=Growing(horizon=10**6, runs=32), iterations=30, steps=4).rows
    assert sum(row.judged for row in rows) > 20
    assert not any(np.isnan(row.mean_return) for row in rows if row.judged)


BROKEN = {
    "a reward that is no number": (2, lambda r: r * float("nan"), "rewards"),
    "rewards of another shape": (2, lambda r: r[:-1], "rewards of shape"),
    "observations that are endless": (0, lambda x: x * float("inf"), "observations"),
    "ends that are numbers": (3, lambda e: e.float(), "ends of episodes"),
}


@pytest.mark.parametrize("name", BROKEN)
def test_experience_that_breaks_its_word_changes_nothing(tmp_path, name):
    part, change, message = BROKEN[name]

    class Breaking(DoubleIntegrator):
        steps = 0

        def step(self, actions):
            self.steps += 1
            result = list(super().step(actions))
            result[part] = change(result[part]) if self.steps == 40 else result[part]
            return tuple(result)

    net, file = agent(), tmp_path / "training.pt"
    seen = []
    with pytest.raises(InputError, match=f"env: got (the )?{message}"):
        short(net, env=Breaking(), checkpoint=file, callback=lambda row: seen.append(weights(net)))
    assert len(seen) == 1
    assert torch.equal(weights(net), seen[0])


def test_an_update_that_is_not_finite_leaves_the_agent_as_it_was():
    net = agent()
    start = weights(net)
    with pytest.raises(DivergedError, match=r"Update 0 .* smaller learning_rate"):
        short(net, config=PPOConfig(learning_rate=1e30, kl_limit=float("inf")))
    assert torch.equal(weights(net), start)


def test_an_interrupted_update_leaves_the_agent_as_it_was():
    class Interrupted(ActorCritic):
        calls = 0

        def value(self, observations):
            self.calls += 1
            if self.calls == 6:  # the fourth gradient step
                raise KeyboardInterrupt
            return super().value(observations)

    net = Interrupted([-1, -1], [1, 1], [-1], [1])
    start = weights(net)
    with pytest.raises(KeyboardInterrupt):
        short(net)
    assert net.calls == 6
    assert torch.equal(weights(net), start)


def test_a_state_stays_as_it_is_while_the_training_goes_on():
    collector = Collector(DoubleIntegrator(), agent(), generator=generator())
    collector.rollout(15)
    state = collector.state()
    first = collector.rollout(25)
    collector.restore(state)
    again = collector.rollout(25)
    assert torch.equal(first.rewards, again.rewards)
    collector.restore(state)
    assert len(collector.ended) == len(state["ended"]) == 0


def test_one_sample_is_enough_for_an_update():
    net = agent()
    short(net, env=DoubleIntegrator(runs=1), iterations=2, steps=1)
    assert weights(net).isfinite().all()


@pytest.mark.parametrize("skip", [True, False])
def test_another_unit_of_values_leaves_the_values_as_they_were(skip):
    net = agent(skip=skip)
    x = torch.randn(50, 2)
    before = net.value(x).detach()
    net.rescale_values(torch.tensor(-30.0), torch.tensor(12.0))
    torch.testing.assert_close(net.value(x).detach(), before, atol=1e-5, rtol=1e-5)


def test_an_agent_from_scratch_begins_in_the_middle_and_explores_the_whole_range():
    net = ActorCritic([-1, -1], [1, 1], [0.0], [8.0])
    x = 2 * torch.rand(200, 2) - 1
    assert (net(x) - 4.0).abs().max() < 0.2
    assert net.distribution(x).stddev.unique().item() == pytest.approx(1.0)
    again = ActorCritic([-1, -1], [1, 1], [0.0], [8.0])
    assert torch.equal(weights(again), weights(net))


def test_settings_are_chosen_by_how_the_agent_was_made():
    scratch = short(agent())
    assert scratch.config == PPOConfig()
    assert "learned from scratch" in scratch.describe()
    x = np.random.default_rng(0).uniform(-1, 1, (64, 2))
    options = {"action_bounds": ([-2], [2]), "config": CloningConfig(steps=20), "rng": np.random.default_rng(0)}
    clone = fit_actor_critic(x, -x[:, :1], np.zeros(64), **options)
    refined = short(clone)
    assert refined.config == PPOConfig.warm()
    assert "imitates an expert" in refined.describe()
    assert clone.log_std.exp().item() == pytest.approx(0.1)


def test_rows_say_what_every_update_did():
    seen = []
    result = short(agent(), callback=seen.append)
    assert tuple(seen) == result.rows
    assert [row.samples for row in result.rows] == [240, 480, 720, 960]
    for row in result.rows:
        update = row.update
        assert 0 <= update.clip_fraction <= 1
        assert np.isfinite([update.kl, update.entropy, update.gradient_norm, update.explained_variance]).all()
    assert result.rows[0].update.entropy == pytest.approx(0.5 * np.log(2 * np.pi * np.e * 0.3**2), abs=0.1)


def test_an_update_whose_first_step_ends_its_passes_is_none_of_the_critic_alone():
    net = agent()
    result = short(net, iterations=2, config=PPOConfig(learning_rate=0.3, critic_only=1, kl_limit=1e-3))
    critic, actor = (row.update for row in result.rows)
    assert np.isnan(critic.gradient_norm)
    assert actor.passes == 2
    assert actor.kl > 1e-3
    assert actor.gradient_norm > 0
    assert "2 updates, 1 of them of the critic alone" in result.describe()


def test_the_best_agent_is_kept_beside_the_last():
    seen = []
    net = agent()

    def keep(row):
        seen.append((row.mean_return, weights(net)))

    start = weights(net)
    result = short(net, iterations=6, callback=keep, config=PPOConfig(learning_rate=0.3, kl_limit=float("inf")))
    before = [start, *(w for _, w in seen)]  # the agent that made the rollout of each row
    best = int(np.argmax([value for value, _ in seen]))
    assert best < 5  # these rates spoil it
    assert torch.equal(weights(result.best), before[best])
    assert torch.equal(weights(result.agent), before[-1])
    assert result.agent is net


@pytest.mark.long
def test_a_broken_training_goes_on_with_the_same_numbers(tmp_path):
    whole, broken = agent(), agent()
    result = short(whole, iterations=6)

    class Killed(Exception):
        pass

    def kill(row):
        if row.iteration == 2:
            raise Killed

    file = tmp_path / "training.pt"
    with pytest.raises(Killed):
        short(broken, iterations=6, checkpoint=file, callback=kill)
    again = short(agent(seed=3), iterations=6, checkpoint=file, env=DoubleIntegrator(seed=5), generator=generator(9))
    assert torch.equal(weights(again.agent), weights(whole))
    assert torch.equal(weights(again.best), weights(result.best))
    assert again.rows == result.rows


KILLED = """
import os, signal, sys
import torch
from toys import DoubleIntegrator, agent
from learning import train

where, count, file = sys.argv[1], int(sys.argv[2]), sys.argv[3]
owner = {"replace": os, "step": DoubleIntegrator}[where]
own = getattr(owner, where)

def killing(*given):
    global count
    count -= 1
    if count == 0:
        os.kill(os.getpid(), signal.SIGKILL)
    return own(*given)

setattr(owner, where, killing)
torch.set_num_threads(1)
train(DoubleIntegrator(), agent(), iterations=6, steps=30, generator=torch.Generator().manual_seed(1), checkpoint=file)
"""


@pytest.mark.long
@pytest.mark.skipif(sys.platform == "win32", reason="signals")
@pytest.mark.parametrize(("where", "count"), [("replace", 3), ("step", 100)], ids=["while writing", "in a rollout"])
def test_a_training_that_is_killed_goes_on_with_the_same_numbers(tmp_path, where, count):
    file = tmp_path / "training.pt"
    path = os.pathsep.join(filter(None, sys.path))
    command = [sys.executable, "-c", KILLED, where, str(count), str(file)]
    done = subprocess.run(command, env=os.environ | {"PYTHONPATH": path}, capture_output=True, text=True)
    assert done.returncode == -signal.SIGKILL, done.stderr
    whole, rows = agent(), []
    result = short(whole, iterations=6)
    again = short(agent(seed=3), iterations=6, checkpoint=file, callback=rows.append)
    assert torch.equal(weights(again.agent), weights(whole))
    assert torch.equal(weights(again.best), weights(result.best))
    assert again.rows == result.rows
    assert 0 < len(rows) < 6  # some were done before


def test_a_training_that_cannot_be_resumed_says_why(tmp_path):
    file = tmp_path / "training.pt"

    class Plain:
        def __init__(self):
            env = DoubleIntegrator()
            self.reset, self.step = env.reset, env.step

    with pytest.raises(InputError, match="expected methods state"):
        short(agent(), env=Plain(), checkpoint=file)
    short(agent(), checkpoint=file)
    with pytest.raises(CheckpointError, match="a training with PPOConfig"):
        short(agent(), checkpoint=file, config=PPOConfig(clip=0.1))
    frozen = agent()
    frozen.log_std.requires_grad_(False)
    for other in (agent((5,)), frozen):
        with pytest.raises(CheckpointError, match="a checkpoint of a training of this agent"):
            short(other, checkpoint=file)
    stronger = agent()
    stronger.action_scale *= 2
    with pytest.raises(CheckpointError, match="an agent with actions"):
        short(stronger, checkpoint=file)
    file.write_bytes(b"no checkpoint")
    with pytest.raises(CheckpointError, match="a checkpoint of a training of this agent"):
        short(agent(), checkpoint=file)


@pytest.mark.parametrize("argument", ["callback", "checkpoint"])
def test_a_number_is_no_callback_and_no_file(argument):
    with pytest.raises(InputError, match=f"{argument}: got 3"):
        short(agent(), **{argument: 3})


@pytest.mark.parametrize("device", ["nowhere", [], 1.5])
def test_a_device_that_is_not_there_is_refused(device):
    with pytest.raises(InputError, match="device: got"):
        short(agent(), device=device)


def test_entropy_and_clipped_values_are_options():
    plain, wide, clipped = agent(), agent(), agent()
    short(plain, iterations=2)
    short(wide, iterations=2, config=PPOConfig(entropy_coefficient=0.5))
    short(clipped, iterations=2, config=PPOConfig(value_clip=1e-3))
    assert wide.log_std.item() > plain.log_std.item()
    x = torch.randn(100, 2)
    start = copy.deepcopy(agent()).value(x)
    assert (clipped.value(x) - start).abs().mean() < (plain.value(x) - start).abs().mean()
