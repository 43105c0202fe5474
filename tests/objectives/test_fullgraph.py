"""Losses and transforms compile as one graph, without a call beforehand, and compute the same."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from objectives_cases import make_actor, make_batch, make_critic, make_ppo_prior, make_weight
from torch import nn
from torch.distributions import kl
from torchrl.objectives import A2CLoss, ClipPPOLoss

from torchrl_priors import ActionPrior, AE2RLoss, AVECMixin, ClipPPOPriorLoss, PriorLogProb


class AVECClipPPO(AVECMixin, ClipPPOLoss):
    pass


class AVECA2C(AVECMixin, A2CLoss):
    pass


class AVECPrior(AVECMixin, ClipPPOPriorLoss):
    pass


@pytest.fixture(autouse=True)
def _nothing_known(monkeypatch: pytest.MonkeyPatch) -> None:
    """As in a new process: torch knows no pair of distributions yet."""
    monkeypatch.setattr(kl, "_KL_MEMOIZE", {})
    monkeypatch.setattr("torchrl_priors.distributions._KL_MEMOIZE", kl._KL_MEMOIZE, raising=False)
    torch._dynamo.reset()


def whole(module: nn.Module) -> Any:
    return torch.compile(module, backend="eager", fullgraph=True)


def with_prior(kind: str, method: str) -> AE2RLoss:
    networks = (make_weight(), make_critic()) if method in ("ae2r", "aligned") else (None, None)
    return AE2RLoss(make_actor(kind), ActionPrior(make_actor(kind)), *networks, method=method)


LOSSES = {
    "avec ppo": lambda: AVECClipPPO(make_actor(), make_critic()),
    "avec a2c": lambda: AVECA2C(make_actor(), make_critic()),
    "avec prior": lambda: make_ppo_prior(
        make_actor(), make_critic(), ActionPrior(make_actor()), make_weight(), make_critic(), AVECPrior
    ),
}


@pytest.mark.parametrize("name", LOSSES)
def test_a_loss_is_one_graph(name: str) -> None:
    loss, data = LOSSES[name](), make_batch("categorical")
    compiled = whole(loss)(data)
    expected = loss(data)
    for key, value in compiled.items():
        torch.testing.assert_close(value, expected[key])


@pytest.mark.parametrize("method", ["pull", "ae2r"])
def test_squashed_students_need_no_call_before(method: str) -> None:
    loss = with_prior("tanh_normal", method)
    losses = whole(loss)(make_batch("tanh_normal"))
    assert all(value.isfinite().all() for value in losses.values())


BOUNDARIES = ["normal-zero", "normal-expected", "normal-sample"]


@pytest.mark.parametrize("case", [*BOUNDARIES, "categorical-expected", "tanh_normal-expected", "tanh_normal-sample"])
def test_the_boundary_is_in_the_graph(case: str) -> None:
    kind, boundary = case.split("-")
    transform = PriorLogProb(ActionPrior(make_actor(kind)), make_actor(kind), time_dim=0, boundary=boundary)
    data = make_batch(kind)
    compiled = whole(transform)(data.clone())["next", "prior_log_prob"]
    assert compiled.isfinite().all()
    if boundary != "sample" and kind != "tanh_normal":
        torch.testing.assert_close(compiled, transform(data.clone())["next", "prior_log_prob"])
