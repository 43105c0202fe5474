"""What a batch lacks is named, with what writes it; a selected output is all there is."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from objectives_cases import OBS, make_actor, make_batch, make_critic, make_ppo_prior, make_weight
from tensordict import TensorDict
from torchrl.objectives import LossModule

from torchrl_priors import ActionPrior, AE2RLoss, MultiTeacherLoss, PriorBonus, PriorLogProb, UniformPrior
from torchrl_priors.methods import METHODS


def ae2r(method: str = "ae2r") -> AE2RLoss:
    networks = (make_weight(), make_critic()) if METHODS[method].adaptive else (None, None)
    return AE2RLoss(make_actor(), ActionPrior(make_actor()), *networks, method=method)


def ppo(method: str) -> LossModule:
    networks = (make_weight(), make_critic()) if METHODS[method].adaptive else (None, None)
    return make_ppo_prior(make_actor(), make_critic(), ActionPrior(make_actor()), *networks, method=method)


def of_two(method: str) -> LossModule:
    teachers = [UniformPrior(2, namespace=name) for name in ("expert", "novice")]
    weights: Any = [make_weight(), make_weight()] if METHODS[method].adaptive else None
    return MultiTeacherLoss(make_actor(), teachers, weights, make_critic(), method=method)


def transform(batch: TensorDict, name: str) -> TensorDict:
    step = PriorLogProb(UniformPrior(2), make_actor(), time_dim=0) if name == "log_prob" else PriorBonus(make_weight())
    return step(batch)


@pytest.mark.parametrize(
    ("missing", "read_by", "words"),
    [
        ("shaped_reward", lambda batch: ppo("ae2r")(batch.exclude("advantage")), "prior_transforms"),
        ("reward", lambda batch: ppo("kickstart")(batch.exclude("advantage")), "environment"),
        ("reward", ae2r(), "environment"),
        ("terminated", ae2r(), "environment"),
        ("prior_log_prob", ae2r(), "PriorLogProb"),
        ("observation", ae2r(), "NextStateReconstructor"),
        ("observation", lambda batch: transform(batch, "bonus"), "NextStateReconstructor"),
        ("observation", lambda batch: transform(batch, "log_prob"), "NextStateReconstructor"),
        ("reward", lambda batch: transform(batch, "bonus"), "PriorBonus"),
    ],
)
def test_the_message_names_the_key_and_what_writes_it(missing: str, read_by: Any, words: str) -> None:
    batch = make_batch().exclude(("next", missing))
    with pytest.raises(KeyError, match=rf"\('next', '{missing}'\).*{words}"):
        read_by(batch)


@pytest.mark.parametrize("make", [ae2r, ppo, of_two])
@pytest.mark.parametrize("method", ["kickstart", "ae2r", "aligned"])
def test_selected_keys_are_all_that_is_written(make: Any, method: str) -> None:
    loss = make(method)
    data = make_batch()
    if make is of_two:
        for name in ("expert", "novice"):
            data[name, "prior_log_prob"] = data["prior_log_prob"]
            data["next", name, "prior_log_prob"] = data["next", "prior_log_prob"]
    every = [key for key in loss.out_keys if key.startswith("loss_")]
    whole = set(loss(data).keys())
    assert loss.select_out_keys(*every[::-1]) is loss
    assert list(loss(data).keys()) == loss.out_keys == every[::-1]
    with pytest.raises(ValueError, match=r"got \['nothing'\] to select"):
        loss.select_out_keys("nothing")
    loss.reset_out_keys()
    assert set(loss(data).keys()) == whole


def test_a_teacher_of_another_precision_says_so() -> None:
    prior, data = ActionPrior(make_actor()), TensorDict(observation=torch.randn(5, OBS).double(), batch_size=[5])
    with pytest.raises(TypeError, match=r"torch.float32, and got {'observation': torch.float64}.*DoubleToFloat"):
        prior.get_dist(data)
    assert prior.to(torch.float64).get_dist(data).logits.dtype is torch.float64


@pytest.mark.parametrize(("teacher", "student"), [("categorical", "one_hot"), ("one_hot", "categorical")])
def test_an_index_beside_one_hot_mentions_the_setting(teacher: str, student: str) -> None:
    with pytest.raises(ValueError, match="one_hot=True"):
        ActionPrior(make_actor(teacher)).log_prob(make_batch(student))
