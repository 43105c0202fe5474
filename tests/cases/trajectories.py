"""What tests of the transforms share: a tabular prior and student, batches of random steps, a small environment."""

from __future__ import annotations

from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import ProbabilisticTensorDictModule, ProbabilisticTensorDictSequential
from torch import distributions as d
from torchrl.data import Categorical, Composite, Unbounded
from torchrl.envs import EnvBase, StepCounter, TransformedEnv

from torchrl_priors.functional import categorical_cross_entropy
from torchrl_priors.priors import BoltzmannPrior
from torchrl_priors.state_table import StateTable

STATES, ACTIONS = 7, 3


def table(*batch: int) -> torch.Tensor:
    return torch.randn(*batch, STATES, ACTIONS, generator=torch.Generator().manual_seed(1))


def tabular_actor(logits: torch.Tensor) -> ProbabilisticTensorDictSequential:
    return ProbabilisticTensorDictSequential(
        StateTable(logits, in_key="state", out_key="logits", feature_dims=1),
        ProbabilisticTensorDictModule(
            ["logits"], ["action"], distribution_class=d.Categorical, default_interaction_type="random"
        ),
    )


PRIOR_TABLE, ACTOR_TABLE = table(), table().flip(0)
PRIOR_LOGITS, ACTOR_LOGITS = PRIOR_TABLE.log_softmax(-1), ACTOR_TABLE.log_softmax(-1)
CROSS_ENTROPY = categorical_cross_entropy(ACTOR_LOGITS, PRIOR_LOGITS)  # by state


def prior() -> BoltzmannPrior:
    return BoltzmannPrior(PRIOR_TABLE)


def actor() -> ProbabilisticTensorDictSequential:
    return tabular_actor(ACTOR_TABLE)


def trajectories(*shape: int, seed: int = 0, ends: float = 0.3, ids: bool = False, time_dim: int = -1) -> TensorDict:
    """Random steps. The next state of a step that goes on is the state of the next step, as in what is collected."""
    generator = torch.Generator().manual_seed(seed)

    def flags() -> torch.Tensor:
        return torch.rand(*shape, 1, generator=generator) < ends

    terminated, truncated = flags(), flags()
    batch = TensorDict(
        state=torch.randint(STATES, shape, generator=generator),
        action=torch.randint(ACTIONS, shape, generator=generator),
        next=TensorDict(
            state=torch.randint(STATES, shape, generator=generator),
            reward=torch.randn(*shape, 1, generator=generator),
            terminated=terminated,
            truncated=truncated,
            done=terminated | truncated,
        ),
        batch_size=shape,
    )
    if ids:  # they change at some steps that are not done: seams
        batch["collector", "traj_ids"] = torch.randint(2, shape, generator=generator)
    goes_on = ~batch["next", "done"].squeeze(-1)
    if ids:
        goes_on &= batch["collector", "traj_ids"] == batch["collector", "traj_ids"].roll(-1, time_dim)
    goes_on.select(time_dim, -1).fill_(False)
    batch["next", "state"] = torch.where(goes_on, batch["state"].roll(-1, time_dim), batch["next", "state"])
    return batch


class ChainEnv(EnvBase):
    """A walk over ``STATES`` states; the last one terminates."""

    def __init__(self, batch_size: tuple[int, ...] = ()) -> None:
        super().__init__(batch_size=batch_size)
        size = batch_size
        self.observation_spec = Composite(state=Categorical(STATES, shape=size), shape=size)
        self.action_spec = Categorical(ACTIONS, shape=size)
        self.reward_spec = Unbounded((*size, 1))

    def _reset(self, tensordict: TensorDictBase | None, **kwargs: Any) -> TensorDictBase:
        return self.full_done_spec.zero().set("state", torch.zeros(self.batch_size, dtype=torch.int64))

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        state = (tensordict["state"] + tensordict["action"]).clamp(max=STATES - 1)
        terminated = (state == STATES - 1).unsqueeze(-1)
        return TensorDict(
            state=state,
            reward=state.unsqueeze(-1).float(),
            terminated=terminated,
            done=terminated,
            batch_size=self.batch_size,
        )

    def _set_seed(self, seed: int | None) -> None:
        return None


def chain_with_time_limit() -> EnvBase:
    return TransformedEnv(ChainEnv(), StepCounter(max_steps=4))
