"""Priors as files: write one, read it, or only what it says of itself."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import torch
from tensordict import NestedKey
from torchrl.data import TensorSpec

from torchrl_priors.artifacts.errors import ArtifactError, refusing
from torchrl_priors.artifacts.format import pack, read
from torchrl_priors.artifacts.manifest import PriorManifest, parse_manifest
from torchrl_priors.artifacts.prior import build_prior, describe_prior
from torchrl_priors.artifacts.spaces import check_spaces
from torchrl_priors.atomic import write_atomically
from torchrl_priors.priors import Prior

_PURPOSE = "a prior"


def save_prior(
    path: str | os.PathLike[str],
    prior: Prior,
    *,
    env_id: str,
    seed: int | None = None,
    frames: int | None = None,
    evaluation: Mapping[str, Any] | None = None,
    training: Mapping[str, Any] | None = None,
) -> PriorManifest:
    """Writes a prior to one ``.safetensors`` file, whole or not at all; :func:`load_prior` reads it.

    Tables and networks of known layers go into a file, and so do mixtures of such priors. Code does not: a
    :class:`CallablePrior`, a function, a network with layers of its own. The same prior gives the same bytes, and so
    does what :func:`load_prior` made of them. The file appears under its name only when it is complete: whoever reads
    ``path`` meanwhile sees what was there before.

    Args:
        path (str or path): the file; its folder exists. A file of that name is replaced.
        prior (Prior): a :class:`ModulePrior`, :class:`BoltzmannPrior`, :class:`AffordancePrior`,
            :class:`UniformPrior` or :class:`MixturePrior`; so are those that :func:`policy_prior`,
            :func:`load_sb3_prior` and :func:`load_prior` give.

    Keyword Args:
        env_id (str): the environment that it advises on, e.g. ``"HalfCheetah-v5"``.
        seed (int, optional): of its training.
        frames (int, optional): environment steps of its training.
        evaluation (mapping, optional): what JSON can hold, e.g. ``{"mean_return": 1828.0, "episodes": 50}``.
        training (mapping, optional): what JSON can hold, e.g. the configuration of the run.

    Returns:
        PriorManifest: what was written beside the tensors.

    Raises:
        TypeError: a part of the prior is code that no file can hold.
        FileNotFoundError: the folder does not exist.
        ValueError: a parameter or a statistic is not finite, or JSON can't hold an entry.
        ImportError: safetensors is not installed.

    Examples:
        >>> import tempfile, pathlib
        >>> from torchrl_priors import AffordancePrior
        >>> path = pathlib.Path(tempfile.mkdtemp(), "affordances.safetensors")
        >>> prior = AffordancePrior(torch.tensor([[True, True, False], [False, True, True]]))
        >>> manifest = save_prior(path, prior, env_id="Toy-v0")
        >>> load_prior(path, env_id="Toy-v0").in_keys
        ['state']
    """
    if not isinstance(prior, Prior):
        raise TypeError(f"save_prior writes priors, got {type(prior).__name__}.")
    parts, tensors = describe_prior(prior)
    told = {"env_id": env_id, "prior": parts, "seed": seed, "frames": frames}
    told |= {"evaluation": dict(evaluation or {}), "training": dict(training or {})}
    try:
        values = json.loads(json.dumps(told, allow_nan=False))
        manifest = parse_manifest(values)
        build_prior(manifest.prior, tensors)  # what can't be read again is not written
        data = pack(tensors, values)
    except (TypeError, ValueError) as error:
        raise ValueError(f"This prior can't be saved to {path}: {error}") from error
    write_atomically(Path(path), data)
    return manifest


def load_prior(
    path: str | os.PathLike[str],
    *,
    env_id: str | None = None,
    observation_spec: TensorSpec | Sequence[int] | int | None = None,
    action_spec: TensorSpec | Sequence[int] | int | None = None,
    in_key: NestedKey | None = None,
    namespace: NestedKey = "prior",
    device: torch.device | str | None = None,
) -> Prior:
    """Reads what :func:`save_prior` wrote. No code in the file can run, and no random number is drawn.

    Args:
        path (str or path): the file.

    Keyword Args:
        env_id (str, optional): the student's environment, which must be the teacher's. Defaults to ``None``: any
            environment with the same spaces.
        observation_spec (TensorSpec, sequence of int or int, optional): the student's raw observations, or the shape of
            one. Defaults to ``None``: not checked.
        action_spec (TensorSpec, sequence of int or int, optional): the student's actions, the shape of one, or the
            number of discrete ones. The bounds of a spec must be those of the prior, if it has some:
            :class:`~torchrl_priors.priors.RescaledPrior` takes it to others. Needs ``observation_spec``. Defaults to
            ``None``: not checked here, but whenever an action is scored.
        in_key (NestedKey, optional): what to read in place of the one key that the prior read, e.g. *raw* observations
            ``[*B, obs_dim]``. Defaults to ``None``: the same.
        namespace (NestedKey): the parameters are written under ``(namespace, name)``. Defaults to ``"prior"``.
        device (torch.device, optional): defaults to the CPU.

    Raises:
        FileNotFoundError: there is no such file.
        ArtifactError: the file is damaged, of another program or an unknown version, or has a parameter that is not
            finite; or the teacher is of another environment or other spaces.
        TypeError: a spec is one of several entries.
        ValueError: ``action_spec`` without ``observation_spec``.
        ImportError: safetensors is not installed.
    """
    if action_spec is not None and observation_spec is None:
        raise ValueError(
            f"action_spec={action_spec} needs observation_spec beside it: {path} is asked about an observation to check"
            " its actions."
        )
    manifest, prior = _read(Path(path), in_key, namespace)
    if env_id is not None and env_id != manifest.env_id:
        raise ArtifactError(
            f"{path} is a prior of {manifest.env_id}, and the student's environment is {env_id}. With env_id=None a"
            " teacher of another environment with the same spaces is taken."
        )
    if observation_spec is not None:
        with refusing(path, _PURPOSE):
            check_spaces(prior, observation_spec, action_spec)
    return prior.to(device)


def read_manifest(path: str | os.PathLike[str]) -> PriorManifest:
    """Reads what the file of a prior says of it; checks the file, and raises, as :func:`load_prior` does."""
    return _read(Path(path))[0]


def _read(path: Path, in_key: NestedKey | None = None, namespace: NestedKey = "prior") -> tuple[PriorManifest, Prior]:
    with refusing(path, _PURPOSE):
        tensors, values = read(path)
        manifest = parse_manifest(values)
        return manifest, build_prior(manifest.prior, tensors, in_key=in_key, namespace=namespace)
