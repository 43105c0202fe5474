"""Claims about priors made of networks, functions, affordances, and mixtures."""

from __future__ import annotations

import math
import threading
from copy import deepcopy
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torch import distributions as d
from torch import nn
from torchrl.envs import GymEnv
from torchrl.modules import IndependentNormal, OneHotCategorical, ProbabilisticActor, TanhNormal

from torchrl_priors import (
    ActionPrior,
    AffordancePrior,
    BoltzmannPrior,
    CallablePrior,
    MixturePrior,
    ModulePrior,
    RandomDegradation,
    StructuralDegradation,
    UniformPrior,
)
from torchrl_priors.distributions import cross_entropy

OBS, ACTIONS = 3, 4


def observations(*batch: int) -> TensorDict:
    return TensorDict(observation=torch.randn(*batch, OBS), batch_size=batch)


class Pair(nn.Module):
    """A policy in plain PyTorch."""

    def __init__(self, kind: str = "mean_std") -> None:
        super().__init__()
        self.mean, self.log_std, self.kind = nn.Linear(OBS, ACTIONS), nn.Linear(OBS, ACTIONS), kind

    def forward(self, observation: torch.Tensor) -> Any:
        mean, std = self.mean(observation), self.log_std(observation).exp()
        if self.kind == "normal":
            return d.Independent(d.Normal(mean, std), 1)
        return d.Categorical(logits=mean) if self.kind == "categorical" else (mean, std)


def table(seed: int = 0, states: int = 5) -> torch.Tensor:
    return torch.rand(states, ACTIONS, generator=torch.Generator().manual_seed(seed))


def states(*values: int) -> TensorDict:
    return TensorDict(state=torch.tensor(values), batch_size=[len(values)])


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

    def test_it_is_frozen_and_a_copy(self) -> None:
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
    def test_a_policy_of_torchscript(self, kind: str, tmp_path: Path) -> None:
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

    def test_bad_input_is_refused(self) -> None:
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


class TestCallablePrior:
    def test_a_bot_that_changes_its_observations_leaves_the_batch_alone(self) -> None:
        def bot(observation: np.ndarray) -> int:
            observation *= 0
            return 1

        batch = observations(6)
        before = batch["observation"].clone()
        CallablePrior(bot, num_actions=ACTIONS, epsilon=0.1).get_dist(batch)
        assert torch.equal(batch["observation"], before)

    def test_a_method_of_what_cannot_be_copied(self) -> None:
        class Bot:
            def __init__(self) -> None:
                self.handle, self.gain = threading.Lock(), 2.0

            def act(self, observation: np.ndarray) -> np.ndarray:
                with self.handle:
                    return self.gain * observation

        prior = CallablePrior(Bot().act, std=1.0)
        batch = observations(5)
        for twin in (prior, deepcopy(prior), MixturePrior([prior, prior])):
            torch.testing.assert_close(twin.get_dist(batch).mean, 2 * batch["observation"])

    def test_what_predicts_a_pair(self) -> None:
        class Model:
            """As of Stable-Baselines3: what it predicts is sampled by default, and comes with a state."""

            state: Any = None

            def predict(
                self, observation: np.ndarray, state: Any = None, deterministic: bool = False
            ) -> tuple[np.ndarray, Any]:
                noise = 0.0 if deterministic else 100.0
                return observation[..., :2] + noise, self.state

        model, batch = Model(), observations(5)
        for batched in (False, True):
            prior = CallablePrior(model.predict, std=1.0, batched=batched)
            torch.testing.assert_close(prior.get_dist(batch).mean, batch["observation"][:, :2])
        model.state = (np.zeros(3), np.zeros(3))
        with pytest.raises(TypeError, match="it has a memory"):
            prior.get_dist(batch)

    def test_two_actions_are_not_taken_for_a_pair(self) -> None:
        batch = observations(2)
        for prior in (
            CallablePrior(lambda x: (x[0], x[1]), std=1.0),
            CallablePrior(lambda x: tuple(map(tuple, x[:, :2])), std=1.0, batched=True),
        ):
            torch.testing.assert_close(prior.get_dist(batch).mean, batch["observation"][:, :2])

    def test_it_plays_in_an_environment_without_a_batch(self) -> None:
        env = GymEnv("Pendulum-v1")
        prior = CallablePrior(lambda x: -2.0 * x[1:2], std=0.1)
        rollout = env.rollout(5, prior.policy())
        torch.testing.assert_close(rollout["action"], -2.0 * rollout["observation"][:, 1:2])

    def test_one_by_one_and_batched_agree(self) -> None:
        batch = observations(2, 3)
        one = CallablePrior(lambda x: np.tanh(x[:2]), std=[0.1, 0.2])
        many = CallablePrior(lambda x: np.tanh(x[:, :2]), std=[0.1, 0.2], batched=True)
        expected = d.Normal(batch["observation"][..., :2].tanh(), torch.tensor([0.1, 0.2]))
        action = torch.randn(2, 3, 2)
        batch["action"] = action
        for prior in (one, many):
            torch.testing.assert_close(prior.log_prob(batch), expected.log_prob(action).sum(-1))

    @pytest.mark.parametrize("distribution_class", [d.Categorical, OneHotCategorical])
    def test_no_discrete_action_is_impossible(self, distribution_class: Any) -> None:
        prior = CallablePrior(
            lambda x: int(x[0] > 0), num_actions=4, epsilon=0.2, distribution_class=distribution_class
        )
        probs = prior.get_dist(TensorDict(observation=torch.tensor([[1.0], [-1.0]]), batch_size=[2])).probs
        torch.testing.assert_close(probs, torch.tensor([[0.05, 0.85, 0.05, 0.05], [0.85, 0.05, 0.05, 0.05]]))

    def test_several_and_nested_keys(self) -> None:
        prior = CallablePrior(lambda a, b: a + b, std=1.0, in_keys=["a", ("deep", "b")])
        batch = TensorDict(a=torch.ones(2, 1), deep=TensorDict(b=2 * torch.ones(2, 1), batch_size=[2]), batch_size=[2])
        assert (prior.get_dist(batch).mean == 3).all()

    @pytest.mark.parametrize(
        ("policy", "kwargs", "match"),
        [
            (lambda x: 5, {"num_actions": 4}, r"actions in \[5, 5\], and num_actions is 4"),
            (lambda x: 0.5, {"num_actions": 4}, "Expected an integer"),
            (lambda x: np.array([np.nan]), {"std": 1.0}, "not finite"),
            (lambda x: 1.0, {"std": 1.0}, r"shape \[act_dim\]"),
            (lambda x: x[:2], {"std": [1.0, 1.0, 1.0]}, r"got \(2,\) and \(3,\)"),
            (lambda x: x[0], {"std": 1.0, "batched": True}, r"shape \(3,\) for 2 observations"),
        ],
    )
    def test_wrong_actions_are_refused(self, policy: Any, kwargs: dict[str, Any], match: str) -> None:
        with pytest.raises(ValueError, match=match):
            CallablePrior(policy, **kwargs).get_dist(observations(2))

    def test_a_spread_is_needed(self) -> None:
        for kwargs, match in (
            ({}, "Pass std"),
            ({"std": 1.0, "num_actions": 3}, "Pass std"),
            ({"std": -1.0}, "positive"),
            ({"num_actions": 0}, "at least 1"),
            ({"num_actions": 2, "epsilon": 0.0}, "epsilon"),
        ):
            with pytest.raises(ValueError, match=match):
                CallablePrior(lambda x: x, **kwargs)  # type: ignore[arg-type]


