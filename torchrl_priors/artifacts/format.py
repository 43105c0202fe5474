"""The format of a policy file: safetensors whose metadata holds a version, a manifest and the digest of the file."""

from __future__ import annotations

import hashlib
import itertools
import json
import os
import re
import reprlib
import secrets
import sys
from dataclasses import dataclass, field, fields
from pathlib import Path
from types import ModuleType
from typing import Any

import torch
from torch import Tensor

from torchrl_priors.artifacts.errors import ArtifactError, differing
from torchrl_priors.networks import ACTIVATIONS

__all__ = [
    "POLICY",
    "PRIOR",
    "STATISTICS",
    "ArtifactError",
    "PolicyManifest",
    "PriorManifest",
    "check_tensors",
    "pack",
    "parse_manifest",
    "parse_prior_manifest",
    "read",
    "read_file",
    "read_manifest",
    "write_atomically",
]

POLICY, PRIOR = "torchrl_priors.policy", "torchrl_priors.prior"
_VERSION = 1
_ARCHITECTURE = "gaussian_mlp"
_MAX_HEADER = 1 << 20  # bytes: a policy's header has a few thousand, another model's may have many
_MAX_FILE = 1 << 30  # bytes: a file's bytes are hashed in memory, so what it claims to need has an end
_NO_DIGEST = "0" * 64
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


def read_manifest(path: str | os.PathLike[str]) -> PolicyManifest | PriorManifest:
    """Reads what the file of a policy or a prior says of it, and checks the file as :func:`load_policy` does.

    Args:
        path (str or path): the file.

    Raises:
        FileNotFoundError: there is no such file.
        ArtifactError: as :func:`load_policy`.
        ImportError: safetensors is not installed.
    """
    return read_file(Path(path))[1]


def _safetensors() -> ModuleType:
    try:
        import safetensors.torch
    except ImportError as error:
        raise ImportError("Policy files need safetensors: pip install 'torchrl-priors[artifacts]'.") from error
    return safetensors


def pack(tensors: dict[str, Tensor], manifest: dict[str, Any], version: int = _VERSION, *, kind: str = POLICY) -> bytes:
    """The bytes of a file.

    Raises:
        ValueError: the manifest, or the whole file, is too long to be read again.
    """
    # the digest comes first, so that no zeros of the manifest are taken for its place
    about = json.dumps({"sha256": _NO_DIGEST, "version": version, "manifest": manifest}, allow_nan=False)
    data = _seal(_safetensors().torch.save(tensors, metadata={kind: about}))
    if int.from_bytes(data[:8], "little") > _MAX_HEADER:
        raise ValueError(f"This policy can't be saved: its manifest is longer than {_MAX_HEADER} bytes.")
    if len(data) > _MAX_FILE:
        raise ValueError(f"This policy can't be saved: it has {len(data)} bytes, and a file at most {_MAX_FILE}.")
    return data


def _seal(data: bytes) -> bytes:
    """Puts the digest of the file, in which the digest's own place is zeros, into that place."""
    return data.replace(_NO_DIGEST.encode(), hashlib.sha256(data).hexdigest().encode(), 1)


def write_atomically(path: Path, data: bytes) -> None:
    """Writes a file that appears under its name when it is complete, or not at all.

    Raises:
        FileNotFoundError: its folder does not exist.
    """
    if not path.parent.is_dir():
        raise FileNotFoundError(f"No folder {path.parent} to save a policy in.")
    partial = path.with_name(f".{path.name}.{secrets.token_hex(4)}.partial")
    try:
        with partial.open("xb") as file:
            file.write(data)
            file.flush()
            os.fsync(file.fileno())
        os.replace(partial, path)
    finally:
        partial.unlink(missing_ok=True)


def read(path: Path) -> tuple[dict[str, Tensor], PolicyManifest]:
    """The tensors and the manifest of a policy's file, after every check."""
    tensors, manifest = read_file(path)
    if not isinstance(manifest, PolicyManifest):
        raise ArtifactError(f"{path} can't be used as a policy: it is a prior of save_prior, which load_prior reads.")
    return tensors, manifest


def read_file(path: Path) -> tuple[dict[str, Tensor], PolicyManifest | PriorManifest]:
    """The tensors and the manifest of a file, after every check but of a prior's tensors, which building it does."""
    _safetensors()
    if not path.is_file():
        raise FileNotFoundError(f"No policy file at {path}.")
    try:
        data, kind, about = _read_bytes(path)
        version = about.get("version")
        if type(version) is not int or version != _VERSION:
            raise ArtifactError(
                f"it is of version {reprlib.repr(version)}, and this release reads version {_VERSION}: it may need a"
                " newer torchrl_priors"
            )
        digest = about.get("sha256")
        if not isinstance(digest, str) or not re.fullmatch(r"[0-9a-f]{64}", digest):
            raise ArtifactError("it is damaged: it has no digest")
        if _seal(data.replace(digest.encode(), _NO_DIGEST.encode(), 1)) != data:
            raise ArtifactError("it is damaged: its content does not match its digest")
        if kind == PRIOR:
            return _load(data), parse_prior_manifest(about.get("manifest"))
        manifest = parse_manifest(about.get("manifest"))
        tensors = _load(data)
        check_tensors(tensors, manifest)
    except ArtifactError as error:
        raise ArtifactError(f"{path} can't be used as a policy: {error}.") from error
    return tensors, manifest


