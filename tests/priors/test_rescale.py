"""Claims about teachers in the unit of the environment, of students whose actions are scaled."""

from __future__ import annotations

from copy import deepcopy
from typing import Any

import numpy as np
import pytest
import torch
from tensordict import TensorDict
from torch import nn
from torchrl.data import Bounded
from torchrl.envs import ActionScaling, GymEnv, TransformedEnv
from torchrl.modules import IndependentNormal, TanhNormal

from torchrl_priors import CallablePrior, MixturePrior, ModulePrior, Prior, UniformPrior, load_prior, save_prior
from torchrl_priors.artifacts import ArtifactError
from torchrl_priors.priors import RescaledPrior
from torchrl_priors.priors.layers import ClipToBox, StateIndependentStd

LOW, HIGH = torch.tensor([-2.0, 0.0]), torch.tensor([2.0, 0.5])


def squashed(seed: int = 0) -> Prior:
    torch.manual_seed(seed)
    net = nn.Sequential(nn.Linear(3, 2), StateIndependentStd(torch.zeros(2)))
    kwargs = {"low": LOW, "high": HIGH}
    return ModulePrior(net, "mean_std", distribution_class=TanhNormal, distribution_kwargs=kwargs)


TEACHERS: dict[str, Any] = {
    "gaussian": lambda: ModulePrior(nn.Linear(3, 2), "mean", std=torch.tensor([0.5, 0.1])),
    "callable": lambda: CallablePrior(lambda x: np.tanh(x[:2]), std=0.3),
    "squashed": squashed,
}


@pytest.mark.parametrize("shape", [(), (5,), (2, 3)])
@pytest.mark.parametrize("name", TEACHERS)
def test_a_rescaled_prior_has_the_density_of_the_scaled_action(name: str, shape: tuple[int, ...]) -> None:
    teacher = TEACHERS[name]()
    prior = RescaledPrior(teacher, LOW, HIGH, to_low=-1.0, to_high=torch.tensor([1.0, 3.0]))
    factor = torch.tensor([2.0, 4.0]) / (HIGH - LOW)
    batch = TensorDict(observation=torch.randn(*shape, 3), batch_size=shape)
    action = LOW + torch.rand(*shape, 2) * (HIGH - LOW)
    scaled = batch.copy().set("action", -1 + (action - LOW) * factor)
    for ours, theirs in ((prior, teacher), (deepcopy(prior), teacher), (prior.adversary(), teacher.adversary())):
        expected = theirs.log_prob(batch.copy().set("action", action)) - factor.log().sum()
        torch.testing.assert_close(ours.log_prob(scaled), expected)


def test_a_rescaled_prior_plays_behind_action_scaling_as_the_teacher_does_before() -> None:
    teacher = CallablePrior(lambda x: 1.5 * x[1:2], std=0.2)
    raw, scaled = GymEnv("Pendulum-v1"), TransformedEnv(GymEnv("Pendulum-v1"), ActionScaling())
    space = scaled.action_spec.space
    prior = RescaledPrior(teacher, -2.0, 2.0, to_low=space.low, to_high=space.high)
    for env in (raw, scaled):
        env.set_seed(0)
    expected, found = raw.rollout(20, teacher.policy()), scaled.rollout(20, prior.policy())
    torch.testing.assert_close(found["observation"], expected["observation"])
    torch.testing.assert_close(found["next", "reward"], expected["next", "reward"])


def test_bounds_that_differ_are_refused_where_both_are_known(tmp_path: Any) -> None:
    clipped = ModulePrior(
        nn.Sequential(nn.Linear(3, 2), ClipToBox(LOW, torch.tensor([2.0, torch.inf])), StateIndependentStd(LOW)),
        "mean_std",
        distribution_class=IndependentNormal,
    )
    half = torch.tensor([2.0, 7.0])
    behind = Bounded(-1.0, 1.0, shape=(2,))
    uniform = UniformPrior(Bounded(LOW, HIGH, shape=(2,)))
    for number, (teacher, same) in enumerate(((squashed(), HIGH), (clipped, half), (uniform, HIGH))):
        path = tmp_path / str(number)
        save_prior(path, teacher, env_id="Toy-v0")
        load_prior(path, observation_spec=3, action_spec=Bounded(LOW, same, shape=(2,)))
        load_prior(path, observation_spec=3, action_spec=Bounded(LOW, same, shape=(2,)).expand(4, 2))
        with pytest.raises(ArtifactError, match=r"acts within .*-2.0, 0.0.*, and the student within .*RescaledPrior"):
            load_prior(path, observation_spec=3, action_spec=behind)
    both = MixturePrior(
        [
            clipped,
            TEACHERS["gaussian"](),
            ModulePrior(
                nn.Sequential(
                    nn.Linear(3, 2), ClipToBox(behind.space.low, behind.space.high), StateIndependentStd(LOW)
                ),
                "mean_std",
            ),
        ]
    )
    save_prior(tmp_path / "both", both, env_id="Toy-v0")
    with pytest.raises(ArtifactError, match=r"acts within .*-2.0, 0.0"):
        load_prior(tmp_path / "both", observation_spec=3, action_spec=behind)
    save_prior(tmp_path / "free", TEACHERS["gaussian"](), env_id="Toy-v0")
    load_prior(tmp_path / "free", observation_spec=3, action_spec=behind)  # its bounds are not known


def test_what_cannot_be_rescaled_is_refused() -> None:
    batch = TensorDict(observation=torch.zeros(1, 3), batch_size=[1])
    mixture = MixturePrior([TEACHERS["gaussian"](), TEACHERS["gaussian"]()])
    for teacher in (UniformPrior(Bounded(LOW, HIGH, shape=(2,))), mixture, UniformPrior(2)):
        with pytest.raises(NotImplementedError, match="one of a Gaussian or a TanhNormal"):
            RescaledPrior(teacher, LOW, HIGH).get_dist(batch)
    for low, high in ((1.0, -1.0), (-np.inf, 1.0), (0.0, 0.0)):
        with pytest.raises(ValueError, match="finite, the lower ones below the upper ones"):
            RescaledPrior(squashed(), low, high)


def test_the_adversary_of_a_prior_that_was_moved_is_where_it_is() -> None:
    prior = RescaledPrior(squashed(), LOW, HIGH).to("meta")
    assert prior.adversary().factor.device == prior.factor.device