class TestAffordancePrior:
    def test_probabilities_by_hand(self) -> None:
        prior = AffordancePrior(torch.tensor([[1.0, 3.0, 0.0, 0.0], [0.0, 0.0, 0.0, 0.0]]), epsilon=0.4)
        expected = torch.tensor([[0.25, 0.55, 0.1, 0.1], [0.25, 0.25, 0.25, 0.25]])
        torch.testing.assert_close(prior.get_dist(states(0, 1)).probs, expected)

    def test_masked_actions_are_unlikely_and_never_impossible(self) -> None:
        prior = AffordancePrior(torch.tensor([[True, False]]), epsilon=0.01)
        batch = states(0, 0).set("action", torch.tensor([0, 1]))
        torch.testing.assert_close(prior.log_prob(batch), torch.tensor([0.995, 0.005]).log())

    def test_table_function_network_and_module_agree(self) -> None:
        weights = table()
        net = nn.Linear(5, ACTIONS, bias=False)
        net.weight.data.copy_(weights.T)
        batch = states(3, 1)
        batch["observation"] = nn.functional.one_hot(batch["state"], 5).float()
        module = TensorDictModule(net, in_keys=["observation"], out_keys=["mask"])
        expected = AffordancePrior(weights).get_dist(batch).probs
        for source in (net, module, lambda x: x @ weights):
            torch.testing.assert_close(AffordancePrior(source).get_dist(batch).probs, expected)

    def test_bad_input_is_refused(self) -> None:
        with pytest.raises(ValueError, match="epsilon"):
            AffordancePrior(table(), epsilon=0.0)
        for value in (-1.0, math.nan, math.inf):
            with pytest.raises(ValueError, match="finite and not negative"):
                AffordancePrior(torch.tensor([[1.0, value]]))
            with pytest.raises(ValueError, match="finite and not negative"):
                AffordancePrior(lambda x, value=value: x * 0 + value).get_dist(observations(2))


