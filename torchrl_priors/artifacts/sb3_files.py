"""What the files of Stable-Baselines3 hold, read without it and without running their pickles."""

from __future__ import annotations

import base64
import json
import re
import sys
import zipfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchrl_priors.artifacts.errors import ArtifactError, InertPickleError, refusing, short
from torchrl_priors.artifacts.inert_pickle import MAX_BYTES, StandIn, read_pickle
from torchrl_priors.artifacts.torch_files import read_torch

_MAX_WEIGHTS = 1 << 30  # bytes, unpacked; of all else, MAX_BYTES
_OLDER = re.compile(rb"stable_baselines\.\w")
_OLDER_MESSAGE = (
    "it is of Stable-Baselines 2, which runs on TensorFlow and is not supported. It can play its policy:"
    " CallablePrior(lambda o: model.predict(o, deterministic=True)[0], std=...)"
)


@dataclass(frozen=True)
class Space:
    """A Gymnasium space: ``Box`` has bounds, ``Discrete`` a number of actions."""

    kind: str
    shape: tuple[int, ...] = ()
    dtype: str = ""
    low: np.ndarray[Any, Any] | None = None
    high: np.ndarray[Any, Any] | None = None
    n: int = 0
    start: int = 0

    @property
    def is_image(self) -> bool:
        """Whether Stable-Baselines3 takes it for pixels: three dimensions, uint8, from 0 to 255."""
        if self.low is None or self.high is None or len(self.shape) != 3 or self.dtype != "uint8":
            return False
        return bool((self.low == 0).all() and (self.high == 255).all())


@dataclass(frozen=True)
class Checkpoint:
    """What a model's ``.zip`` says of its policy."""

    observation_space: Space
    action_space: Space
    policy_module: str
    options: dict[str, Any]
    use_sde: bool
    original_obs: bool
    """Whether it has observations as they were before ``VecNormalize``; off-policy models have some in any case."""
    version: str
    weights: dict[str, Tensor]


@dataclass(frozen=True)
class Statistics:
    """Of the observations of a ``VecNormalize``: mean and variance in float64."""

    mean: Tensor
    var: Tensor
    epsilon: float
    clip: float


def read_checkpoint(path: Path) -> Checkpoint:
    """Reads a model that Stable-Baselines3's ``model.save`` wrote."""
    if not path.is_file():
        raise FileNotFoundError(f"No Stable-Baselines3 model at {path}.")
    try:
        if not zipfile.is_zipfile(path):
            with path.open("rb") as file:
                _refuse_older(file.read(MAX_BYTES))
        with zipfile.ZipFile(path) as archive:
            if "parameter_list" in archive.namelist():
                raise ArtifactError(_OLDER_MESSAGE)
            data, weights = _member(archive, "data"), _member(archive, "policy.pth")
            names = archive.namelist()
            version = _member(archive, "_stable_baselines3_version") if "_stable_baselines3_version" in names else b""
        values = json.loads(data)
    except ArtifactError:
        raise
    except Exception as error:  # a damaged archive fails in any way
        raise ArtifactError(f"it is damaged, or no zip of a model: {type(error).__name__}: {error}") from None
    if not isinstance(values, dict):
        raise ArtifactError("its data are no object of JSON")
    options, policy = values.get("policy_kwargs"), values.get("policy_class")
    options = options if isinstance(options, dict) else {}
    return Checkpoint(
        observation_space=_space(values, "observation_space"),
        action_space=_space(values, "action_space"),
        policy_module=str(policy.get("__module__")) if isinstance(policy, dict) else "",
        options=options,
        use_sde=any(part.get("use_sde") not in (None, False) for part in (values, options)),
        original_obs=values.get("_last_original_obs") is not None,
        version=version.decode("utf-8", "replace").strip()[:100],
        weights=_weights(weights),
    )


def _refuse_older(data: bytes) -> None:
    """Recognises a pickle by the names in it."""
    if _OLDER.search(data):
        raise ArtifactError(_OLDER_MESSAGE)


def _member(archive: zipfile.ZipFile, name: str) -> bytes:
    if name not in archive.namelist():
        raise ArtifactError(f"it has no {name}: it is no model of Stable-Baselines3")
    limit = _MAX_WEIGHTS if name == "policy.pth" else MAX_BYTES
    entry = archive.getinfo(name)
    if entry.file_size > limit:
        raise ArtifactError(f"its {name} is longer than {limit} bytes")
    if entry.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):  # others are unpacked without a limit
        raise ArtifactError(f"its {name} is compressed in a way that Stable-Baselines3 does not use")
    with archive.open(entry) as file:
        return file.read(entry.file_size + 1)  # what is unpacked may be more than the directory says


