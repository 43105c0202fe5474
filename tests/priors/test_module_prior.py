"""Claims about priors made of networks."""

from __future__ import annotations

from copy import deepcopy
from pathlib import Path
from typing import Any

import pytest
import torch
from teacher_cases import ACTIONS, OBS, Pair, observations
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torch import distributions as d
from torch import nn
from torchrl.modules import IndependentNormal, ProbabilisticActor

from torchrl_priors import ActionPrior, AffordancePrior, BoltzmannPrior, ModulePrior


class TestModulePrior:
    def test_each_output_is_the_distribution_it_says(self) -> None:
        batch, net, pair = observations(6), nn.Linear(OBS, ACTIONS), Pair()
        x = batch["observation"]
        with torch.no_grad():
            logits, (mean, std) = net(x), pair(x)
            discrete, normal = d.Categorical(logits=logits), d.Independent(d.Normal(mean, std), 1)
            same_net = nn.Sequential(net, nn.Softmax(-1))
            pair_normal, pair_categorical = Pair("normal"), Pair("categorical")
            pair_normal.load_state_dict(pair.state_dict())
            pair_categorical.load_state_dict(pair.state_dict())
        index, action = torch.tensor([0, 1, 2, 3, 0, 1]), torch.randn(6, ACTIONS)
        for prior, taken, expected in (
            (ModulePrior(net, "logits"), index, discrete.log_prob(index)),
            (ModulePrior(same_net, "probs"), index, discrete.log_prob(index)),
            (ModulePrior(net, "mean", std=0.5), action, d.Normal(logits, 0.5).log_prob(action).sum(-1)),
            (ModulePrior(pair, "mean_std"), action, normal.log_prob(action)),
            (
                ModulePrior(pair_normal, "distribution", distribution_class=IndependentNormal),
                action,
                normal.log_prob(action),
            ),
            (
                ModulePrior(pair_categorical, "distribution", distribution_class=d.Categorical),
                index,
                d.Categorical(logits=mean).log_prob(index),
            ),
        ):
            torch.testing.assert_close(prior.log_prob(batch.set("action", taken)), expected)

    @pytest.mark.parametrize("shape", [(), (6,), (2, 3), (1, 2, 3), (2, 0)])
    def test_a_network_written_for_one_batch_dimension_advises_on_any(self, shape: tuple[int, ...]) -> None:
        class Images(nn.Sequential):
            def forward(self, x: torch.Tensor) -> torch.Tensor:
                assert x.ndim == 4
                return super().forward(x)

        prior = ModulePrior(Images(nn.Conv2d(1, 2, 3), nn.Flatten(), nn.Softmax(dim=1)), "probs")
        flat = torch.randn(torch.Size(shape).numel(), 1, 5, 5)
        expected = prior.get_dist(TensorDict(observation=flat, batch_size=flat.shape[:1])).logits
        found = prior.get_dist(TensorDict(observation=flat.reshape(*shape, 1, 5, 5), batch_size=shape)).logits
        torch.testing.assert_close(found, expected.reshape(*shape, 18))

    def test_a_module_prior_is_frozen_and_a_copy(self) -> None:
        net, batch = nn.Linear(OBS, ACTIONS), observations(5)
        prior = ModulePrior(net, "logits")
        before = prior.get_dist(batch).logits
        with torch.no_grad():
            net.weight.add_(1)
        assert torch.equal(prior.get_dist(batch).logits, before)
        assert not any(parameter.requires_grad for parameter in prior.parameters())
        inverse = 1 / prior.get_dist(batch).probs
        torch.testing.assert_close(prior.adversary().get_dist(batch).probs, inverse / inverse.sum(-1, keepdim=True))

    @pytest.mark.parametrize("kind", ["script", "trace", "freeze", "file", "pair"])
    def test_a_module_prior_takes_a_policy_of_torchscript(self, kind: str, tmp_path: Path) -> None:
        net: nn.Module = (
            Pair() if kind == "pair" else nn.Sequential(nn.Linear(OBS, 8), nn.Dropout(), nn.Linear(8, ACTIONS))
        )
        eager = net.eval() if kind in ("trace", "freeze", "pair") else net
        policy = torch.jit.trace(eager, torch.zeros(1, OBS)) if kind in ("trace", "pair") else torch.jit.script(eager)
        if kind == "freeze":
            policy = torch.jit.freeze(policy)
        if kind == "file":
            torch.jit.save(policy, tmp_path / "policy.pt")
            policy = torch.jit.load(tmp_path / "policy.pt")
        told: dict[str, Any] = {"output": "mean_std"} if kind == "pair" else {"output": "mean", "std": 0.5}
        prior, expected = ModulePrior(policy, **told), ModulePrior(net, **told)
        batch = observations(2, 3)
        before = expected.get_dist(batch).mean
        for twin in (prior, deepcopy(prior), ModulePrior(policy, **told)):
            torch.testing.assert_close(twin.get_dist(batch).mean, before)  # without dropout
            assert not any(parameter.requires_grad for parameter in twin.parameters())
        if kind != "freeze":
            with torch.no_grad():
                next(policy.parameters()).add_(1)
            torch.testing.assert_close(prior.get_dist(batch).mean, before)
            assert all(parameter.requires_grad for parameter in policy.parameters())
        batch["action"] = torch.zeros(2, 3, ACTIONS)
        torch.testing.assert_close(prior.log_prob(batch), expected.log_prob(batch))

    def test_bad_input_of_a_module_prior_is_refused(self) -> None:
        net = nn.Linear(OBS, ACTIONS)
        for error, match, make in (
            (TypeError, "CallablePrior", lambda: ModulePrior(lambda x: x, "mean", std=1.0)),
            (TypeError, "ActionPrior", lambda: ModulePrior(TensorDictModule(net, ["a"], ["b"]), "logits")),
            (ValueError, "Unknown output", lambda: ModulePrior(net, "action")),
            (ValueError, "pass std", lambda: ModulePrior(net, "mean")),
            (ValueError, "of no use", lambda: ModulePrior(net, "logits", std=1.0)),
            (ValueError, "positive", lambda: ModulePrior(net, "mean", std=0.0)),
            (ValueError, "distribution_class", lambda: ModulePrior(net, "distribution")),
        ):
            with pytest.raises(error, match=match):
                make()
        with pytest.raises(TypeError, match="must return a tensor"):
            ModulePrior(Pair(), "logits").get_dist(observations(2))
        with pytest.raises(TypeError, match="must return a pair"):
            ModulePrior(net, "mean_std").get_dist(observations(2))
        with pytest.raises(TypeError, match="diagonal Gaussian"):
            ModulePrior(Pair("categorical"), "distribution", distribution_class=IndependentNormal).get_dist(
                observations(2)
            )
        with pytest.raises(ValueError, match="action space of the prior differs"):
            ModulePrior(net, "logits").log_prob(observations(2).set("action", torch.zeros(2, 4)))


