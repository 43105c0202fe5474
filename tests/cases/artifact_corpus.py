"""Damaged and foreign files, from a seed: what a loader of priors must refuse."""

from __future__ import annotations

import gzip
import io
import itertools
import json
import math
import os
import pickle
import random
import struct
import sys
import tarfile
import zipfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import safetensors.torch
import torch

from torchrl_priors.artifacts.format import _NO_DIGEST, KIND, _seal, pack


class Bomb:
    """Leaves a file in the working directory when it is unpickled."""

    def __reduce__(self) -> Any:
        return Path.touch, (Path("unpickled"),)


def damaged(data: bytes, draw: random.Random) -> Iterator[tuple[str, bytes]]:
    """A good file, with some of its bytes changed, gone or in another place."""
    for _ in range(300):
        one = bytearray(data)
        one[draw.randrange(len(data))] ^= 1 << draw.randrange(8)
        yield "flip", bytes(one)
    for _ in range(100):
        several = bytearray(data)
        for _ in range(draw.randint(2, 50)):
            several[draw.randrange(len(data))] = draw.randrange(256)
        yield "noise", bytes(several)
    for _ in range(150):
        yield "truncated", data[: draw.randrange(len(data))]
    for _ in range(50):
        yield "longer", data + draw.randbytes(draw.randint(1, 100))
        yield "shifted", draw.randbytes(draw.randint(1, 100)) + data
    for _ in range(100):
        start, length = draw.randrange(len(data) - 1), draw.randint(2, 64)
        part = data[start : start + length]
        yield "zeroed", data[:start] + b"\0" * len(part) + data[start + length :]
        yield "reversed", data[:start] + part[::-1] + data[start + length :]
        yield "cut out", data[:start] + data[start + length :]
        yield "doubled", data[: start + length] + data[start:]
    for size in [
        0,
        1,
        2,
        7,
        100,
        2**20,
        2**31,
        2**32,
        2**53,
        2**63,
        2**64 - 1,
        *(draw.randrange(2**64) for _ in range(30)),
    ]:
        yield "header size", struct.pack("<Q", size) + data[8:]


def header_of(data: bytes) -> tuple[dict[str, Any], bytes]:
    size = int.from_bytes(data[:8], "little")
    return json.loads(data[8 : 8 + size]), data[8 + size :]


def sealed(text: str, tensors: bytes) -> bytes:
    """A file with this header, and the digest that it should have."""
    raw = text.encode()
    return _seal(struct.pack("<Q", len(raw)) + raw + tensors)


def forged_headers(data: bytes, draw: random.Random) -> Iterator[tuple[str, bytes]]:
    """Headers that lie about the tensors below them, with a digest that is right."""
    header, tensors = header_of(data)
    about = json.loads(header["__metadata__"][KIND])
    header["__metadata__"][KIND] = json.dumps({**about, "sha256": _NO_DIGEST})
    names = [name for name in header if name != "__metadata__"]
    huge = [-1, 2**31, 2**40, 2**62, 2**64, 10**30, 0.5, None, "3", []]
    for _ in range(120):
        lying = json.loads(json.dumps(header))
        entry = lying[draw.choice(names)]
        where = draw.choice(["dtype", "shape", "data_offsets", "swap", "drop"])
        if where == "dtype":
            entry["dtype"] = draw.choice(["F16", "BF16", "I32", "U8", "F4", "C64", "object", "", None, 3, [], {}])
        elif where == "shape":
            entry["shape"] = [draw.choice(huge) for _ in range(draw.randint(1, 3))]
        elif where == "data_offsets":
            entry["data_offsets"] = [draw.choice(huge), draw.choice(huge)]
        elif where == "swap":
            first, second = draw.sample(names, 2)
            lying[first], lying[second] = lying[second], lying[first]
            if lying[first]["shape"] == lying[second]["shape"]:
                continue  # a permutation of equal tensors is another good prior
        else:
            del entry[draw.choice(list(entry))]
        yield "header", sealed(json.dumps(lying), tensors)
    for name in names:  # the same name twice
        text = json.dumps(header)
        yield "duplicate", sealed(text[:-1] + f", {json.dumps(name)}: {json.dumps(header[names[0]])}}}", tensors)


