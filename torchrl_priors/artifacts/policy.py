"""Policies as files: save one, load it to go on with it, or as a teacher."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import torch
from tensordict import NestedKey
from tensordict.nn import ProbabilisticTensorDictModule, ProbabilisticTensorDictSequential, TensorDictModule
from torch import Tensor
from torchrl.data import Composite, TensorSpec
from torchrl.modules import IndependentNormal, ProbabilisticActor

from torchrl_priors.artifacts.errors import ArtifactError
from torchrl_priors.artifacts.format import pack, read, read_file, write_atomically
from torchrl_priors.artifacts.manifest import STATISTICS, PolicyManifest, PriorManifest, check_tensors, parse_manifest
from torchrl_priors.artifacts.prior import build_prior
from torchrl_priors.artifacts.spaces import check_spaces
from torchrl_priors.collectors.running_norm import RunningNorm
from torchrl_priors.networks import GaussianMLP, gaussian_actor
from torchrl_priors.priors import ActionPrior

__all__ = ["load_policy", "load_prior", "save_policy"]


def save_policy(
    path: str | os.PathLike[str],
    actor: ProbabilisticActor,
    normalizer: RunningNorm | None,
    *,
    env_id: str,
    seed: int | None = None,
    frames: int | None = None,
    evaluation: Mapping[str, Any] | None = None,
    training: Mapping[str, Any] | None = None,
) -> PolicyManifest:
    """Writes a policy and the statistics it was trained with to one ``.safetensors`` file, whole or not at all.

    The same policy gives the same bytes. The file appears under its name only when it is complete: whoever reads
    ``path`` meanwhile sees what was there before.

    Args:
        path (str or path): the file; its folder exists. A file of that name is replaced.
        actor (ProbabilisticActor): from :func:`~torchrl_priors.networks.make_actor`.
        normalizer (RunningNorm, optional): the statistics of the raw observations ``[obs_dim]``, as they are now.
            ``None`` for a policy that was trained on raw observations.

    Keyword Args:
        env_id (str): the environment, e.g. ``"HalfCheetah-v5"``.
        seed (int, optional): of the training.
        frames (int, optional): environment steps of the training.
        evaluation (mapping, optional): what JSON can hold, e.g. ``{"mean_return": 1828.0, "episodes": 50}``.
        training (mapping, optional): what JSON can hold, e.g. the configuration of the run.

    Returns:
        PolicyManifest: what was written beside the tensors.

    Raises:
        TypeError: the actor is not one of :func:`~torchrl_priors.networks.make_actor`, or the normalizer no
            RunningNorm.
        FileNotFoundError: the folder does not exist.
        ValueError: a parameter or a statistic is not finite, the shapes of actor and normalizer differ, or JSON can't
            hold ``evaluation`` or ``training``.
        ImportError: safetensors is not installed.

    Examples:
        >>> import tempfile, pathlib
        >>> from torchrl_priors.networks import make_actor
        >>> path = pathlib.Path(tempfile.mkdtemp(), "teacher.safetensors")
        >>> manifest = save_policy(path, make_actor(17, 6), RunningNorm(17), env_id="HalfCheetah-v5", seed=0)
        >>> prior = load_prior(path, env_id="HalfCheetah-v5")
        >>> prior.in_keys, prior.out_keys
        (['observation'], [('prior', 'loc'), ('prior', 'scale')])
    """
    net = _find_net(actor)
    tensors = {f"actor.{name}": value for name, value in net.state_dict().items()}
    if normalizer is not None:
        if not isinstance(normalizer, RunningNorm):
            raise TypeError(f"The statistics of a policy are those of a RunningNorm, got {type(normalizer).__name__}.")
        tensors |= {f"normalizer.{name}": getattr(normalizer, name) for name in STATISTICS}
    tensors = {name: value.detach().cpu().contiguous() for name, value in tensors.items()}
    manifest = PolicyManifest(
        env_id=env_id,
        obs_dim=net.obs_dim,
        act_dim=net.act_dim,
        hidden=net.hidden,
        activation=net.activation,
        normalizer=None if normalizer is None else {"eps": normalizer.eps, "clip": normalizer.clip},
        seed=seed,
        frames=frames,
        evaluation=dict(evaluation or {}),
        training=dict(training or {}),
    )
    try:
        manifest = parse_manifest(json.loads(json.dumps(asdict(manifest), allow_nan=False)))
        check_tensors(tensors, manifest)
    except (TypeError, ValueError) as error:
        raise ValueError(f"This policy can't be saved: {error}") from error
    write_atomically(Path(path), pack(tensors, asdict(manifest)))
    return manifest


def load_policy(
    path: str | os.PathLike[str],
    *,
    in_key: NestedKey = "observation_norm",
    device: torch.device | str | None = None,
) -> tuple[ProbabilisticActor, RunningNorm | None, PolicyManifest]:
    """Reads a policy that :func:`save_policy` wrote. No code in the file can run, and no random number is drawn.

    Args:
        path (str or path): the file.

    Keyword Args:
        in_key (NestedKey): where the actor reads *normalised* observations. Defaults to ``"observation_norm"``.
        device (torch.device, optional): defaults to the CPU.

    Returns:
        tuple: the actor, its frozen normalizer (``None`` if it reads raw observations), and its
        :class:`PolicyManifest`.

    Raises:
        FileNotFoundError: there is no such file.
        ArtifactError: the file is damaged, not a policy, of an unknown version or architecture, or has a parameter that
            is not finite.
        ImportError: safetensors is not installed.
    """
    tensors, manifest = read(Path(path))
    return *_build_policy(tensors, manifest, in_key, device), manifest


def _build_policy(
    tensors: dict[str, Tensor], manifest: PolicyManifest, in_key: NestedKey, device: torch.device | str | None
) -> tuple[ProbabilisticActor, RunningNorm | None]:
    # parameters are taken from the file: drawing them first would move the random numbers of the caller's run
    net = GaussianMLP(manifest.obs_dim, manifest.act_dim, manifest.hidden, manifest.activation, device="meta")
    net.load_state_dict(_strip(tensors, "actor."), assign=True)
    normalizer = None
    if manifest.normalizer is not None:
        normalizer = RunningNorm(manifest.obs_dim, **manifest.normalizer)
        for name, value in _strip(tensors, "normalizer.").items():
            getattr(normalizer, name).copy_(value)
        normalizer = normalizer.freeze().to(device)
    return gaussian_actor(net.to(device), in_key), normalizer


def load_prior(
    path: str | os.PathLike[str],
    *,
    env_id: str | None = None,
    observation_spec: TensorSpec | Sequence[int] | int | None = None,
    action_spec: TensorSpec | Sequence[int] | int | None = None,
    in_key: NestedKey | None = None,
    namespace: NestedKey = "prior",
    device: torch.device | str | None = None,
) -> ActionPrior:
    """Reads what :func:`save_policy` or :func:`save_prior` wrote as a teacher: raw observations in, its advice out.

    It normalises observations by the frozen statistics of its own training, whatever the student does to its own.

    Args:
        path (str or path): the file.

    Keyword Args:
        env_id (str, optional): the student's environment, which must be the teacher's. Defaults to ``None``: any
            environment with the same spaces.
        observation_spec (TensorSpec, sequence of int or int, optional): the student's raw observations, or the shape of
            one. Defaults to ``None``: not checked.
        action_spec (TensorSpec, sequence of int or int, optional): the student's actions, or the shape of one. Defaults
            to ``None``: not checked here, but whenever an action is scored. For a :func:`save_prior` file it needs
            ``observation_spec`` too, and a number may be that of discrete actions.
        in_key (NestedKey, optional): *raw* observations ``[*B, obs_dim]``. Defaults to ``None``: ``"observation"``, or
            what the prior of a :func:`save_prior` file read.
        namespace (NestedKey): the parameters are written under ``(namespace, name)``. Defaults to ``"prior"``.
        device (torch.device, optional): defaults to the CPU.

    Raises:
        FileNotFoundError: there is no such file.
        ArtifactError: as :func:`load_policy`, or the teacher is of another environment or other spaces.
        TypeError: a spec is one of several entries.
        ValueError: ``action_spec`` without ``observation_spec``, for a :func:`save_prior` file.
        ImportError: safetensors is not installed.
    """
    tensors, manifest = read_file(Path(path))
    if env_id is not None and env_id != manifest.env_id:
        raise ArtifactError(
            f"{path} is a policy of {manifest.env_id}, and the student's environment is {env_id}. With env_id=None a"
            " teacher of another environment with the same spaces is taken."
        )
    if isinstance(manifest, PriorManifest):
        try:
            prior = build_prior(tensors, manifest.prior, in_key=in_key, namespace=namespace)
            if observation_spec is not None:
                check_spaces(prior, observation_spec, action_spec)
            elif action_spec is not None:
                raise ValueError(
                    f"{path} is a prior of save_prior, which is asked about an observation to check its actions:"
                    " observation_spec is needed beside action_spec."
                )
        except ArtifactError as error:
            raise ArtifactError(f"{path} can't be used as a prior: {error}.") from error
        return prior.to(device)
    inner_key = ("_teacher", "observation")  # exists within the prior only
    actor, normalizer = _build_policy(tensors, manifest, inner_key, device)
    for name, spec, size in (
        ("observations", observation_spec, manifest.obs_dim),
        ("actions", action_spec, manifest.act_dim),
    ):
        if spec is not None and (shape := _event_shape(spec, name)) != (size,):
            raise ArtifactError(
                f"{path} is a policy with {name} of shape ({size},) ({manifest.env_id}), and the student's are of shape"
                f" {shape}."
            )
    first = TensorDictModule(
        _TeacherInput(normalizer, manifest),
        in_keys=["observation" if in_key is None else in_key],
        out_keys=[inner_key],
    )
    return ActionPrior(ProbabilisticTensorDictSequential(first, *actor.module), namespace=namespace)


class _TeacherInput(torch.nn.Module):
    """From raw observations to what a teacher's network reads."""

    def __init__(self, normalizer: RunningNorm | None, manifest: PolicyManifest) -> None:
        super().__init__()
        self.normalizer = normalizer
        self.obs_dim = manifest.obs_dim
        self.env_id = manifest.env_id

    def forward(self, observation: Tensor) -> Tensor:
        if observation.shape[-1:] != (self.obs_dim,):
            raise ValueError(
                f"A teacher of {self.env_id} reads raw observations [*B, {self.obs_dim}], got"
                f" {tuple(observation.shape)}."
            )
        return observation.float() if self.normalizer is None else self.normalizer(observation)