class TestMixturePrior:
    def test_categorical_mixture_by_hand(self) -> None:
        first, second = (BoltzmannPrior(table(seed)) for seed in (0, 1))
        batch = states(0, 3, 4)
        for weights, expected in (
            (None, torch.tensor([[0.5, 0.5]] * 3)),
            ([3.0, 1.0], torch.tensor([[0.75, 0.25]] * 3)),
            (torch.eye(2)[[0, 1, 1, 0, 1]], torch.tensor([[1.0, 0.0], [1.0, 0.0], [0.0, 1.0]])),
        ):
            probs = torch.stack([prior.get_dist(batch).probs for prior in (first, second)])
            mixed = MixturePrior([first, second], weights).get_dist(batch)
            torch.testing.assert_close(mixed.probs, torch.einsum("bk,kba->ba", expected, probs))

    def test_gaussian_mixture_by_hand(self) -> None:
        priors = [ModulePrior(Pair(), "mean_std"), ModulePrior(nn.Linear(OBS, ACTIONS), "mean", std=0.5)]
        weights = TensorDictModule(
            lambda x: torch.stack([x[..., 0].exp(), 0 * x[..., 0] + 2], -1), ["observation"], ["w"]
        )
        batch = observations(2, 6).set("action", torch.randn(2, 6, ACTIONS))
        w = weights(batch.clone())["w"]
        expected = torch.stack([prior.log_prob(batch).exp() for prior in priors], -1)
        prior = MixturePrior(priors, weights, namespace="both")
        assert prior.out_keys == [("both", "mixture_logits"), ("both", "loc"), ("both", "scale")]
        torch.testing.assert_close(prior.log_prob(batch), ((w / w.sum(-1, keepdim=True)) * expected).sum(-1).log())
        params = prior(batch)["both"]
        torch.testing.assert_close(
            prior.build_dist(dict(params.items())).log_prob(batch["action"]), prior.log_prob(batch)
        )
        student = IndependentNormal(torch.zeros(2, 6, ACTIONS), torch.ones(2, 6, ACTIONS))
        assert cross_entropy(student, prior.get_dist(batch)).isfinite().all()
        negated = prior.adversary().get_params(batch)
        assert torch.equal(negated["loc"], -params["loc"])
        assert torch.equal(negated["mixture_logits"], params["mixture_logits"])

    def test_one_hot_and_nested_mixtures(self) -> None:
        one_hot = [BoltzmannPrior(table(seed), distribution_class=OneHotCategorical) for seed in (0, 1, 2)]
        nested = MixturePrior([MixturePrior(one_hot[:2]), one_hot[2]], [2.0, 1.0])
        flat = MixturePrior(one_hot)
        batch = states(0, 1).set("action", torch.eye(ACTIONS)[[1, 2]])
        torch.testing.assert_close(nested.log_prob(batch), flat.log_prob(batch))

    def test_draws_and_degradations_work_inside_and_around(self) -> None:
        good = BoltzmannPrior(10 * table())
        noisy = RandomDegradation(good, 0.5, seed=0)
        mixture = MixturePrior([noisy, UniformPrior(ACTIONS)])
        batch = states(*[0] * 20)
        mixture.draw(batch)
        degraded = batch["prior", "degraded"].squeeze(-1)
        assert 0 < degraded.sum() < 20
        probs = mixture.get_dist(batch).probs
        assert len({tuple(row.tolist()) for row in probs}) == 2
        around = StructuralDegradation(mixture, torch.tensor([True, False, False, False, False]))
        torch.testing.assert_close(around.get_dist(batch).logits, mixture.adversary().get_dist(batch).logits)
        with pytest.raises(ValueError, match="draw_key"):
            MixturePrior([noisy, RandomDegradation(good, 0.5)])

    def test_bad_input_is_refused(self) -> None:
        first, second, normal = BoltzmannPrior(table()), UniformPrior(3), ModulePrior(Pair(), "mean_std")
        squashed = ModulePrior(Pair(), "mean_std", distribution_class=TanhNormal)
        for error, match, make in (
            (TypeError, "Linear", lambda: MixturePrior([first, nn.Linear(2, 2)])),
            (ValueError, "at least two", lambda: MixturePrior([first])),
            (ValueError, "a weight for each", lambda: MixturePrior([first, first], [1.0])),
            (ValueError, "not negative", lambda: MixturePrior([first, first], [1.0, -1.0])),
            (ValueError, "not all 0", lambda: MixturePrior([first, first], [0.0, 0.0])),
            (NotImplementedError, "Categorical, IndependentNormal", lambda: MixturePrior([first, normal])),
            (NotImplementedError, "TanhNormal", lambda: MixturePrior([normal, squashed])),
            (
                ValueError,
                "one-hot for others",
                lambda: MixturePrior([first, BoltzmannPrior(table(), distribution_class=OneHotCategorical)]),
            ),
            (ValueError, r"some over \[4, 3\]", lambda: MixturePrior([first, second]).get_dist(states(0))),
            (
                ValueError,
                r"must be of shape \(2, 2\)",
                lambda: MixturePrior([normal, normal], lambda x: x).get_dist(observations(2)),
            ),
        ):
            with pytest.raises(error, match=match):
                make()
