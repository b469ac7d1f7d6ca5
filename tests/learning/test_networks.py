"""The actor-critic: units, clipping, initialisation."""

import numpy as np
import pytest
import torch
from toys import agent

from learning import ActorCritic, LearningError, NetworkConfig
from learning.exceptions import InputError


def test_observations_at_the_bounds_become_plus_and_minus_one():
    net = ActorCritic([-2, 10], [4, 30], [-1], [1])
    z = net.normalise(torch.tensor([[-2.0, 10.0], [4.0, 30.0], [1.0, 20.0]]))
    torch.testing.assert_close(z, torch.tensor([[-1.0, -1.0], [1.0, 1.0], [0.0, 0.0]]))


def test_a_latent_of_one_is_the_upper_action_bound_and_beyond_it_is_clipped():
    net = ActorCritic([-1], [1], [-3.0, 0.0], [5.0, 10.0])
    latent = torch.tensor([[1.0, 1.0], [-1.0, -1.0], [7.0, -7.0], [0.0, 0.0]])
    torch.testing.assert_close(net.action(latent), torch.tensor([[5.0, 10.0], [-3.0, 0.0], [5.0, 0.0], [1.0, 5.0]]))


def test_a_leak_gives_a_gradient_outside_the_clip_and_changes_nothing_inside():
    net = agent()
    latent = torch.tensor([[0.5], [3.0]], requires_grad=True)
    action = net.action(latent, leak=0.01)
    torch.testing.assert_close(action.detach(), torch.tensor([[1.0], [2.0 * (1 + 0.01 * 2)]]))
    (gradient,) = torch.autograd.grad(action.sum(), latent)
    torch.testing.assert_close(gradient, torch.tensor([[2.0], [0.02]]))


def test_without_a_leak_a_clipped_action_has_no_gradient():
    latent = torch.tensor([[3.0]], requires_grad=True)
    (gradient,) = torch.autograd.grad(agent().action(latent).sum(), latent)
    assert gradient.item() == 0.0


def test_values_are_in_the_units_of_the_return():
    net = agent()
    x = torch.randn(5, 2)
    before = net.value(x)
    net.value_scale.fill_(10.0)
    net.value_offset.fill_(-40.0)
    torch.testing.assert_close(net.value(x), -40 + 10 * before)
    assert net.value(x).shape == (5,)


@pytest.mark.parametrize("std_network", [False, True])
def test_the_exploration_starts_at_the_configured_width_everywhere(std_network):
    net = agent(std=0.07, std_network=std_network)
    distribution = net.distribution(torch.randn(6, 2))
    assert distribution.stddev.shape == (6, 1)
    torch.testing.assert_close(distribution.stddev, torch.full((6, 1), 0.07))


def test_an_exploration_network_replaces_the_free_number():
    net = agent(std_network=True)
    names = {id(p) for p in net.actor_parameters()}
    assert id(net.log_std) not in names
    assert all(id(p) in names for p in net.std_network.parameters())


def test_actor_and_critic_share_no_weights():
    net = agent(std_network=True)
    assert not {id(p) for p in net.actor_parameters()} & {id(p) for p in net.value_network.parameters()}


def test_the_seed_decides_the_weights_and_the_global_generator_is_left_alone():
    torch.manual_seed(5)
    expected = torch.rand(3)
    torch.manual_seed(5)
    first, second, other = agent(seed=3), agent(seed=3), agent(seed=4)
    torch.testing.assert_close(torch.rand(3), expected)
    x = torch.randn(4, 2)
    torch.testing.assert_close(first.latent(x), second.latent(x))
    assert not torch.allclose(first.latent(x), other.latent(x))


def test_a_network_rebuilt_from_its_shape_takes_the_same_weights():
    net = agent(hidden=(7, 5), std_network=True)
    again = ActorCritic.from_shape(net.shape())
    again.load_state_dict(net.state_dict())
    x = torch.randn(4, 2)
    torch.testing.assert_close(again.latent(x), net.latent(x))
    torch.testing.assert_close(again.action_scale, net.action_scale)
    assert again.config == net.config


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: NetworkConfig(()), r"hidden: got \(\), expected at least one layer"),
        (lambda: NetworkConfig((8, 0)), r"hidden: got \(8, 0\)"),
        (lambda: NetworkConfig(initial_std=0.0), "initial_std: got 0.0, expected a finite number above 0"),
        (lambda: NetworkConfig(initial_std=float("nan")), "initial_std: got nan"),
        (lambda: ActorCritic([1], [0], [-1], [1]), "observation_upper: got .* expected finite lower < upper"),
        (lambda: ActorCritic([0], [1], [-np.inf], [1]), "action_upper: got .* expected finite lower < upper"),
        (lambda: ActorCritic([0, 0], [1], [-1], [1]), "observation_lower, observation_upper"),
    ],
)
def test_bad_shapes_and_bounds_are_refused_in_one_line(make, message):
    with pytest.raises(InputError, match=message) as caught:
        make()
    assert isinstance(caught.value, LearningError)
    assert isinstance(caught.value, ValueError)
    assert "\n" not in str(caught.value)


class Widening:
    """Two actions whose bounds grow with the last two observations."""

    entries = 2
    box = (np.array([-4.0, -1.0]), np.array([2.0, 9.0]))

    def bounds(self, p):
        return -p * p.new_tensor([2.0, 0.5]), p * p.new_tensor([1.0, 4.5])

    def as_dict(self):
        return {"kind": "widening"}


def test_actions_fill_bounds_that_depend_on_the_observation():
    net = ActorCritic([-1] * 3, [1] * 3, *Widening.box, action_limits=Widening())
    seen = torch.tensor([[9.0, 2.0, 1.0], [-9.0, 0.5, 2.0]], requires_grad=True)
    torch.testing.assert_close(net.action(torch.full((2, 2), 7.0), seen), torch.tensor([[2.0, 4.5], [0.5, 9.0]]))
    low = net.action(torch.full((2, 2), -7.0), seen)
    torch.testing.assert_close(low, torch.tensor([[-4.0, -0.5], [-1.0, -1.0]]))
    (slope,) = torch.autograd.grad(low.sum(), seen)
    torch.testing.assert_close(slope, torch.tensor([[0.0, -2.0, -0.5]] * 2))
    with pytest.raises(InputError, match="observations"):
        net.action(torch.zeros(2, 2))


@pytest.mark.parametrize(("wanted", "given"), [(1e-4, np.exp(-7)), (0.01, 0.01), (2.0, 2.0), (20.0, np.e)])
def test_a_network_explores_between_e_to_the_minus_seven_and_e(wanted, given):
    config = NetworkConfig((3,), initial_std=wanted, std_network=True)
    agent = ActorCritic([-1.0], [1.0], [-1.0], [1.0], config=config, seed=0)
    assert agent.std(torch.zeros(1, 1)).item() == pytest.approx(given, rel=1e-5)
