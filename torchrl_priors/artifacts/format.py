"""The format of a prior's file: safetensors whose metadata holds a version, a manifest and the digest of the file."""

from __future__ import annotations

import hashlib
import json
import os
import re
from pathlib import Path
from types import ModuleType
from typing import Any

from torch import Tensor

from torchrl_priors.artifacts.errors import ArtifactError, short

KIND = "torchrl_priors.prior"
_VERSION = 2
_FORMER_KIND = "torchrl_priors.policy"  # what only save_policy wrote, which is gone
_MAX_HEADER = 1 << 20  # bytes: a prior's header has a few thousand, another model's may have many
_MAX_FILE = 1 << 30  # bytes: a file's bytes are hashed in memory, so what it claims to need has an end
_NO_DIGEST = "0" * 64
_AGAIN = "of an older torchrl_priors, whose files this release does not read: write it again by save_prior"


def _safetensors() -> ModuleType:
    try:
        import safetensors.torch
    except ImportError as error:
        raise ImportError("Files of priors need safetensors: pip install 'torchrl-priors[artifacts]'.") from error
    return safetensors


def pack(tensors: dict[str, Tensor], manifest: Any, *, version: Any = _VERSION) -> bytes:
    """The bytes of a file that :func:`read` reads."""
    # the digest comes first, so that no zeros of the manifest are taken for its place
    about = json.dumps({"sha256": _NO_DIGEST, "version": version, "manifest": manifest}, allow_nan=False)
    data = _seal(_safetensors().torch.save(tensors, metadata={KIND: about}))
    if int.from_bytes(data[:8], "little") > _MAX_HEADER:
        raise ValueError(f"its manifest is longer than {_MAX_HEADER} bytes")
    if len(data) > _MAX_FILE:
        raise ValueError(f"it has {len(data)} bytes, and a file at most {_MAX_FILE}")
    return data


def _seal(data: bytes) -> bytes:
    """Puts the digest of the file, in which the digest's own place is zeros, into that place."""
    return data.replace(_NO_DIGEST.encode(), hashlib.sha256(data).hexdigest().encode(), 1)


def read(path: Path) -> tuple[dict[str, Tensor], Any]:
    """The tensors and the manifest of a file whose version and digest are right. What they say is not checked."""
    _safetensors()
    if not path.is_file():
        raise FileNotFoundError(f"No file of a prior at {path}.")
    data, about = _read_bytes(path)
    version, digest = about.get("version"), about.get("sha256")
    if type(version) is not int or version != _VERSION:
        older = type(version) is int and 0 < version < _VERSION
        known = _AGAIN if older else f"and this release reads version {_VERSION}: it may need a newer torchrl_priors"
        raise ArtifactError(f"it is of version {short(version)}, {known}")
    if not isinstance(digest, str) or not re.fullmatch(r"[0-9a-f]{64}", digest):
        raise ArtifactError("it is damaged: it has no digest")
    if _seal(data.replace(digest.encode(), _NO_DIGEST.encode(), 1)) != data:
        raise ArtifactError("it is damaged: its content does not match its digest")
    return _load(data), about.get("manifest")


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


def _read_bytes(path: Path) -> tuple[bytes, dict[str, Any]]:
    """A file of this format, and its metadata; another's tensors, which may be gigabytes, are not read."""
    with path.open("rb") as file:
        size = int.from_bytes(file.read(8), "little")
        if size > _MAX_HEADER:
            raise ArtifactError("it is not a safetensors file with one prior")
        header = file.read(size)
        try:
            if len(header) < size:
                raise ValueError
            metadata = json.loads(header.decode(), object_pairs_hook=_refuse_duplicates)["__metadata__"]
            former = _FORMER_KIND in metadata
        except (ValueError, TypeError, KeyError, RecursionError):  # JSON and UTF-8 errors are ValueErrors
            raise ArtifactError("it is truncated, or not a safetensors file with metadata") from None
        if former:
            raise ArtifactError(f"it is a policy {_AGAIN}")
        try:
            about = json.loads(metadata[KIND], parse_constant=_refuse_constant, object_pairs_hook=_refuse_duplicates)
        except (TypeError, KeyError):
            raise ArtifactError("it is a safetensors file, but not one of torchrl_priors.save_prior") from None
        except (ValueError, RecursionError):
            raise ArtifactError("it is damaged: its manifest is not JSON") from None
        if not isinstance(about, dict):
            raise ArtifactError("it is damaged: its manifest is not an object")
        if (size := os.fstat(file.fileno()).st_size) > _MAX_FILE:
            raise ArtifactError(f"it has {size} bytes, and a prior at most {_MAX_FILE}")
        file.seek(0)
        return file.read(size), about


def _refuse_constant(name: str) -> None:
    raise ValueError(f"{name} is not JSON")


def _refuse_duplicates(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    """An object of JSON; of two entries of one name, readers would differ about which one counts."""
    if len(values := dict(pairs)) < len(pairs):
        raise ValueError("an entry twice")
    return values
