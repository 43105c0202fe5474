"""Tensors in the format that PyTorch wrote before 1.6, as the first files of Stable-Baselines3 have it."""

from __future__ import annotations

import io
import pickle
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from torchrl_priors.artifacts.errors import InertPickleError, short
from torchrl_priors.artifacts.pickle_program import check_program

LEGACY_START = pickle.dumps(0x1950A86A20F9469CFC6C, protocol=2)
"""How such a file begins: with the pickle of this number."""

_STORAGES = {
    "torch.BFloat16Storage": torch.bfloat16,
    "torch.BoolStorage": torch.bool,
    "torch.ByteStorage": torch.uint8,
    "torch.CharStorage": torch.int8,
    "torch.DoubleStorage": torch.float64,
    "torch.FloatStorage": torch.float32,
    "torch.HalfStorage": torch.float16,
    "torch.IntStorage": torch.int32,
    "torch.LongStorage": torch.int64,
    "torch.ShortStorage": torch.int16,
}


@dataclass(eq=False)  # no tuple, whose hash would follow what it is nested in
class _Storage:
    """A persistent id of the pickle, ``("storage", type, key, location, number, view)``."""

    kind: Any
    dtype: Any
    key: Any
    location: Any
    number: Any
    view: Any


@dataclass(eq=False)
class _Tensor:
    """What ``torch._utils._rebuild_tensor_v2`` is called with."""

    storage: Any
    offset: Any
    size: Any
    stride: Any
    requires_grad: Any
    hooks: Any


class _Dict(dict[Any, Any]):
    """An ``OrderedDict``; what else it has, its ``_metadata``, is left out."""

    def __setstate__(self, state: Any) -> None:
        pass


class _Unpickler(pickle.Unpickler):
    def find_class(self, module: str, name: str) -> Any:
        full = f"{module}.{name}"
        known = {"collections.OrderedDict": _Dict, "torch._utils._rebuild_tensor_v2": _Tensor, **_STORAGES}
        if full not in known:
            raise InertPickleError(f"it names {full}, which is no tensor; nothing in it was run")
        return known[full]

    def persistent_load(self, pid: Any) -> _Storage:
        return _Storage(*pid)


def read_legacy(data: bytes) -> Any:
    """What ``torch.save`` wrote: pickles, of which the fourth is read without running it, and the memory of tensors.

    A damaged file raises anything, one that names what is no tensor an :class:`InertPickleError`.
    """
    file = io.BytesIO(data)
    _, _, _, found, keys = (_read_pickle(file, data) for _ in range(5))  # magic number, version, machine
    if not isinstance(found, dict) or not isinstance(keys, list):
        raise InertPickleError("it is no dictionary of tensors")
    used = {value.storage.key: value.storage for value in found.values() if isinstance(value, _Tensor)}
    memory = {}
    for key in keys:
        dtype = used[key].dtype if key in used else None
        if not isinstance(dtype, torch.dtype):
            raise InertPickleError(f"it has a storage {short(key)} that no tensor uses")
        memory[key] = _read_storage(file, dtype)
    return {name: _tensor(value, memory) if isinstance(value, _Tensor) else value for name, value in found.items()}


def _read_pickle(file: io.BytesIO, data: bytes) -> Any:
    start = file.tell()
    check_program(file)
    return _Unpickler(io.BytesIO(data[start : file.tell()])).load()


def _read_storage(file: io.BytesIO, dtype: torch.dtype) -> Tensor:
    """As many numbers as it says it has, which must be there."""
    number = int.from_bytes(file.read(8), "little", signed=True)
    content = file.read(number * dtype.itemsize) if number >= 0 else b""
    if number < 0 or len(content) != number * dtype.itemsize:
        raise InertPickleError("it is shorter than its tensors")
    return torch.frombuffer(bytearray(content), dtype=dtype) if content else torch.empty(0, dtype=dtype)


def _tensor(value: _Tensor, memory: dict[Any, Tensor]) -> Tensor:
    """A view of its storage; PyTorch refuses one that leaves it."""
    return memory[value.storage.key].as_strided(value.size, value.stride, value.offset)