def actor_of(network: nn.Module) -> ActionPrior:
    module = TensorDictModule(network, in_keys=["observation"], out_keys=["logits"])
    return ActionPrior(ProbabilisticActor(module, in_keys=["logits"], distribution_class=d.Categorical))


@pytest.mark.filterwarnings("ignore:`torch.jit:DeprecationWarning")
@pytest.mark.parametrize("make", [ActionPrior, BoltzmannPrior, AffordancePrior])
@pytest.mark.parametrize("kind", ["script", "trace"])
def test_networks_of_torchscript_advise_and_are_copied(make: Any, kind: str) -> None:
    make = actor_of if make is ActionPrior else make
    net = nn.Sequential(nn.Linear(OBS, ACTIONS), nn.Dropout(), nn.Softplus()).eval()
    script = torch.jit.script(net) if kind == "script" else torch.jit.trace(net, torch.zeros(1, OBS))
    batch, expected = observations(2, 3), make(net)
    prior = make(script)
    with torch.no_grad():
        next(script.parameters()).add_(1)
    for twin in (prior, deepcopy(prior)):
        torch.testing.assert_close(twin.get_dist(batch).logits, expected.get_dist(batch).logits)
        assert not any(parameter.requires_grad for parameter in twin.parameters())
    assert all(parameter.requires_grad for parameter in script.parameters())
