"""What a collector makes of its policy: random numbers, parameters and kinds of policies."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import pytest
import torch

pytest.importorskip("gymnasium")

from collectors_cases import collector, gaussian, same, squashed
from tensordict import TensorDictBase
from tensordict.nn import AddStateIndependentNormalScale, TensorDictModule
from torch import nn
from torchrl.modules import MLP, IndependentNormal, ProbabilisticActor

from torchrl_priors.collectors.policy_step import GaussianStep, ModuleStep, policy_step
from torchrl_priors.networks import ACTIVATIONS, make_actor


@contextmanager
def calls(net: nn.Module) -> Iterator[list[nn.Module]]:
    """What is called of a network, by a hook that nobody sees."""
    called: list[nn.Module] = []
    known = set(net.modules())

    def remember(module: nn.Module, *_: Any) -> None:
        if module in known and not isinstance(module, AddStateIndependentNormalScale):  # called once a rollout
            called.append(module)

    handle = nn.modules.module.register_module_forward_hook(remember)
    try:
        yield called
    finally:
        handle.remove()


def noise(batch: TensorDictBase) -> torch.Tensor:
    """The standard normal numbers behind the actions of a Gaussian policy, squashed or not, ``[N * T, 2]``."""
    action = batch["action"]
    if action.abs().max() < 1:
        action = action.atanh()
    return ((action - batch["loc"]) / batch["scale"]).reshape(-1, 2)


class TestPolicy:
    @pytest.mark.parametrize(
        ("policy", "kind"), [(lambda: gaussian(3, 2), GaussianStep), (lambda: squashed(3, 2), ModuleStep)]
    )
    def test_a_batch_holds_what_the_policy_would_say_of_it(self, policy: Callable, kind: type) -> None:
        actor = policy()
        collecting = collector(actor)
        assert type(policy_step(actor, "action", ["observation"])) is kind
        batch = collecting.rollout()
        with torch.no_grad():
            again = batch.select("observation")
            distribution = actor.get_dist(again)
            log_prob = distribution.log_prob(batch["action"])
        torch.testing.assert_close(again["loc"], batch["loc"])
        torch.testing.assert_close(again["scale"], batch["scale"])
        torch.testing.assert_close(log_prob, batch["action_log_prob"])
        assert set(actor.out_keys) <= set(batch.keys())

    @pytest.mark.parametrize("policy", [gaussian, squashed])
    def test_actions_are_distributed_as_the_policy_says(self, policy: Callable) -> None:
        batch = collector(policy(3, 2), frames=3 * 700).rollout()  # more steps than noise is drawn for at once
        drawn = noise(batch)
        assert drawn.unique(dim=0).shape[0] == drawn.shape[0]
        assert drawn.mean(0).abs().max() < 0.1  # 4.5 standard errors
        assert (drawn.std(0) - 1).abs().max() < 0.07

    @pytest.mark.parametrize("policy", [gaussian, squashed])
    def test_no_two_rollouts_draw_the_same_numbers(self, policy: Callable) -> None:
        collecting = collector(policy(3, 2))
        first, second = (noise(collecting.rollout()) for _ in range(2))
        assert (first - second).abs().min() > 1e-5

    def test_both_ways_to_run_a_gaussian_policy_say_the_same_of_an_action(self) -> None:
        actor, hooked = (gaussian(3, 2) for _ in range(2))
        hooked.load_state_dict(actor.state_dict())
        hooked.module[0].register_forward_hook(lambda *_: None)
        assert isinstance(policy_step(actor, "action", ["observation"]), GaussianStep)
        assert isinstance(policy_step(hooked, "action", ["observation"]), ModuleStep)
        fast, slow = collector(actor).rollout(), collector(hooked).rollout()
        assert set(fast.keys(True, True)) == set(slow.keys(True, True))
        for key in ("loc", "scale", "observation"):
            torch.testing.assert_close(fast[key], slow[key])

    @pytest.mark.parametrize("activation", ACTIVATIONS)
    @pytest.mark.parametrize("deterministic", [False, True])
    def test_a_dense_network_runs_without_its_modules_and_says_the_same(
        self, activation: str, deterministic: bool
    ) -> None:
        actor = make_actor(3, 2, (8, 16), activation)
        nn.init.normal_(actor.module[0].module.mean[-1].weight)
        nn.init.normal_(actor.module[0].module.scale.state_independent_scale)
        step = policy_step(actor, "action", ["observation_norm"])
        for number in (4, 1):
            observations = torch.randn(3, number, 3)
            generator = torch.Generator().manual_seed(0)
            with step.session(generator, deterministic), calls(actor.module[0].module) as called:
                found = [{k: v.clone() for k, v in step({"observation_norm": each}).items()} for each in observations]
            assert not called
            draws = torch.randn((256, number, 2), generator=torch.Generator().manual_seed(0))
            for observation, values, draw in zip(observations, found, draws, strict=False):
                loc, scale = actor.module[0].module(observation)
                torch.testing.assert_close(values["loc"], loc.detach())
                torch.testing.assert_close(values["scale"], scale.detach())
                expected = loc if deterministic else loc + scale * draw
                torch.testing.assert_close(values["action"], expected.detach())

    @pytest.mark.parametrize(
        "layers",
        [
            [nn.Linear(3, 4), nn.LayerNorm(4), nn.Linear(4, 2)],
            [nn.Linear(3, 4), nn.Tanh(), nn.Tanh(), nn.Linear(4, 2)],
            [nn.Tanh(), nn.Linear(3, 2)],
            [nn.utils.parametrizations.weight_norm(nn.Linear(3, 2))],
            [nn.utils.spectral_norm(nn.Linear(3, 2))],  # a hook
            [nn.Linear(3, 300), nn.Linear(300, 200), nn.Linear(200, 2)],  # too large
            [nn.Sequential(nn.Linear(3, 4, bias=False), nn.ReLU()), nn.Linear(4, 2)],
            [MLP(3, 2, num_cells=[4])],
        ],
    )
    def test_any_other_network_says_the_same(self, layers: list[nn.Module]) -> None:
        net = nn.Sequential(*layers, AddStateIndependentNormalScale(2)).eval()
        actor = ProbabilisticActor(
            TensorDictModule(net, in_keys=["observation"], out_keys=["loc", "scale"]),
            in_keys=["loc", "scale"],
            distribution_class=IndependentNormal,
        )
        step = policy_step(actor, "action", ["observation"])
        observation = torch.randn(5, 3)
        with step.session(torch.Generator(), True), calls(net) as called:
            found = step({"observation": observation})
        known = type(layers[0]) in (nn.Sequential, MLP)
        assert bool(called) is not known
        torch.testing.assert_close(found["action"], net(observation)[0].detach())

    def test_a_hook_inside_the_network_counts_from_the_next_rollout_on(self) -> None:
        actor = gaussian(3, 2)
        collecting = collector(actor)
        collecting.rollout()
        actor.module[0].module[0].register_forward_hook(lambda *_: torch.full((3, 16), torch.inf))
        actor.module[0].module[2].register_forward_hook(lambda *_: torch.full((3, 2), 100.0))
        assert (collecting.rollout()["action"] > 50).all()

    def test_new_parameters_count_from_the_next_step_on(self) -> None:
        actor = gaussian(3, 2)
        collecting = collector(actor)
        collecting.rollout()
        with torch.no_grad():
            actor.module[0].module[2].bias.fill_(100.0)
        assert (collecting.rollout()["action"] > 50).all()

    @pytest.mark.parametrize("policy", [gaussian, squashed])
    def test_a_seed_is_all_that_actions_depend_on(self, policy: Callable) -> None:
        actor = policy(3, 2)
        first = collector(actor, seed=5).rollout()
        state = torch.random.get_rng_state()
        torch.rand(3)
        again, other = (collector(actor, seed=seed).rollout() for seed in (5, 6))
        assert same(first, again)
        assert not torch.equal(first["action"], other["action"])
        torch.random.set_rng_state(state)

    @pytest.mark.parametrize("policy", [gaussian, squashed])
    def test_torchs_global_generator_is_left_alone(self, policy: Callable) -> None:
        actor = policy(3, 2)
        before = torch.random.get_rng_state()
        collector(actor).rollout()
        assert torch.equal(before, torch.random.get_rng_state())

    def test_a_policy_without_log_prob_gives_none(self) -> None:
        assert "action_log_prob" not in collector(gaussian(3, 2, return_log_prob=False)).rollout()
