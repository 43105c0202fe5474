"""Claims about the networks of the MuJoCo experiments."""

from __future__ import annotations

import math
from typing import Any

import pytest
import torch
from tensordict import TensorDict
from torch import nn
from torchrl.modules import IndependentNormal
from torchrl.objectives import ClipPPOLoss

from torchrl_priors.distributions import cross_entropy
from torchrl_priors.networks import ACTIVATIONS, GaussianMLP, make_actor, make_critic, make_prior_weight

OBS, ACTIONS = 5, 3


def observations(*batch: int, key: Any = "observation_norm") -> TensorDict:
    return TensorDict({key: torch.randn(*batch, OBS)}, batch_size=batch)


def linears(module: nn.Module) -> list[nn.Linear]:
    return [child for child in module.modules() if isinstance(child, nn.Linear)]


MAKERS = {
    "actor": lambda **kwargs: make_actor(OBS, ACTIONS, **kwargs),
    "critic": lambda **kwargs: make_critic(OBS, **kwargs),
    "prior_weight": lambda **kwargs: make_prior_weight(OBS, **kwargs),
}


@pytest.fixture(params=MAKERS)
def make(request: pytest.FixtureRequest) -> Any:
    return MAKERS[request.param]


class TestMakeActor:
    def test_an_actor_writes_what_a_collector_and_ppo_expect(self) -> None:
        batch = make_actor(OBS, ACTIONS)(observations(2, 4))
        assert set(batch.keys()) == {"observation_norm", "loc", "scale", "action", "action_log_prob"}
        assert batch["action"].shape == batch["loc"].shape == batch["scale"].shape == (2, 4, ACTIONS)
        assert batch["action_log_prob"].shape == (2, 4)

    def test_a_discrete_one_starts_near_the_uniform_policy_over_indices(self) -> None:
        actor = make_actor(OBS, ACTIONS, discrete=True)
        batch = actor(observations(100))
        assert set(batch.keys()) == {"observation_norm", "logits", "action", "action_log_prob"}
        assert batch["action"].shape == (100,)
        assert set(batch["action"].tolist()) == set(range(ACTIONS))
        assert actor.get_dist(batch).probs.sub(1 / ACTIONS).abs().max() < 0.05

    def test_log_prob_is_that_of_the_unbounded_gaussian(self) -> None:
        with torch.no_grad():
            batch = make_actor(OBS, ACTIONS)(observations(4))
        action = batch["action"] + 5  # far out of any action space
        expected = torch.distributions.Normal(batch["loc"], batch["scale"]).log_prob(action).sum(-1)
        dist = make_actor(OBS, ACTIONS).build_dist_from_params(batch)
        assert isinstance(dist, IndependentNormal)
        torch.testing.assert_close(dist.log_prob(action), expected)

    def test_starts_near_the_standard_normal_in_every_state(self) -> None:
        batch = make_actor(OBS, ACTIONS)(observations(100))
        assert batch["loc"].abs().max() < 0.1
        assert batch["loc"].std() > 0
        assert (batch["scale"] == 1).all()

    def test_standard_deviation_is_the_same_in_every_state_and_learned(self) -> None:
        actor = make_actor(OBS, ACTIONS)
        net = next(module for module in actor.modules() if isinstance(module, GaussianMLP))
        with torch.no_grad():
            net.scale.state_independent_scale.copy_(torch.tensor([-1.0, 0.0, 1.0]))
        batch = actor(observations(6))
        torch.testing.assert_close(batch["scale"], torch.tensor([-1.0, 0.0, 1.0]).exp().expand(6, 3))
        batch["scale"].sum().backward()
        assert (net.scale.state_independent_scale.grad != 0).all()

    def test_an_actor_reads_a_nested_key(self) -> None:
        key = ("agent", "observation")
        assert make_actor(OBS, ACTIONS, in_key=key)(observations(4, key=key))["action"].shape == (4, ACTIONS)

    def test_cross_entropy_of_two_actors_is_exact(self) -> None:
        batch = observations(4)
        student, teacher = (make_actor(OBS, ACTIONS).get_dist(batch.clone()) for _ in range(2))
        kl = 0.5 * (student.mean - teacher.mean).square().sum(-1)  # of unit variances
        entropy = ACTIONS * 0.5 * (1 + math.log(2 * math.pi))
        torch.testing.assert_close(cross_entropy(student, teacher), kl + entropy)

    @pytest.mark.parametrize("functional", [False, True])
    def test_an_actor_trains_in_ppo(self, functional: bool) -> None:
        actor, critic = make_actor(OBS, ACTIONS), make_critic(OBS)
        loss = ClipPPOLoss(actor, critic, functional=functional, entropy_coeff=0.0)
        with torch.no_grad():
            batch = critic(actor(observations(8)))
        batch["advantage"] = torch.randn(8, 1)
        batch["value_target"] = torch.randn(8, 1)
        out = loss(batch)
        (out["loss_objective"] + out["loss_critic"]).backward()
        gradients = [parameter.grad for parameter in (*actor.parameters(), *critic.parameters())]
        assert all(gradient is not None and gradient.isfinite().all() for gradient in gradients)