def entries(values: Any) -> Iterator[tuple[str, dict[str, Any]]]:
    """The entries of a manifest and of all objects in it, each with the object that has it."""
    if isinstance(values, dict):
        for name in list(values):
            yield name, values
            yield from entries(values[name])
    elif isinstance(values, list):
        for value in values:
            yield from entries(value)


def forged_manifests(data: bytes, manifest: dict[str, Any]) -> Iterator[tuple[str, bytes]]:
    """Manifests of other kinds and versions, with a digest that is right."""
    tensors = safetensors.torch.load(data)
    junk: list[Any] = [
        None,
        True,
        -1,
        1.5,
        1e308,
        10**400,
        "",
        "\x1b[2J",
        "\ud800",
        [],
        [None],
        [[[]]],
        {"__class__": "os.system"},
    ]
    fine = {  # what an entry may be, and the junk that it can be too
        "seed": (None, 10**400),
        "frames": (None, 10**400),
        "evaluation": ({"__class__": "os.system"},),
        "training": ({"__class__": "os.system"},),
        "eps": (1.5, 1e308),
        "clip": (1.5, 1e308),
        "temperature": (1.5,),
    }
    for entry, values in entries(manifest):
        honest = values.pop(entry)
        yield f"without {entry}", pack(tensors, manifest)
        for value in junk:
            if not any(type(value) is type(good) and value == good for good in (honest, *fine.get(entry, ()))):
                values[entry] = value
                yield f"manifest {entry}", pack(tensors, manifest)
        values[entry] = honest
    for hidden in ([1] * 1000, [2**62], [0], [-1], ["8"], [8.0], [True]):
        for _, values in entries(manifest):
            if "hidden" in values:
                honest, values["hidden"] = values["hidden"], hidden
                yield "hidden", pack(tensors, manifest)
                values["hidden"] = honest
    for version in (0, 1, 3, -1, 10**400, 1.0, True, "1", None, [], {}):
        yield "version", pack(tensors, manifest, version=version)
    for about in ("", "1", "[]", "null", "{}", "{", '"x"', "[" * 100_000, '{"a":' * 50_000, '{"version": NaN}', "\0"):
        yield "about", safetensors.torch.save(tensors, {KIND: about})


def forged_tensors(data: bytes, manifest: dict[str, Any]) -> Iterator[tuple[str, bytes]]:
    """Tensors that are not those of the manifest, with a digest that is right."""
    tensors = safetensors.torch.load(data)
    for name, value in tensors.items():
        changed = {
            "nan": torch.full_like(value, math.nan),
            "inf": torch.full_like(value, math.inf),
            "-inf": torch.full_like(value, -math.inf),
            "half": value.half(),
            "bfloat16": value.bfloat16(),
            "int": value.long(),
            "bool": value.bool(),
            "precision": value.float() if value.dtype is torch.float64 else value.double(),
            "a dimension more": value.unsqueeze(0),
            "empty": value.new_zeros(0),
            "longer": torch.cat([value.flatten(), value.flatten()]),
        }
        for kind, other in changed.items():
            yield f"{name} {kind}", pack({**tensors, name: other}, manifest)
        rest = {key: other for key, other in tensors.items() if key != name}
        yield f"{name} missing", pack(rest, manifest)
        yield f"{name} renamed", pack({**rest, f"{name}\x1b[2J": value}, manifest)
    scale = "prior.network.1.scale.state_independent_scale"
    for value in (-1e4, 1e4):  # finite, but not a standard deviation
        yield "scale", pack({**tensors, scale: torch.full_like(tensors[scale], value)}, manifest)
    yield "no tensor", pack({}, manifest)
    yield "10000 tensors", pack({f"w{i}": torch.zeros(1) for i in range(10_000)}, manifest)