def _weights(data: bytes) -> dict[str, Tensor]:
    try:
        weights = read_torch(data)
    except Exception as error:  # a damaged file fails in any way
        reason = (str(error).splitlines() or [""])[0]
        raise ArtifactError(f"its policy.pth can't be read as tensors: {type(error).__name__}: {reason}") from None
    if not isinstance(weights, dict) or not all(
        isinstance(name, str) and isinstance(value, Tensor) for name, value in weights.items()
    ):
        raise ArtifactError("its policy.pth is no dictionary of tensors")
    for name, value in weights.items():
        if value.numel() * value.element_size() > len(data):  # a view of one number as many
            raise ArtifactError(f"{short(name)} of shape {tuple(value.shape)} is larger than the file")
    if sum(value.numel() * value.element_size() for value in weights.values()) > 4 * len(data):
        raise ArtifactError("its tensors are larger than the file")  # a features extractor may be there three times
    return dict(weights)


def _space(values: dict[str, Any], name: str) -> Space:
    entry = values.get(name)
    try:
        encoded = entry[":serialized:"]  # type: ignore[index]
        found = read_pickle(base64.b64decode(encoded, validate=True))
    except InertPickleError as error:
        raise ArtifactError(f"its {name} can't be read: {error}") from None
    except (KeyError, TypeError, ValueError):
        raise ArtifactError(f"it has no {name}: it is no model of Stable-Baselines3") from None
    return as_space(found, name)


def as_space(found: Any, name: str) -> Space:
    """A space from its stand-in."""
    kind = found.pickled_name.rpartition(".")[2] if isinstance(found, StandIn) else type(found).__name__
    if kind not in ("Box", "Discrete"):
        return Space(kind)
    state = found.state
    if kind == "Discrete":
        n, start = state.get("n"), state.get("start", 0)
        if type(n) is not int or type(start) is not int or not 1 <= n < 1 << 31 or abs(start) >= 1 << 31:
            raise ArtifactError(f"its {name} is damaged: Discrete with n={short(n)}, start={short(start)}")
        return Space(kind, n=n, start=start)
    low, high = state.get("low"), state.get("high")
    if not isinstance(low, np.ndarray) or not isinstance(high, np.ndarray) or low.shape != high.shape:
        raise ArtifactError(f"its {name} is damaged: a Box without bounds")
    return Space(kind, shape=low.shape, dtype=str(low.dtype), low=low, high=high)


def read_vecnormalize(path: Path) -> Statistics | None:
    """Reads what Stable-Baselines3's ``VecNormalize.save`` wrote; ``None`` if it leaves observations as they are."""
    if not path.is_file():
        raise FileNotFoundError(f"No VecNormalize statistics at {path}.")
    with refusing(path, "VecNormalize statistics"):
        if (size := path.stat().st_size) > MAX_BYTES:
            raise ArtifactError(f"it has {size} bytes, expected at most {MAX_BYTES}")
        data = path.read_bytes()
        _refuse_older(data)
        found = read_pickle(data)
        if not isinstance(found, StandIn) or not found.pickled_name.endswith(".VecNormalize"):
            raise ArtifactError(f"it holds {type(found).__name__}, expected VecNormalize")
        state = found.state
        if state.get("norm_obs", True) is False:
            return None
        rms = state.get("obs_rms")
        if isinstance(rms, dict) or state.get("norm_obs_keys"):
            raise ArtifactError("it normalises observations of several entries, which is not supported")
        values = rms.state if isinstance(rms, StandIn) else {}
        mean, var = values.get("mean"), values.get("var")
        epsilon, clip = state.get("epsilon"), state.get("clip_obs")
        if not isinstance(mean, np.ndarray) or not isinstance(var, np.ndarray) or mean.shape != var.shape:
            raise ArtifactError("it has no mean and variance of observations")
        if not (np.isfinite(mean).all() and np.isfinite(var).all() and (var >= 0).all()):
            raise ArtifactError("its mean or variance is not finite, or negative")
        for name, value in (("epsilon", epsilon), ("clip_obs", clip)):
            if not isinstance(value, (int, float)) or not 0 < value <= sys.float_info.max:
                raise ArtifactError(f"its {name} must be a positive number, got {short(value)}")
    as_tensor = torch.as_tensor
    return Statistics(as_tensor(mean).double(), as_tensor(var).double(), float(epsilon), float(clip))  # type: ignore[arg-type]
