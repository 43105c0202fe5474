"""Priors in files that the tests of artifacts share."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import pytest
import safetensors.torch
import torch
from tensordict import TensorDict
from torch import nn
from torchrl.data import Bounded
from torchrl.envs.utils import ExplorationType, set_exploration_type
from torchrl.modules import OneHotCategorical, ProbabilisticActor, TanhNormal

from torchrl_priors import (
    ActionPrior,
    AffordancePrior,
    BoltzmannPrior,
    MixturePrior,
    ModulePrior,
    UniformPrior,
    load_prior,
    policy_prior,
    save_prior,
)
from torchrl_priors.artifacts import ArtifactError, read_manifest
from torchrl_priors.collectors import RunningNorm
from torchrl_priors.networks import make_actor
from torchrl_priors.priors.layers import (
    ClipToBox,
    GaussianHead,
    NatureCNN,
    ScaleToBox,
    StateIndependentStd,
    TeacherInput,
)

OBS, ACTIONS = 4, 3
NETWORK = "prior.network."
SCALE = f"{NETWORK}1.scale.state_independent_scale"


class Saved(NamedTuple):
    path: Path
    actor: ProbabilisticActor
    normalizer: RunningNorm


def trained(**kwargs: Any) -> tuple[ProbabilisticActor, RunningNorm]:
    """An actor and statistics with no value left as it starts."""
    actor = make_actor(OBS, ACTIONS, **kwargs)
    with torch.no_grad():
        for parameter in actor.parameters():
            parameter.add_(torch.randn_like(parameter) * 0.3)
    normalizer = RunningNorm(OBS)
    normalizer.update(torch.randn(50, OBS) * torch.tensor([0.1, 1.0, 10.0, 100.0]) + 3)
    return actor, normalizer


def save(path: Path) -> Saved:
    actor, normalizer = trained(hidden=(8, 8))
    save_prior(path, policy_prior(actor, normalizer), env_id="Hopper-v5")
    return Saved(path, actor, normalizer)


def table(seed: int = 0, states: int = 5) -> torch.Tensor:
    return torch.rand(states, ACTIONS, generator=torch.Generator().manual_seed(seed))


def net(out: int = ACTIONS, features: int = OBS) -> nn.Sequential:
    return nn.Sequential(nn.Linear(features, 8), nn.SiLU(), nn.Linear(8, out))


def gaussian(*layers: nn.Module) -> ModulePrior:
    return ModulePrior(nn.Sequential(*layers), "mean_std")


def normalised(**kwargs: Any) -> TeacherInput:
    return TeacherInput((OBS,), statistics=(torch.randn(OBS), torch.rand(OBS)), **kwargs)


STORABLE: dict[str, Callable[[], ActionPrior]] = {
    "policy": lambda: policy_prior(*trained()),
    "policy_of_other_layers": lambda: policy_prior(*trained(hidden=(5, 6, 7), activation="elu")),
    "policy_without_layers": lambda: policy_prior(*trained(hidden=())),
    "policy_of_raw_observations": lambda: policy_prior(trained()[0], None),
    "policy_of_discrete_actions": lambda: policy_prior(make_actor(OBS, ACTIONS, discrete=True), trained()[1]),
    "logits": lambda: ModulePrior(net(), "logits", in_keys=[("agent", "observation")]),
    "mean": lambda: ModulePrior(net(), "mean", std=torch.tensor([0.1, 0.2, 0.3])),
    "squashed": lambda: ModulePrior(
        net(), "mean", std=0.2, distribution_class=TanhNormal,
        distribution_kwargs={"low": torch.zeros(ACTIONS), "high": 2 * torch.ones(ACTIONS)},
    ),
    "boxed": lambda: ModulePrior(
        nn.Sequential(net(), nn.Tanh(), ScaleToBox(-torch.ones(ACTIONS), torch.ones(ACTIONS))), "mean", std=0.2
    ),
    "clipped": lambda: gaussian(
        net(), ClipToBox(torch.zeros(3), torch.tensor([1.0, 2.0, torch.inf])), StateIndependentStd(torch.zeros(3))
    ),
    "own_std": lambda: gaussian(normalised(clip=3), net(), StateIndependentStd(torch.randn(ACTIONS))),
    "head": lambda: gaussian(normalised(eps=0.1), GaussianHead(OBS, ACTIONS, log_std_range=(-3, 1.5))),
    "pixels": lambda: ModulePrior(
        nn.Sequential(TeacherInput((1, 36, 36), pixels=True, flatten=False), NatureCNN((1, 36, 36), 8), net(4, 8)),
        "logits", in_keys=["pixels"],
    ),
    "table": lambda: BoltzmannPrior(table(), 0.3),
    "worlds": lambda: BoltzmannPrior(torch.stack([table(), table(1)]), distribution_class=OneHotCategorical),
    "q_network": lambda: BoltzmannPrior(net(), 2.0),
    "affordances": lambda: AffordancePrior(table() > 0.4, 0.2),
    "uniform": lambda: UniformPrior(ACTIONS),
    "box": lambda: UniformPrior(Bounded(torch.zeros(2), torch.ones(2), shape=(2,))),
    "mixture": lambda: MixturePrior(
        [BoltzmannPrior(table()), MixturePrior([ModulePrior(net(), "logits"), UniformPrior(ACTIONS)], [3.0, 1.0])],
        torch.rand(5, 2),
    ),
    "mixture_of_policies": lambda: MixturePrior([policy_prior(*trained()), policy_prior(*trained())], [0.2, 0.8]),
}  # fmt: skip


def raw_batch(*batch: int) -> TensorDict:
    return TensorDict(observation=torch.randn(*batch, OBS) * 20, batch_size=batch)


def act(actor: ProbabilisticActor, normalizer: RunningNorm | None, batch: TensorDict, seed: int = 0) -> TensorDict:
    """What a policy does at raw observations, sampled."""
    normal = batch["observation"] if normalizer is None else normalizer(batch["observation"])
    with torch.no_grad(), torch.random.fork_rng(devices=[]), set_exploration_type(ExplorationType.RANDOM):
        torch.manual_seed(seed)
        return actor(TensorDict(observation_norm=normal, batch_size=batch.batch_size))


def contents(path: Path) -> tuple[dict[str, torch.Tensor], dict[str, Any]]:
    """The tensors and the manifest of a file, to forge another."""
    return safetensors.torch.load(path.read_bytes()), vars(read_manifest(path))


def refused(path: Path, match: str) -> None:
    """Every reader refuses the file, for one reason, and says which file; a terminal can show it."""
    for reader in (load_prior, read_manifest):
        with pytest.raises(ArtifactError, match=match) as caught:
            reader(path)
        message = str(caught.value)
        assert str(path) in message
        assert message.isprintable()
        assert len(message) < 2000