def foreign(folder: Path) -> Iterator[tuple[str, bytes]]:
    """Files of other programs, some of which would run code in another loader."""
    for protocol in range(pickle.HIGHEST_PROTOCOL + 1):
        yield "pickle", pickle.dumps(Bomb(), protocol=protocol)
        yield "pickle", pickle.dumps({"weight": [1.0]}, protocol=protocol)
    for zipped in (True, False):
        for thing in (Bomb(), torch.nn.Linear(2, 2), torch.nn.Linear(2, 2).state_dict()):
            buffer = io.BytesIO()
            torch.save(thing, buffer, _use_new_zipfile_serialization=zipped)
            yield "torch.save", buffer.getvalue()
    for names in (["policy.pth", "data"], ["data.pkl"], ["../../escape"], []):  # the second: as a checkpoint has it
        buffer = io.BytesIO()
        with zipfile.ZipFile(buffer, "w") as archive:
            for name in names:
                archive.writestr(name, pickle.dumps(Bomb()))
        yield "zip", buffer.getvalue()
    buffer = io.BytesIO()
    np.savez(buffer, weight=np.zeros(3))
    yield "npz", buffer.getvalue()
    buffer = io.BytesIO()
    np.save(buffer, np.array([Bomb()], dtype=object), allow_pickle=True)
    yield "npy of objects", buffer.getvalue()
    buffer = io.BytesIO()
    with tarfile.open(fileobj=buffer, mode="w") as archive:
        archive.addfile(tarfile.TarInfo("policy"))
    yield "tar", buffer.getvalue()
    yield "gzip", gzip.compress(b"policy")
    magic = [
        b"\x7fELF",
        b"\x89PNG\r\n\x1a\n",
        b"\x89HDF\r\n\x1a\n",
        b"GGUF",
        b"%PDF-1.7",
        b"\x93NUMPY",
        b"\xff\xd8\xff",
        b"RIFF",
    ]
    for start in magic:
        yield "magic", start + b"\0" * 200
        yield "magic alone", start
    lfs = "version https://git-lfs.github.com/spec/v1\noid sha256:0\nsize 1\n"
    texts = ["", " ", "\n", "{}", "[]", "null", "import os", "#!/bin/sh\nexit 1", "<html></html>", lfs]
    for text in (*texts, "a: !!python/object/apply:os.system [x]"):
        for encoding in ("utf-8", "utf-16", "utf-32"):
            yield "text", text.encode(encoding)
    for metadata in (
        None,
        {"format": "pt"},
        {"format": "np", "sha256": "0" * 64},
        {KIND + ".v2": "{}"},
        {"torchrl_priors.policy": "{}"},
    ):
        for dtype in (torch.float32, torch.bfloat16, torch.int64, torch.bool):
            yield "safetensors", safetensors.torch.save({"model.weight": torch.zeros(2, 2, dtype=dtype)}, metadata)
    for header in (
        "{}",
        "[]",
        "1",
        '{"__metadata__": []}',
        '{"__metadata__": {"torchrl_priors.prior": 1}}',
        "{" * 10_000,
        "[" * 100_000,
    ):
        yield "framed", struct.pack("<Q", len(header)) + header.encode()
    yield "python", Path(sys.executable).resolve().read_bytes()[:10_000]


def not_files(folder: Path) -> Iterator[Path]:
    """Paths that lead to no file."""
    (folder / "directory").mkdir()
    (folder / "directory.safetensors").mkdir()
    (folder / "to a directory").symlink_to(folder / "directory")
    (folder / "to nothing").symlink_to(folder / "nothing")
    (folder / "to itself").symlink_to(folder / "to itself")
    (folder / "to a device").symlink_to("/dev/zero")
    os.mkfifo(folder / "pipe")  # reading it would wait for ever
    yield from sorted(folder.iterdir())
    yield folder / "nothing"


def write_corpus(folder: Path, policy: bytes, mixture: bytes, manifests: list[dict[str, Any]], seed: int) -> None:
    """Numbered files, of a policy and a mixture, that must all be refused; none is a good file by chance."""
    draw = random.Random(seed)
    kinds = [
        damaged(policy, draw),
        itertools.islice(damaged(mixture, draw), 0, None, 4),  # enough: what differs is below the digest
        forged_headers(policy, draw),
        *map(forged_manifests, (policy, mixture), manifests),
        forged_tensors(policy, manifests[0]),
        foreign(folder),
    ]
    number = 0
    for kind in kinds:
        for label, data in kind:
            if data not in (policy, mixture):
                (folder / f"{number:04d} {label}").write_bytes(data)
                number += 1
    with (folder / f"{number:04d} sparse").open("wb") as file:  # a good file that claims to need 64 GiB
        file.write(policy)
        file.truncate(2**36)
