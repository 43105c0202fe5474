"""What a file says of the policy or the prior in it, and whether its tensors are those that follow."""

from __future__ import annotations

import itertools
import reprlib
import sys
from dataclasses import dataclass, field, fields
from typing import Any, TypeAlias

import torch
from torch import Tensor

from torchrl_priors.artifacts.errors import ArtifactError, differing
from torchrl_priors.networks import ACTIVATIONS

__all__ = [
    "STATISTICS",
    "PolicyManifest",
    "PriorManifest",
    "Sizes",
    "check_against",
    "check_tensors",
    "parse_manifest",
    "parse_prior_manifest",
]

Sizes: TypeAlias = dict[str, tuple[tuple[int, ...], torch.dtype]]

_ARCHITECTURE = "gaussian_mlp"
STATISTICS = ("mean", "var", "count")
"""The buffers of a :class:`~torchrl_priors.collectors.RunningNorm`; a file has them after ``normalizer.``."""


@dataclass(frozen=True)
class PolicyManifest:
    """What a policy file says of its policy.

    Args:
        env_id (str): the environment that the policy was trained on, e.g. ``"HalfCheetah-v5"``.
        obs_dim (int): features of a raw observation.
        act_dim (int): dimensions of an action.
        hidden (tuple of int): cells of each hidden layer.
        activation (str): one of :data:`~torchrl_priors.networks.ACTIVATIONS`.
        architecture (str): the kind of network, ``"gaussian_mlp"`` (:class:`~torchrl_priors.networks.GaussianMLP`).
        normalizer (dict, optional): ``eps`` and ``clip`` of the :class:`~torchrl_priors.collectors.RunningNorm` whose
            statistics the file has; ``None`` if the policy reads raw observations.
        seed (int, optional): of the training.
        frames (int, optional): environment steps of the training.
        evaluation (dict): how good it is, e.g. ``{"mean_return": 1828.0, "episodes": 50}``.
        training (dict): how it was trained, e.g. the configuration of the run.
    """

    env_id: str
    obs_dim: int
    act_dim: int
    hidden: tuple[int, ...]
    activation: str
    architecture: str = _ARCHITECTURE
    normalizer: dict[str, float] | None = None
    seed: int | None = None
    frames: int | None = None
    evaluation: dict[str, Any] = field(default_factory=dict)
    training: dict[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class PriorManifest:
    """What the file of a prior (:func:`~torchrl_priors.artifacts.save_prior`) says of it.

    Args:
        env_id (str): the environment that it advises on, e.g. ``"HalfCheetah-v5"``.
        prior (dict): its parts: kinds of priors, layers of networks, and their sizes.
        evaluation (dict): how good it is, e.g. ``{"mean_return": 1828.0, "episodes": 50}``.
        training (dict): where it is from.
    """

    env_id: str
    prior: dict[str, Any]
    evaluation: dict[str, Any] = field(default_factory=dict)
    training: dict[str, Any] = field(default_factory=dict)


def parse_manifest(values: Any) -> PolicyManifest:
    """A manifest from JSON, checked entry by entry. What a message shows of it is short and printable."""
    names = {item.name for item in fields(PolicyManifest)}
    if not isinstance(values, dict) or values.keys() != names:
        raise ArtifactError(f"its manifest must have the entries {', '.join(sorted(names))}")
    if values["architecture"] != _ARCHITECTURE:
        raise ArtifactError(
            f"its architecture is unknown: {reprlib.repr(values['architecture'])}, expected {_ARCHITECTURE!r}"
        )
    if not isinstance(values["activation"], str) or values["activation"] not in ACTIVATIONS:
        raise ArtifactError(f"its activation is unknown: {reprlib.repr(values['activation'])}")
    _check_env_id(values)
    normalizer = values["normalizer"]
    if normalizer is not None and (
        not isinstance(normalizer, dict)
        or normalizer.keys() != {"eps", "clip"}
        or not all(type(value) in (int, float) and 0 < value <= sys.float_info.max for value in normalizer.values())
    ):
        raise ArtifactError(
            f"its normalizer must be null or have a positive eps and clip, got {reprlib.repr(normalizer)}"
        )
    hidden = values["hidden"]
    if not isinstance(hidden, list) or not all(_is_count(size, 1) for size in hidden):
        raise ArtifactError(f"its hidden layers must have positive sizes, got {reprlib.repr(hidden)}")
    for name in ("obs_dim", "act_dim"):
        if not _is_count(values[name], 1):
            raise ArtifactError(f"its {name} must be a positive integer, got {reprlib.repr(values[name])}")
    for name in ("seed", "frames"):
        if values[name] is not None and not _is_count(values[name], 0):
            raise ArtifactError(f"its {name} must be an integer of at least 0, got {reprlib.repr(values[name])}")
    _check_objects(values, "evaluation", "training")
    return PolicyManifest(**{**values, "hidden": tuple(hidden)})


def parse_prior_manifest(values: Any) -> PriorManifest:
    """The manifest of a prior from JSON; its parts are checked when they are built."""
    names = {item.name for item in fields(PriorManifest)}
    if not isinstance(values, dict) or values.keys() != names:
        raise ArtifactError(f"its manifest must have the entries {', '.join(sorted(names))}")
    _check_env_id(values)
    _check_objects(values, "prior", "evaluation", "training")
    return PriorManifest(**values)


def _check_env_id(values: dict[str, Any]) -> None:
    env_id = values["env_id"]
    if not isinstance(env_id, str) or not env_id or not env_id.isprintable():  # messages show it
        raise ArtifactError(f"it must name its environment, got env_id={reprlib.repr(env_id)}")


def _check_objects(values: dict[str, Any], *names: str) -> None:
    for name in names:
        if not isinstance(values[name], dict):
            raise ArtifactError(f"its {name} must be an object of JSON, got {reprlib.repr(values[name])}")


def _is_count(value: Any, least: int) -> bool:
    return type(value) is int and value >= least


def check_tensors(tensors: dict[str, Tensor], manifest: PolicyManifest) -> None:
    """Holds names, shapes, types and values against the manifest, before any memory is given to a network."""
    sizes = [manifest.obs_dim, *manifest.hidden, manifest.act_dim]
    expected: Sizes = {}
    for layer, (inputs, outputs) in enumerate(itertools.pairwise(sizes)):
        expected[f"actor.mean.{2 * layer}.weight"] = (outputs, inputs), torch.float32
        expected[f"actor.mean.{2 * layer}.bias"] = (outputs,), torch.float32
    expected["actor.scale.state_independent_scale"] = (manifest.act_dim,), torch.float32
    if manifest.normalizer is not None:
        for name in STATISTICS:
            expected[f"normalizer.{name}"] = () if name == "count" else (manifest.obs_dim,), torch.float64
    check_against(tensors, expected)
    deviation = tensors["actor.scale.state_independent_scale"].exp()
    if not (deviation.isfinite() & (deviation > 0)).all():
        raise ArtifactError("its standard deviations, the exponentials of state_independent_scale, overflow or vanish")
    if manifest.normalizer is not None and ((tensors["normalizer.var"] < 0).any() or tensors["normalizer.count"] < 0):
        raise ArtifactError("the statistics of its observations have a negative variance or count")


def check_against(tensors: dict[str, Tensor], expected: Sizes) -> None:
    """Refuses tensors of other names, shapes or types than expected, and values that are not finite."""
    if tensors.keys() != expected.keys():
        names = differing(tensors.keys() ^ expected.keys())
        raise ArtifactError(f"its tensors are not those of its manifest; missing or unexpected: {names}")
    for name, (shape, dtype) in expected.items():
        value = tensors[name]
        if tuple(value.shape) != shape or value.dtype is not dtype:
            raise ArtifactError(f"{name} must be {dtype} of shape {shape}, got {value.dtype} of {tuple(value.shape)}")
        if not value.isfinite().all():
            raise ArtifactError(f"{name} is not finite: it has NaN or infinite entries")
