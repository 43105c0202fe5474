"""A batch gives the same losses and rewards in whatever layout it comes."""

from __future__ import annotations

from typing import Any

import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from objectives_cases import make_batch
from tensordict import TensorDict, TensorDictBase, lazy_stack
from tensordict.nn import NormalParamExtractor, TensorDictModule
from torch import nn
from torchrl.modules import IndependentNormal, ProbabilisticActor, ValueOperator

from torchrl_priors import ActionPrior, AE2RLoss, PriorWeight, prior_transforms
from torchrl_priors.methods import METHODS


def actor(observations: int) -> ProbabilisticActor:
    net = nn.Sequential(nn.Linear(observations, 4), NormalParamExtractor())
    module = TensorDictModule(net, in_keys=["observation"], out_keys=["loc", "scale"])
    return ProbabilisticActor(module, in_keys=["loc", "scale"], distribution_class=IndependentNormal)


def make_loss(method: str, observations: int) -> AE2RLoss:
    torch.manual_seed(0)
    student, teacher = actor(observations), actor(observations)
    critic = ValueOperator(nn.Linear(observations, 1), in_keys=["observation"])
    weight = PriorWeight(nn.Linear(observations, 1), init_scale=None) if METHODS[method].adaptive else None
    return AE2RLoss(student, ActionPrior(teacher), weight, critic, method=method)


def make_data(shape: tuple[int, ...], observations: int, masked: bool, absent: bool) -> TensorDict:
    data = make_batch("normal", batch=shape)
    data["observation"], data["next", "observation"] = torch.randn(2, *shape, observations)
    data["next", "done"] |= torch.rand(*shape, 1) < 0.3
    if absent:
        data["next", "observation"][data["next", "done"].squeeze(-1)] = torch.nan
    if masked:
        data["collector", "mask"] = torch.rand(shape) < 0.7
        data["collector", "mask"].view(-1)[0] = True
    return data


def layouts(data: TensorDictBase) -> dict[str, TensorDictBase]:
    found = {f"stack {dim}": lazy_stack(list(data.clone().unbind(dim)), dim) for dim in range(data.ndim)}
    found["of stacks"] = lazy_stack([part.clone() for part in data.unbind(0)], 0).clone(False)
    if data.ndim == 2:
        found["stack of stacks"] = lazy_stack([lazy_stack(list(part.unbind(0)), 0) for part in data.clone().unbind(0)])
        next_only = data.clone()
        next_only["next"] = lazy_stack(list(next_only["next"].unbind(1)), 1)
        found["next alone"] = next_only
    found["contiguous"] = data.clone().transpose(0, -1).contiguous().transpose(0, -1)
    return found


@settings(max_examples=40)
@given(
    method=st.sampled_from(["er", "e2r", "aer", "ae2r", "aligned"]),
    shape=st.sampled_from([(6,), (4, 3), (4, 4), (3, 4), (2, 3)]),
    observations=st.sampled_from([1, 3, 4, 7]),
    masked=st.booleans(),
    absent=st.booleans(),
    seed=st.integers(0, 1000),
)
def test_the_layout_of_a_batch_does_not_matter(
    method: str, shape: tuple[int, ...], observations: int, masked: bool, absent: bool, seed: int
) -> None:
    loss = make_loss(method, observations)
    torch.manual_seed(seed)
    data = make_data(shape, observations, masked, absent)
    transforms = prior_transforms(loss, time_dim=-1)

    def run(batch: TensorDictBase) -> Any:
        losses = loss(transforms(batch))
        loss.zero_grad()
        if minimised := [value for key, value in losses.items() if key.startswith("loss_")]:
            sum(minimised).backward()
        grads = [p.grad.clone() for p in loss.parameters() if p.grad is not None]
        return batch["next", "shaped_reward"], losses, grads

    reward, losses, grads = run(data.clone())
    for name, batch in layouts(data).items():
        other_reward, other_losses, other_grads = run(batch)
        torch.testing.assert_close(other_reward, reward, msg=lambda m, name=name: f"{name}: {m}")
        torch.testing.assert_close(dict(other_losses), dict(losses), msg=lambda m, name=name: f"{name}: {m}")
        torch.testing.assert_close(other_grads, grads, msg=lambda m, name=name: f"{name}: {m}")
    if not masked and len(shape) == 2:  # flat for the losses
        flat = transforms(data.clone()).reshape(-1)
        torch.testing.assert_close(dict(loss(flat)), dict(losses))
