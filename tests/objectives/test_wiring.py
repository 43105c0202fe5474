"""A loss, its transforms, the advantage and the teacher that don't belong together: an error or a warning."""

from __future__ import annotations

import contextlib
import copy
import warnings
from collections.abc import Callable, Iterator
from typing import Any

import pytest
import torch
from objectives_cases import OBS, make_actor, make_critic
from tensordict import TensorDict, TensorDictBase
from torch import nn
from torchrl.objectives.value import GAE

from torchrl_priors import (
    ActionPrior,
    AE2RLoss,
    ClipPPOPriorLoss,
    MultiTeacherLoss,
    PriorBonus,
    PriorLogProb,
    PriorWeight,
    RandomDegradation,
    prior_transforms,
)
from torchrl_priors.methods import METHODS

TIME = 20


def make_loss(method: str, prior: Any = None) -> AE2RLoss:
    prior = ActionPrior(make_actor()) if prior is None else prior
    networks = (PriorWeight(nn.Linear(OBS, 1)), make_critic()) if METHODS[method].adaptive else (None, None)
    return AE2RLoss(make_actor(), prior, *networks, method=method)


def rollout(*shape: int) -> TensorDictBase:
    observation = torch.randn(*shape, TIME + 1, OBS)
    done = torch.rand(*shape, TIME, 1) < 0.2
    flags = {"done": done, "terminated": done & (torch.rand_like(done, dtype=torch.float) < 0.5)}
    following = {"observation": observation[..., 1:, :], "reward": torch.randn(*shape, TIME, 1), **flags}
    batch = TensorDict(observation=observation[..., :-1, :], next=following, batch_size=(*shape, TIME))
    batch["action"] = torch.randint(2, (*shape, TIME))
    batch["action_log_prob"] = torch.full((*shape, TIME), -0.7)
    batch.names = [None] * len(shape) + ["time"]
    return batch


@contextlib.contextmanager
def silence() -> Iterator[None]:
    """No warning may come."""
    with warnings.catch_warnings():
        warnings.simplefilter("error", UserWarning)
        yield


def shaped(loss: AE2RLoss, bonus: PriorBonus | None = None, reward_key: str = "shaped_reward") -> TensorDictBase:
    transforms: Any = prior_transforms(loss)
    batch = transforms[0](rollout(2))
    batch = (transforms[1] if bonus is None else bonus)(batch)
    advantage = GAE(gamma=0.99, lmbda=0.95, value_network=make_critic())
    advantage.set_keys(reward=reward_key)
    return advantage(batch).reshape(-1)


@pytest.mark.parametrize("method", METHODS)
def test_what_belongs_together_is_silent(method: str) -> None:
    loss = make_loss(method)
    with silence():
        for _ in range(3):
            loss(shaped(loss))
    teachers = [ActionPrior(make_actor(), namespace=name) for name in ("expert", "novice")]
    weights: Any = [PriorWeight(nn.Linear(OBS, 1)) for _ in teachers] if METHODS[method].adaptive else None
    several = MultiTeacherLoss(make_actor(), teachers, weights, make_critic(), method=method)
    with silence():
        several(prior_transforms(several)(rollout(2)))


@pytest.mark.parametrize(
    ("method", "other"),
    [
        ("e2r", "er"),
        ("er", "e2r"),
        ("e2r", "ae2r"),
        ("ae2r", "aer"),
        ("aer", "ae2r"),
        ("ae2r", "e2r"),
        ("aer", "er"),
        ("kickstart", "e2r"),
    ],
)
def test_a_bonus_of_another_method_is_warned_of_once(method: str, other: str) -> None:
    loss = make_loss(method)
    batch = shaped(loss, PriorBonus.from_method(other, PriorWeight(nn.Linear(OBS, 1))))
    with pytest.warns(UserWarning, match=r"not that of [^:]*: .*prior_transforms\(loss\)"):
        loss(batch)
    with silence():
        loss(batch)


