"""What every prior does, whichever it is: it plays, it stays as it is, and code of others can be one."""

from __future__ import annotations

import copy
import math
import pickle
from typing import Any

import pytest
import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor, nn
from torch import distributions as d
from torchrl.collectors import Collector
from torchrl.data import Bounded
from torchrl.envs.utils import ExplorationType, set_exploration_type
from trajectories import ACTIONS, PRIOR_LOGITS, actor, chain_with_time_limit, prior, trajectories

from torchrl_priors import (
    ActionPrior,
    AE2RLoss,
    AffordancePrior,
    CallablePrior,
    MixturePrior,
    ModulePrior,
    Prior,
    PriorLogProb,
    RandomDegradation,
    StructuralDegradation,
    UniformPrior,
)

BOX = Bounded(-1.0, 3.0, shape=(2,))
PRIORS: dict[str, Any] = {
    "action": lambda: ActionPrior(actor()),
    "boltzmann": prior,
    "adversary": lambda: prior().adversary(),
    "uniform": lambda: UniformPrior(ACTIONS),
    "affordance": lambda: AffordancePrior(torch.ones(9, ACTIONS)),
    "callable": lambda: CallablePrior(lambda state: int(state) % ACTIONS, num_actions=ACTIONS, in_keys=["state"]),
    "mixture": lambda: MixturePrior([prior(), UniformPrior(ACTIONS)]),
    "random": lambda: RandomDegradation(prior(), 0.5, seed=0),
    "structural": lambda: StructuralDegradation(prior(), lambda td: td["state"] > 1),
    "box": lambda: UniformPrior(BOX),
    "gaussian": lambda: ModulePrior(nn.Linear(3, 2), "mean", std=0.5),
    "gaussians": lambda: MixturePrior([ModulePrior(nn.Linear(3, 2), "mean", std=0.5) for _ in range(2)]),
}


def states(number: int = 200) -> TensorDict:
    return TensorDict(state=torch.arange(number) % 3, observation=torch.randn(number, 3), batch_size=[number])


@pytest.mark.parametrize("name", PRIORS)
def test_plays_the_actions_of_its_distribution_and_writes_nothing_else(name: str) -> None:
    teacher = PRIORS[name]()
    assert isinstance(teacher, Prior)
    assert not any(parameter.requires_grad for parameter in teacher.parameters())
    assert not any(module.training for module in teacher.train().modules())
    policy, batch = teacher.policy(), states()
    before = set(batch.keys(True, True))
    with set_exploration_type(ExplorationType.RANDOM):
        sampled = policy(batch.clone())
    assert set(sampled.keys(True, True)) - before == {"action"}
    assert teacher.log_prob(sampled).isfinite().all()
    for twin in (copy.deepcopy(policy),) if name in ("callable", "structural") else (
        copy.deepcopy(policy), pickle.loads(pickle.dumps(policy)),
    ):  # fmt: skip
        assert twin(batch.clone())["action"].shape == sampled["action"].shape


@pytest.mark.parametrize("shape", [(), (0,), (2, 0), (2, 3)])
@pytest.mark.parametrize("name", PRIORS)
def test_advises_on_a_batch_of_any_size(name: str, shape: tuple[int, ...]) -> None:
    teacher, flat = PRIORS[name](), states(max(1, math.prod(shape)))
    batch = flat[: math.prod(shape)].reshape(shape)
    params, expected = teacher.get_params(batch), teacher.get_params(flat)
    for key, value in params.items():
        assert value.shape == (*shape, *expected[key].shape[1:])
        if 0 not in shape and name != "random":
            torch.testing.assert_close(value.reshape_as(expected[key]), expected[key])
    assert teacher.log_prob(teacher.policy()(batch)).shape == shape


def test_samples_or_takes_the_mode_by_the_exploration_type() -> None:
    teacher, batch = prior(), TensorDict(state=torch.zeros(20_000, dtype=torch.long), batch_size=[20_000])
    assert (teacher.policy()(batch)["action"] == PRIOR_LOGITS[0].argmax()).all()
    with set_exploration_type(ExplorationType.RANDOM):
        frequency = teacher.policy()(batch)["action"].bincount(minlength=ACTIONS) / 20_000
    torch.testing.assert_close(frequency, PRIOR_LOGITS[0].exp(), atol=0.02, rtol=0)


def test_plays_in_an_environment_and_a_collector_with_a_new_draw_at_each_step() -> None:
    teacher = RandomDegradation(prior(), 0.5, seed=0)
    rollout = chain_with_time_limit().rollout(30, teacher.policy(), break_when_any_done=False)
    assert ("prior", "degraded") not in rollout.keys(True)
    bad = rollout["action"] != PRIOR_LOGITS[rollout["state"]].argmax(-1)
    assert 0 < bad.sum() < bad.numel()
    for batch in Collector(chain_with_time_limit(), prior().policy(), frames_per_batch=16, total_frames=16):
        assert batch["action"].shape == batch.batch_size


def test_the_policy_of_a_prior_writes_the_action_under_its_key() -> None:
    teacher = prior()
    teacher.set_keys(action=("agent", "action"))
    assert teacher.policy().out_keys == [("agent", "action")]
    assert ("agent", "action") in teacher.policy()(states()).keys(True)


class Always(Prior):
    """Advice of someone else's code."""

    def __init__(self, action: int) -> None:
        super().__init__(["state"], ["logits"], d.Categorical)
        self.register_buffer("logits", 5 * nn.functional.one_hot(torch.tensor(action), ACTIONS).float())

    @torch.no_grad()
    def get_params(self, tensordict: TensorDictBase) -> dict[str, Tensor]:
        return {"logits": self.logits.expand(*tensordict.batch_size, ACTIONS)}

    def build_dist(self, params: dict[str, Tensor]) -> d.Distribution:
        return d.Categorical(**params)


def test_a_prior_of_ones_own_goes_wherever_a_prior_goes() -> None:
    mine = Always(1)
    batch = PriorLogProb(mine, actor(), time_dim=0, keep_params=True)(trajectories(5))
    assert AE2RLoss(actor(), mine, method="kickstart", prior_in_batch=True)(batch)["loss_prior"].isfinite()
    mixed = MixturePrior([mine, UniformPrior(ACTIONS)]).get_dist(batch).probs
    assert (mixed.argmax(-1) == 1).all()
    assert (mine.adversary().get_dist(batch).probs.argmin(-1) == 1).all()
    assert (StructuralDegradation(mine, lambda td: td["state"] >= 0).get_dist(batch).probs.argmin(-1) == 1).all()


def test_parameters_are_written_by_their_names() -> None:
    class Backwards(Always):
        def __init__(self) -> None:
            Prior.__init__(self, ["state"], ["loc", "scale"], d.Normal)

        def get_params(self, tensordict: TensorDictBase) -> dict[str, Tensor]:
            return {"scale": torch.full(tensordict.batch_size, 2.0), "loc": torch.zeros(tensordict.batch_size)}

    batch = Backwards()(states())
    assert (batch["prior", "loc"] == 0).all()
    assert (batch["prior", "scale"] == 2).all()


def test_an_interface_is_no_prior() -> None:
    with pytest.raises(TypeError, match="abstract"):
        Prior(["state"], ["logits"], d.Categorical)
    with pytest.raises(TypeError, match="BoltzmannPrior is a prior already"):
        ActionPrior(prior())
