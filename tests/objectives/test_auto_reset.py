"""Environments that reset themselves leave no observation at the end of a trajectory: NaN is never read."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from objectives_cases import make_actor, make_critic, make_weight, same_tensors, total
from tensordict import TensorDict, TensorDictBase
from torchrl.data import Categorical, Composite, Unbounded
from torchrl.envs import EnvBase
from torchrl.envs.transforms import NextStateReconstructor
from torchrl.objectives.value import GAE

from torchrl_priors import (
    ActionPrior,
    AE2RLoss,
    BoltzmannPrior,
    ClipPPOPriorLoss,
    PriorBonus,
    PriorLogProb,
    PriorWeight,
    RandomDegradation,
    prior_transforms,
)
from torchrl_priors.keys import next_step
from torchrl_priors.methods import METHODS

ENVS, LIMIT, STEPS = 4, 5, 12


class ResetsItself(EnvBase):
    """Its step returns the first observation of the next episode with ``done``, as vectorised simulators do."""

    def __init__(self, **kwargs: Any) -> None:
        super().__init__(batch_size=[ENVS], **kwargs)
        self.observation_spec = Composite(observation=Unbounded((ENVS, 3)), shape=(ENVS,))
        self.action_spec = Categorical(2, shape=(ENVS,))
        self.reward_spec = Unbounded((ENVS, 1))
        flags = {
            name: Categorical(2, shape=(ENVS, 1), dtype=torch.bool) for name in ("done", "terminated", "truncated")
        }
        self.full_done_spec = Composite(**flags, shape=(ENVS,))

    def _reset(self, tensordict: TensorDictBase | None, **kwargs: Any) -> TensorDictBase:
        self.time = torch.zeros(ENVS, 1)
        return self.full_done_spec.zero().set("observation", torch.randn(ENVS, 3))

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        self.time += 1
        truncated = self.time >= LIMIT
        terminated = (torch.rand(ENVS, 1) < 0.1) & ~truncated
        self.time[truncated | terminated] = 0
        return TensorDict(
            observation=torch.randn(ENVS, 3),
            reward=torch.randn(ENVS, 1),
            done=truncated | terminated,
            terminated=terminated,
            truncated=truncated,
            batch_size=[ENVS],
        )

    def _set_seed(self, seed: int | None) -> None:
        return None


def from_the_environment(actor: Any) -> TensorDictBase:
    env = ResetsItself(auto_reset=True, auto_reset_replace=True)
    return env.rollout(STEPS, actor, break_when_any_done=False).detach()


def from_a_reconstructor(actor: Any) -> TensorDictBase:
    """What a collector with ``compact_obs=True`` stored; the end of the batch is no end of an episode."""
    batch = from_the_environment(actor)
    flat = batch.reshape(-1)
    flat["collector", "traj_ids"] = flat["next", "done"].cumsum(0).roll(1).squeeze(-1)
    rebuilt = NextStateReconstructor()(flat.exclude(("next", "observation"))).reshape(ENVS, STEPS)
    rebuilt.names = [None, "time"]
    return rebuilt.exclude("collector")


@pytest.mark.parametrize("collect", [from_the_environment, from_a_reconstructor])
@pytest.mark.parametrize(
    ("method", "weight_target"),
    [(name, None) for name in METHODS] + [(name, "advantage") for name, spec in METHODS.items() if spec.adaptive],
)
def test_no_end_of_a_trajectory_spoils_a_loss(method: str, weight_target: Any, collect: Any) -> None:
    actor, critic, prior = make_actor(), make_critic(), RandomDegradation(ActionPrior(make_actor()), 0.5)
    networks = (make_weight(), make_critic()) if METHODS[method].adaptive else (None, None)
    loss = ClipPPOPriorLoss(
        actor, critic, AE2RLoss(actor, prior, *networks, method=method, weight_target=weight_target)
    )
    advantage = GAE(gamma=0.99, lmbda=0.95, value_network=critic)
    advantage.set_keys(reward=loss.tensor_keys.reward)
    batch = collect(actor)
    absent = batch["next", "observation"].isnan().any(-1, keepdim=True)
    assert (absent & ~batch["next", "terminated"]).any()
    batch = advantage(prior_transforms(loss)(batch))
    assert batch["advantage"].isfinite().all()
    losses = loss(batch.reshape(-1))
    assert all(value.isfinite().all() for value in losses.values())
    total(losses).backward()
    assert all(p.grad.isfinite().all() for p in loss.parameters() if p.grad is not None)


@pytest.mark.parametrize("method", ["e2r", "aer", "ae2r"])
def test_this_step_takes_the_place_of_a_missing_next_one_as_in_gae(method: str) -> None:
    actor = make_actor()
    networks = (make_weight(), make_critic()) if METHODS[method].adaptive else (None, None)
    loss = AE2RLoss(actor, ActionPrior(make_actor()), *networks, method=method)
    missing = from_the_environment(actor)
    filled = missing.clone()
    after = filled["next", "observation"]
    filled["next", "observation"] = torch.where(after.isnan(), filled["observation"], after)
    results = [prior_transforms(loss)(batch) for batch in (missing, filled)]
    for key in ("prior_log_prob", "prior_bonus", "shaped_reward"):
        assert torch.equal(results[0]["next", key], results[1]["next", key])
    first, second = (loss(batch) for batch in results)
    assert same_tensors(dict(first), dict(second))


@pytest.mark.parametrize("dtype", [torch.int64, torch.uint8])
@pytest.mark.parametrize("size", [None, 2])
def test_what_takes_the_place_of_integers_is_not_read(dtype: torch.dtype, size: int | None) -> None:
    """TorchRL fills with -1, and with 0 where there is no sign; elsewhere these are values as others are."""
    fill = -1 if dtype.is_signed else 0
    shape = (3,) if size is None else (3, size)
    here, after = torch.full(shape, 5, dtype=dtype), torch.full(shape, fill, dtype=dtype)
    done = torch.tensor([[True], [False], [True]])
    if size is not None:
        after[2, 0] = 7  # an observation
    following = TensorDict(state=after, done=done, terminated=torch.zeros_like(done), batch_size=[3])
    found = next_step(TensorDict(state=here, next=following, batch_size=[3]), ["state"], following["terminated"])
    expected = after.clone()
    expected[[0] if size is not None else [0, 2]] = 5
    assert torch.equal(found["state"], expected)


def test_integers_of_an_environment_that_resets_itself_are_advised_on() -> None:
    class Numbered(ResetsItself):
        def __init__(self, **kwargs: Any) -> None:
            super().__init__(**kwargs)
            self.observation_spec = Composite(state=Categorical(5, shape=(ENVS,)), shape=(ENVS,))

        def _reset(self, tensordict: TensorDictBase | None, **kwargs: Any) -> TensorDictBase:
            return self.numbered(super()._reset(tensordict, **kwargs))

        def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
            return self.numbered(super()._step(tensordict))

        def numbered(self, tensordict: TensorDictBase) -> TensorDictBase:
            return tensordict.exclude("observation").set("state", torch.randint(5, (ENVS,)))

    batch = Numbered(auto_reset=True, auto_reset_replace=True).rollout(
        STEPS, BoltzmannPrior(torch.randn(5, 2)).policy(), break_when_any_done=False
    )
    ended = batch["next", "done"].squeeze(-1)
    assert (batch["next", "state"][ended] == -1).all()
    prior, weight = BoltzmannPrior(torch.randn(5, 2)), PriorWeight.table(5)
    batch = PriorBonus(weight)(PriorLogProb(prior, boundary="zero")(batch))
    assert batch["next", "prior_bonus"].isfinite().all()
