"""What a prior or a critic can't be is refused in words of this library, however it is wrapped."""

from __future__ import annotations

from functools import partial
from typing import Any

import pytest
import torch
from objectives_cases import OBS, make_actor, make_batch, make_critic, make_weight
from tensordict import TensorDict
from tensordict.nn import CompositeDistribution, NormalParamExtractor, TensorDictModule
from torch import nn
from torchrl.modules import Delta, MultiAgentMLP, ProbabilisticActor, TanhDelta, TanhNormal, ValueOperator

from torchrl_priors import ActionPrior, AE2RLoss, PriorBonus, UniformPrior

COMPOSITE: dict[str, Any] = {"distribution_map": {"arm": TanhNormal}, "name_map": {"arm": ("action", "arm")}}


def composite(distribution_class: Any, kwargs: Any) -> ProbabilisticActor:
    net = nn.Sequential(nn.Linear(OBS, 8), NormalParamExtractor())
    params: list[Any] = [("params", "arm", "loc"), ("params", "arm", "scale")]
    return ProbabilisticActor(
        TensorDictModule(net, in_keys=["observation"], out_keys=params),
        in_keys=["params"],
        out_keys=[("action", "arm")],
        distribution_class=distribution_class,
        distribution_kwargs=kwargs,
        return_log_prob=True,
    )


def deterministic(distribution_class: Any) -> ProbabilisticActor:
    module = TensorDictModule(nn.Linear(OBS, 2), in_keys=["observation"], out_keys=["param"])
    return ProbabilisticActor(module, in_keys=["param"], distribution_class=distribution_class)


COMPOSITES = [(CompositeDistribution, COMPOSITE), (partial(CompositeDistribution, **COMPOSITE), {})]


@pytest.mark.parametrize(("kind", "kwargs"), COMPOSITES)
def test_several_actions_at_once_are_refused(kind: Any, kwargs: Any) -> None:
    with pytest.raises(NotImplementedError, match="CompositeDistribution"):
        ActionPrior(composite(kind, kwargs))
    loss = AE2RLoss(composite(kind, kwargs), UniformPrior(4), method="kickstart")
    with pytest.raises(NotImplementedError, match=r"the student's CompositeDistribution and the prior's Categorical"):
        loss(TensorDict(observation=torch.randn(5, OBS), batch_size=[5]))


@pytest.mark.parametrize("kind", [Delta, TanhDelta, partial(Delta), partial(partial(TanhDelta))])
def test_point_masses_are_refused(kind: Any) -> None:
    with pytest.raises(ValueError, match="deterministic"):
        ActionPrior(deterministic(kind))


def test_a_point_mass_that_a_function_builds_is_refused_when_it_is_built() -> None:
    prior = ActionPrior(deterministic(lambda param: TanhDelta(param)))
    with pytest.raises(ValueError, match="deterministic"):
        prior.get_dist(TensorDict(observation=torch.randn(5, OBS), batch_size=[5]))


@pytest.mark.parametrize("method", ["aer", "ae2r"])
def test_a_value_for_each_agent_is_refused(method: str) -> None:
    class Agents(nn.Module):
        def __init__(self) -> None:
            super().__init__()
            self.net = MultiAgentMLP(OBS, 1, n_agents=6, centralized=False, share_params=True, depth=1, num_cells=8)

        def forward(self, observation: torch.Tensor) -> torch.Tensor:
            return self.net(observation.unsqueeze(-2).expand(*observation.shape[:-1], 6, OBS))

    critic = ValueOperator(Agents(), in_keys=["observation"])
    loss = AE2RLoss(make_actor(), ActionPrior(make_actor()), make_weight(), critic, method=method)
    with pytest.raises(ValueError, match=r"each agent.*got \(6, 6, 1\), \(6, 1\) and \(6, 1\)"):
        loss(make_batch())


@pytest.mark.parametrize("flat", [["reward"], ["terminated"], ["reward", "terminated"]])
def test_rewards_and_ends_without_a_last_dimension_are_refused(flat: list[str]) -> None:
    data = make_batch()
    for key in flat:
        data["next", key] = data["next", key].squeeze(-1)
    loss = AE2RLoss(make_actor(), ActionPrior(make_actor()), make_weight(), make_critic())
    with pytest.raises(ValueError, match=r"must have one shape \[\*B, 1\]"):
        loss(data)
    with pytest.raises(ValueError, match=r"\(6,\)"):
        PriorBonus(make_weight())(data)