@pytest.mark.parametrize("method", ["er", "e2r", "aer", "ae2r", "kl_penalty"])
def test_an_advantage_on_raw_rewards_is_warned_of(method: str) -> None:
    loss = make_loss(method)
    with pytest.warns(UserWarning, match=r"set_keys\(reward='shaped_reward'\)"):
        loss(shaped(loss, reward_key="reward"))


@pytest.mark.parametrize("bonus_coeff", [0.0, 1e-7])
def test_a_bonus_that_does_not_show_tells_nothing_about_the_advantage(bonus_coeff: float) -> None:
    loss = make_loss("e2r")
    loss.bonus_coeff = bonus_coeff
    for reward_key in ("shaped_reward", "reward"):
        with silence():
            loss(shaped(loss, reward_key=reward_key))
    loss.bonus_coeff = 1.0
    with pytest.warns(UserWarning, match=r"set_keys\(reward='shaped_reward'\)"):
        loss(shaped(loss, reward_key="reward"))


@pytest.mark.parametrize("method", METHODS)
def test_rewards_under_keys_of_ones_own_are_never_overwritten(method: str) -> None:
    batch = rollout(2)
    batch["next", "scaled"] = 0.01 * batch["next", "reward"]
    for owner, key in (("loss", "scaled"), ("prior_loss", "scaled")):
        prior_loss = make_loss(method)
        loss = ClipPPOPriorLoss(prior_loss.actor_network, make_critic(), prior_loss)
        bonus = METHODS[method].bonus != "none"
        if owner == "prior_loss":
            prior_loss.set_keys(reward=key)
        elif not bonus:  # with one, the key is where the shaped reward goes
            loss.set_keys(reward=key)
        after = prior_transforms(loss)(batch.clone())["next"]
        assert torch.equal(after["reward"], batch["next", "reward"])
        assert torch.equal(after["scaled"], batch["next", "scaled"])
        raw = batch["next", key if owner == "prior_loss" else "reward"]
        assert torch.equal(after["shaped_reward"], raw) is not bonus


@pytest.mark.parametrize("shape", [(), (3,)])
def test_a_permuted_rollout_is_warned_of(shape: tuple[int, ...]) -> None:
    transform = PriorLogProb(ActionPrior(make_actor()), make_actor())
    with silence():
        transform(rollout(*shape))
    permuted = rollout(*shape)[..., torch.arange(TIME).reshape(2, -1).T.flatten()]
    assert permuted.names[-1] == "time"
    with pytest.warns(UserWarning, match="permuted"):
        transform(permuted)


def test_the_student_as_its_own_teacher() -> None:
    actor = make_actor()
    with pytest.raises(ValueError, match="the student itself"):
        AE2RLoss(actor, actor, method="kickstart")
    with pytest.warns(UserWarning, match="copy of the student"):
        AE2RLoss(actor, ActionPrior(actor), method="kickstart")


@pytest.mark.parametrize("make", [ActionPrior, lambda actor: RandomDegradation(ActionPrior(actor), 0.5, seed=0)])
def test_another_teacher_in_a_checkpoint(make: Callable[..., Any]) -> None:
    mine, saved = make_loss("ae2r", make(make_actor())), make_loss("ae2r", make(make_actor()))
    prior_transforms(mine)(rollout(2))  # what is drawn at random is no other teacher
    with silence():
        mine.load_state_dict(copy.deepcopy(mine.state_dict()))
    with pytest.warns(UserWarning, match=r"gives AE2RLoss another teacher: prior\."):
        mine.load_state_dict(saved.state_dict())
    outer = nn.ModuleDict({"prior_loss": make_loss("ae2r", make(make_actor()))})
    with pytest.warns(UserWarning, match=r"another teacher: prior_loss\.prior\."):
        outer.load_state_dict(nn.ModuleDict({"prior_loss": saved}).state_dict())
    transforms = [prior_transforms(make_loss("e2r", make(make_actor()))) for _ in range(2)]
    with pytest.warns(UserWarning, match="gives PriorLogProb another teacher"):
        transforms[0].load_state_dict(transforms[1].state_dict())
    with silence():
        mine.prior.load_state_dict(make(make_actor()).state_dict())
