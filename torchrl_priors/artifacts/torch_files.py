"""Tensors that ``torch.save`` wrote, as zip or, before PyTorch 1.6, as pickles: read without PyTorch running them."""

from __future__ import annotations

import io
import pickle
import zipfile
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from torchrl_priors.artifacts.errors import InertPickleError, short
from torchrl_priors.artifacts.pickle_program import check_program

_OLD_START = pickle.dumps(0x1950A86A20F9469CFC6C, protocol=2)
"""How a file before PyTorch 1.6 begins: with the pickle of this number."""
_MAX_ENTRIES = 10_000  # of a zip: each takes memory before it is read; a tensor has one

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


class _Inert:
    """Something that a pickle may make, and may not give a state: that could be one of its class."""

    def __setstate__(self, state: Any) -> None:
        raise InertPickleError("it gives a tensor other attributes")


@dataclass(eq=False)  # no tuple, whose hash would follow what it is nested in
class _Storage(_Inert):
    """A persistent id of the pickle, ``("storage", type, key, location, number)``, before 1.6 with a view."""

    kind: Any
    dtype: Any
    key: Any
    location: Any
    number: Any
    view: Any = None


@dataclass(eq=False)
class _Tensor(_Inert):
    """What ``torch._utils._rebuild_tensor_v2`` is called with."""

    storage: Any
    offset: Any
    size: Any
    stride: Any
    requires_grad: Any
    hooks: Any

    def view(self, memory: dict[Any, Tensor]) -> Tensor:
        """Of its storage; PyTorch refuses one that leaves it."""
        return memory[self.storage.key].as_strided(self.size, self.stride, self.offset)


class _Parameter(_Inert):
    """``torch._utils._rebuild_parameter``: the tensor is all that counts."""

    def __new__(cls, data: Any, requires_grad: Any, hooks: Any) -> Any:
        """The tensor."""
        return data


class _Dict(dict[Any, Any]):
    """An ``OrderedDict``; what else it has, its ``_metadata``, is left out."""

    def __setstate__(self, state: Any) -> None:
        pass


_KNOWN = {
    "collections.OrderedDict": _Dict,
    "torch._utils._rebuild_tensor_v2": _Tensor,
    "torch._utils._rebuild_parameter": _Parameter,
    **_STORAGES,
}


class _Unpickler(pickle.Unpickler):
    def find_class(self, module: str, name: str) -> Any:
        full = f"{module}.{name}"
        if full not in _KNOWN:
            raise InertPickleError(f"it names {full}, which is no tensor; nothing in it was run")
        return _KNOWN[full]

    def persistent_load(self, pid: Any) -> _Storage:
        return _Storage(*pid)


def read_torch(data: bytes) -> Any:
    """A dictionary of tensors that ``torch.save`` wrote, on the CPU, wherever they were.

    A damaged file raises anything, one that names what is no tensor an :class:`InertPickleError`.
    """
    return _read_old(data) if data.startswith(_OLD_START) else _read_zip(data)


def _read_zip(data: bytes) -> Any:
    """One folder with ``data.pkl``, and the memory of each tensor in ``data``; nothing is compressed."""
    if data.count(b"PK\x01\x02") > _MAX_ENTRIES:
        raise InertPickleError(f"it has more than {_MAX_ENTRIES} entries")
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        entries = archive.infolist()
        if any(entry.compress_type != zipfile.ZIP_STORED for entry in entries):
            raise InertPickleError("its entries are compressed, which torch.save does not do")
        if sum(entry.file_size for entry in entries) > len(data):  # several with the same bytes
            raise InertPickleError("its entries are larger than it is")
        names = [entry.filename for entry in entries]
        folder = next((name.removesuffix("data.pkl") for name in names if name.endswith("/data.pkl")), None)
        if folder is None or len(set(names)) < len(names):
            raise InertPickleError("it is no zip of torch.save")
        if f"{folder}byteorder" in names and archive.read(f"{folder}byteorder") != b"little":
            raise InertPickleError("its numbers are big-endian")
        program = archive.read(f"{folder}data.pkl")
        check_program(program)
        found = _Unpickler(io.BytesIO(program)).load()

        def memory(storage: _Storage) -> Tensor:
            return _from_bytes(archive.read(f"{folder}data/{storage.key}"), storage.dtype)

        return _views(found, memory)


def _read_old(data: bytes) -> Any:
    """Pickles, of which the fourth has the tensors and the fifth the order of their memory, which follows."""
    file = io.BytesIO(data)
    _, _, _, found, keys = (_read_pickle(file, data) for _ in range(5))  # magic number, version, machine
    if not isinstance(keys, list):
        raise InertPickleError("it is no dictionary of tensors")
    used = {storage.key: storage for storage in _storages(found)}
    memory = {}
    for key in keys:
        if key not in used:
            raise InertPickleError(f"it has a storage {short(key)} that no tensor uses")
        size = int.from_bytes(file.read(8), "little", signed=True) * used[key].dtype.itemsize
        content = file.read(size) if size >= 0 else b""
        if len(content) != size:
            raise InertPickleError("it is shorter than its tensors")
        memory[key] = _from_bytes(content, used[key].dtype)
    return _views(found, lambda storage: memory[storage.key])


def _read_pickle(file: io.BytesIO, data: bytes) -> Any:
    start = file.tell()
    check_program(file)
    return _Unpickler(io.BytesIO(data[start : file.tell()])).load()


def _storages(found: Any) -> list[_Storage]:
    if not isinstance(found, dict):
        raise InertPickleError("it is no dictionary of tensors")
    storages = [value.storage for value in found.values() if isinstance(value, _Tensor)]
    if not all(isinstance(one, _Storage) and isinstance(one.dtype, torch.dtype) for one in storages):
        raise InertPickleError("it has a tensor without numbers")
    return storages


def _from_bytes(content: bytes, dtype: torch.dtype) -> Tensor:
    return torch.frombuffer(bytearray(content), dtype=dtype) if content else torch.empty(0, dtype=dtype)


def _views(found: Any, memory: Callable[[_Storage], Tensor]) -> dict[Any, Any]:
    """The dictionary with tensors in the place of what they are made of; those of one storage share it."""
    shared: dict[Any, Tensor] = {}
    for storage in _storages(found):
        if storage.key not in shared:
            shared[storage.key] = memory(storage)
    return {name: value.view(shared) if isinstance(value, _Tensor) else value for name, value in found.items()}
