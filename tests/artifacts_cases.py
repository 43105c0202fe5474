"""Policies in files that the tests of artifacts share."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import Any, NamedTuple

import pytest
import safetensors.torch
import torch
from tensordict import TensorDict
from torchrl.envs.utils import ExplorationType, set_exploration_type
from torchrl.modules import ProbabilisticActor

from torchrl_priors.artifacts import ArtifactError, load_policy, load_prior, read_manifest, save_policy
from torchrl_priors.collectors.running_norm import RunningNorm
from torchrl_priors.networks import make_actor

OBS, ACTIONS = 4, 3
SCALE = "actor.scale.state_independent_scale"


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
    save_policy(path, actor, normalizer, env_id="Hopper-v5")
    return Saved(path, actor, normalizer)


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
    return safetensors.torch.load(path.read_bytes()), asdict(read_manifest(path))


def refused(path: Path, match: str) -> None:
    """Every reader refuses the file, for one reason, and says which file."""
    for reader in (load_policy, load_prior, read_manifest):
        with pytest.raises(ArtifactError, match=match) as caught:
            reader(path)
        assert str(path) in str(caught.value)