class TestMakeCritic:
    def test_a_critic_writes_one_value_a_state(self) -> None:
        assert make_critic(OBS)(observations(2, 4))["state_value"].shape == (2, 4, 1)

    def test_several_critics_write_their_own_keys(self) -> None:
        batch = make_critic(OBS, out_key="raw_value")(make_critic(OBS)(observations(4)))
        assert (batch["raw_value"] != batch["state_value"]).all()


class TestMakePriorWeight:
    @pytest.mark.parametrize("init_bias", [0.0, -2.0, -4.0])
    def test_starts_near_the_sigmoid_of_its_bias_in_every_state(self, init_bias: float) -> None:
        weight = make_prior_weight(OBS, init_bias=init_bias)(observations(100))["prior_weight"]
        assert weight.shape == (100, 1)
        assert weight.std() > 0
        expected = torch.full_like(weight, init_bias).sigmoid()
        torch.testing.assert_close(weight, expected, atol=0.02, rtol=0)

    def test_a_prior_weight_has_the_architecture_of_the_critic(self) -> None:
        shapes = [[parameter.shape for parameter in net.parameters()] for net in (make_critic(7), make_prior_weight(7))]
        assert shapes[0] == shapes[1]


class TestEveryNetwork:
    def test_every_network_has_orthogonal_weights_and_no_bias_at_first(self, make: Any) -> None:
        layers = linears(make(hidden=(8, 8)))
        assert len(layers) == 3
        for layer in layers[:2]:
            small = layer.weight if layer.weight.shape[0] <= layer.weight.shape[1] else layer.weight.T
            torch.testing.assert_close(small @ small.T, 2 * torch.eye(len(small)), atol=1e-5, rtol=0)
        assert all((layer.bias == 0).all() for layer in layers)

    @pytest.mark.parametrize(("name", "gain"), [("actor", 0.01), ("critic", 1.0), ("prior_weight", 0.01)])
    def test_last_layer_has_the_gain_of_its_role(self, name: str, gain: float) -> None:
        weight = linears(MAKERS[name]())[-1].weight
        torch.testing.assert_close(weight @ weight.T, gain**2 * torch.eye(len(weight)), atol=1e-6, rtol=1e-4)

    @pytest.mark.parametrize(("name", "activation"), sorted(ACTIVATIONS.items()))
    def test_every_network_has_the_sizes_and_the_activation_it_was_given(
        self, make: Any, name: str, activation: type
    ) -> None:
        net = make(hidden=(8, 4, 2), activation=name)
        assert [layer.out_features for layer in linears(net)][:3] == [8, 4, 2]
        assert sum(type(module) is activation for module in net.modules()) == 3

    def test_reproduces_from_a_generator_alone(self, make: Any) -> None:
        first, same, other = (
            torch.cat([p.flatten() for p in make(generator=torch.Generator().manual_seed(seed)).parameters()])
            for seed in (0, 0, 1)
        )
        assert torch.equal(first, same)
        assert not torch.equal(first, other)

    @pytest.mark.parametrize("activation", ["Tanh", "softmax", ""])
    def test_unknown_activation_is_an_error(self, make: Any, activation: str) -> None:
        with pytest.raises(ValueError, match=r"Unknown activation .*tanh"):
            make(activation=activation)

    @pytest.mark.parametrize("hidden", [(0,), (64, -1), (64, 2.0), (True,), ("64",)])
    def test_impossible_size_is_an_error(self, make: Any, hidden: Any) -> None:
        with pytest.raises(ValueError, match="positive integer sizes"):
            make(hidden=hidden)