def _find_net(actor: ProbabilisticActor) -> GaussianMLP:
    """The network of an actor of :func:`~torchrl_priors.networks.make_actor`, if it is one and nothing else."""
    modules = list(actor.modules())
    nets = [module for module in modules if isinstance(module, GaussianMLP)]
    heads = [module for module in modules if isinstance(module, ProbabilisticTensorDictModule)]
    if (
        len(nets) != 1
        or len(heads) != 1
        or heads[0].distribution_class is not IndependentNormal
        or heads[0].distribution_kwargs
        or len(list(actor.state_dict())) != len(nets[0].state_dict())
    ):
        raise TypeError(
            f"Only actors of torchrl_priors.networks.make_actor can be saved, got a {type(actor).__name__} with"
            f" {len(nets)} GaussianMLP and other parts. Use torch.save for a network of your own."
        )
    return nets[0]


def _event_shape(spec: TensorSpec | Sequence[int] | int, name: str) -> tuple[int, ...]:
    """The shape of one observation or action; the leading dimensions of a spec are the batch of environments."""
    if isinstance(spec, Composite):
        raise TypeError(f"Pass the spec of the {name}, not one of several entries: {', '.join(map(str, spec.keys()))}.")
    if isinstance(spec, TensorSpec):
        if not spec.dtype.is_floating_point:
            raise ArtifactError(f"A Gaussian policy has continuous {name}, and the student's are {spec.dtype}.")
        return tuple(spec.shape[-1:])
    return (spec,) if isinstance(spec, int) else tuple(spec)


def _strip(tensors: dict[str, Tensor], prefix: str) -> dict[str, Tensor]:
    return {name.removeprefix(prefix): value for name, value in tensors.items() if name.startswith(prefix)}