def _load(data: bytes) -> dict[str, Tensor]:
    safetensors = _safetensors()
    try:
        tensors = {name: value.clone() for name, value in safetensors.torch.load(data).items()}
    except (safetensors.SafetensorError, KeyError, RuntimeError, ValueError) as error:  # e.g. a type torch lacks
        raise ArtifactError(f"its tensors can't be read: {error!r}") from None
    for name, value in tensors.items():
        if value.numel() == 0:  # [2**40, 0] takes no bytes of a file, and many of what is computed from it
            raise ArtifactError(f"{name} is empty: it is of shape {tuple(value.shape)}")
    return tensors


def _read_bytes(path: Path) -> tuple[bytes, str, dict[str, Any]]:
    """A file of this format, its kind and its metadata; another's tensors, which may be gigabytes, are not read."""
    with path.open("rb") as file:
        size = int.from_bytes(file.read(8), "little")
        if size > _MAX_HEADER:
            raise ArtifactError("it is not a safetensors file with one policy")
        header = file.read(size)
        try:
            if len(header) < size:
                raise ValueError
            metadata = json.loads(header.decode(), object_pairs_hook=_refuse_duplicates)["__metadata__"]
        except (ValueError, TypeError, KeyError, RecursionError):  # JSON and UTF-8 errors are ValueErrors
            raise ArtifactError("it is truncated, or not a safetensors file with metadata") from None
        try:
            kind = next(kind for kind in (POLICY, PRIOR) if kind in metadata)
            about = json.loads(metadata[kind], parse_constant=_refuse_constant, object_pairs_hook=_refuse_duplicates)
        except (TypeError, StopIteration):
            raise ArtifactError("it is a safetensors file, but not one of torchrl_priors.save_policy") from None
        except (ValueError, RecursionError):
            raise ArtifactError("it is damaged: its manifest is not JSON") from None
        if not isinstance(about, dict):
            raise ArtifactError("it is damaged: its manifest is not an object")
        if (size := os.fstat(file.fileno()).st_size) > _MAX_FILE:
            raise ArtifactError(f"it has {size} bytes, and a policy at most {_MAX_FILE}")
        file.seek(0)
        return file.read(size), kind, about


def _refuse_constant(name: str) -> None:
    raise ValueError(f"{name} is not JSON")


def _refuse_duplicates(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    """An object of JSON; of two entries of one name, readers would differ about which one counts."""
    if len(values := dict(pairs)) < len(pairs):
        raise ValueError("an entry twice")
    return values


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
    env_id = values["env_id"]
    if not isinstance(env_id, str) or not env_id or not env_id.isprintable():  # messages show it
        raise ArtifactError(f"it must name its environment, got env_id={reprlib.repr(env_id)}")
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
    for name in ("evaluation", "training"):
        if not isinstance(values[name], dict):
            raise ArtifactError(f"its {name} must be an object of JSON, got {reprlib.repr(values[name])}")
    return PolicyManifest(**{**values, "hidden": tuple(hidden)})


def parse_prior_manifest(values: Any) -> PriorManifest:
    """The manifest of a prior from JSON; its parts are checked when they are built."""
    names = {item.name for item in fields(PriorManifest)}
    if not isinstance(values, dict) or values.keys() != names:
        raise ArtifactError(f"its manifest must have the entries {', '.join(sorted(names))}")
    if not isinstance(values["env_id"], str) or not values["env_id"] or not values["env_id"].isprintable():
        raise ArtifactError(f"it must name its environment, got env_id={reprlib.repr(values['env_id'])}")
    for name in ("prior", "evaluation", "training"):
        if not isinstance(values[name], dict):
            raise ArtifactError(f"its {name} must be an object of JSON, got {values[name]!r}")
    return PriorManifest(**values)


def _is_count(value: Any, least: int) -> bool:
    return type(value) is int and value >= least


def check_tensors(tensors: dict[str, Tensor], manifest: PolicyManifest) -> None:
    """Holds names, shapes, types and values against the manifest, before any memory is given to a network."""
    sizes = [manifest.obs_dim, *manifest.hidden, manifest.act_dim]
    expected: dict[str, tuple[tuple[int, ...], torch.dtype]] = {}
    for layer, (inputs, outputs) in enumerate(itertools.pairwise(sizes)):
        expected[f"actor.mean.{2 * layer}.weight"] = (outputs, inputs), torch.float32
        expected[f"actor.mean.{2 * layer}.bias"] = (outputs,), torch.float32
    expected["actor.scale.state_independent_scale"] = (manifest.act_dim,), torch.float32
    if manifest.normalizer is not None:
        for name in STATISTICS:
            expected[f"normalizer.{name}"] = () if name == "count" else (manifest.obs_dim,), torch.float64
    if tensors.keys() != expected.keys():
        names = differing(tensors.keys() ^ expected.keys())
        raise ArtifactError(f"its tensors are not those of its manifest; missing or unexpected: {names}")
    for name, (shape, dtype) in expected.items():
        value = tensors[name]
        if tuple(value.shape) != shape or value.dtype is not dtype:
            raise ArtifactError(f"{name} must be {dtype} of shape {shape}, got {value.dtype} of {tuple(value.shape)}")
        if not value.isfinite().all():
            raise ArtifactError(f"{name} is not finite: it has NaN or infinite entries")
    deviation = tensors["actor.scale.state_independent_scale"].exp()
    if not (deviation.isfinite() & (deviation > 0)).all():
        raise ArtifactError("its standard deviations, the exponentials of state_independent_scale, overflow or vanish")
    if manifest.normalizer is not None and ((tensors["normalizer.var"] < 0).any() or tensors["normalizer.count"] < 0):
        raise ArtifactError("the statistics of its observations have a negative variance or count")
