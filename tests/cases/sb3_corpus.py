"""Damaged and forged files of Stable-Baselines3, from a seed: what their reader must refuse."""

from __future__ import annotations

import base64
import io
import json
import math
import pickle
import pickletools
import random
import zipfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import torch
from artifact_corpus import Bomb, foreign

START = b"\x80\x04"
DEEP = START + b"})" + b"\x85" * 200_000 + b"K\x01s."
TWICE = START + b"})" + b"".join(b"\x94h" + bytes([number]) + b"\x86" for number in range(60)) + b"K\x01s."
MANY = START + b"](" + b"}" * 200_000 + b"e."


class Stands:
    """Is pickled as an object of another class, with this state."""

    def __init__(self, kind: str, state: Any) -> None:
        self.kind, self.state = kind, state

    def dump(self) -> bytes:
        module, _, name = self.kind.rpartition(".")
        head = START + f"c{module}\n{name}\n)\x81".encode("latin1")
        return head + pickle.dumps(self.state, protocol=3)[2:-1] + b"b."


def spaces() -> Iterator[tuple[str, bytes]]:
    """Pickles of spaces."""
    yield "deep", DEEP
    yield "twice", TWICE
    yield "bomb", pickle.dumps(Bomb())
    for n, start in ((1 << 100_000, 0), (2, -(1 << 100_000)), (0, 0), (-1, 0), ("2", 0), (None, 0), (True, 0), (2, 1)):
        yield "discrete", Stands("gymnasium.spaces.discrete.Discrete", {"n": n, "start": start}).dump()
    for kind in ("Tuple", "Dict", "MultiDiscrete", "Text"):
        yield "kind", Stands(f"gymnasium.spaces.space.{kind}", {}).dump()
    for state in ({}, {"low": 1, "high": 2}):
        yield "box", Stands("gymnasium.spaces.box.Box", state).dump()
    for value in (None, 3, [], {}, "x"):
        yield "no space", pickle.dumps(value)


def weights(good: dict[str, torch.Tensor]) -> Iterator[tuple[str, bytes]]:
    """Contents of ``policy.pth``, each with one tensor that is not what it should be."""
    name = "action_net.weight"
    value = good[name]
    changed: dict[str, Any] = {
        "expanded": torch.zeros(1).expand(1 << 16, 1 << 20),
        "meta": torch.empty(value.shape, device="meta"),
        "sparse": value.to_sparse(),
        "sparse and huge": torch.sparse_coo_tensor(size=(1 << 20, 1 << 20), check_invariants=True),
        "nan": torch.full_like(value, math.nan),
        "inf": torch.full_like(value, math.inf),
        "double": value.double(),
        "complex": value.to(torch.complex64),
        "narrower": value[:, 1:].contiguous(),
        "empty": value[:0],
        "a scalar": torch.tensor(1.0),
        "no tensor": [1.0],
        "bomb": Bomb(),
    }
    for label, other in changed.items():
        yield label, saved({**good, name: other})
    yield "missing", saved({key: other for key, other in good.items() if key != name})
    yield "more", saved({**good, "\x1b[2J": torch.zeros(1)})
    yield "number", saved({**good, 3: torch.zeros(1)})
    yield "list", saved(list(good.values()))
    yield "pickle", pickle.dumps(Bomb())
    data = saved(good)
    for label, program in (("deep", DEEP), ("twice", TWICE), ("many", MANY)):
        yield label, rezipped(data, lambda member, content, p=program: p if member.endswith("data.pkl") else content)
    deep = rezipped(data, lambda member, content: DEEP if member.endswith("data.pkl") else content)
    yield "upper case", deep.replace(b"data.pkl", b"data.PKL")
    claims = START + b"}X\x01\x00\x00\x00ac__builtin__\nbytearray\n" + pickle.dumps(1 << 40)[2:-1] + b"\x85Rs."
    yield "bytearray", rezipped(data, lambda member, content: claims if member.endswith("data.pkl") else content)
    shared, other = torch.zeros(256, 256), torch.zeros(1)
    yield "shared", saved({**good, **{f"mlp_extractor.policy_net.{2 * i}.weight": shared for i in range(1, 40)}})
    other.numel = 5
    yield "attributes", saved({**good, name: other})
    yield from legacy(good)
    packed = saved({**good, "value_net.bias": torch.zeros(1 << 21)})
    yield "packed", rezipped(packed, lambda member, content: content, zipfile.ZIP_DEFLATED)
    # a number of entries that the record lacks
    yield "claims more", rezipped(data, lambda member, content: content[:-4] if "/data/" in member else content)


def legacy(good: dict[str, torch.Tensor]) -> Iterator[tuple[str, bytes]]:
    """The same in the format before PyTorch 1.6, whose pickles say how large memory is."""

    def old(value: Any) -> bytes:
        buffer = io.BytesIO()
        torch.save(value, buffer, _use_new_zipfile_serialization=False)
        return buffer.getvalue()

    data = old(good)
    file = io.BytesIO(data)
    # of the pickles of a number, a version, the machine, the object, and the names of its memory
    ends = [len(list(pickletools.genops(file))) and file.tell() for _ in range(5)]
    start = data[: ends[2]]
    yield "legacy bomb", old({**good, "x": Bomb()})
    yield "legacy expanded", old({**good, "action_net.weight": torch.zeros(1).expand(1 << 16, 1 << 20)})
    yield "legacy list", old(list(good.values()))
    yield "legacy then zip", start + saved(good)
    for length in range(0, len(data), max(1, len(data) // 40)):
        yield "legacy truncated", data[:length]
    nested = b"ctorch._utils\n_rebuild_tensor_v2\n("
    nested = START + b"}" + 10_000 * nested + b"K\x01" + 10_000 * b"K\x01K\x01K\x01K\x01K\x01tR" + b"K\x01s."
    for program in (DEEP, TWICE, MANY, nested, pickle.dumps(Bomb()), pickle.dumps({"a": 1}), pickle.dumps(3)):
        yield "legacy program", start + program + pickle.dumps([])
    for number in (-1, 1 << 40, 1 << 62):  # that the first memory claims to have
        yield "legacy claims more", data[: ends[4]] + number.to_bytes(8, "little", signed=True) + data[ends[4] + 8 :]


def statistics(good: bytes) -> Iterator[tuple[str, bytes]]:
    """Files of ``VecNormalize``."""
    yield from (("deep", DEEP), ("twice", TWICE), ("many", MANY), ("bomb", pickle.dumps(Bomb())), ("empty", b""))
    kind = "stable_baselines3.common.vec_env.vec_normalize.VecNormalize"
    for epsilon, clip in ((10**400, 1.0), (1e-8, 10**400), (-1.0, 1.0), (math.nan, 1.0), ("1", 1.0), (None, 1.0)):
        yield "number", Stands(kind, {"epsilon": epsilon, "clip_obs": clip, "obs_rms": None}).dump()
    for length in range(0, len(good), max(1, len(good) // 60)):
        yield "truncated", good[:length]


def saved(value: Any) -> bytes:
    buffer = io.BytesIO()
    torch.save(value, buffer)
    return buffer.getvalue()


def rezipped(data: bytes, change: Any, compression: int = zipfile.ZIP_STORED) -> bytes:
    """An archive with other content."""
    buffer = io.BytesIO()
    with zipfile.ZipFile(io.BytesIO(data)) as archive, zipfile.ZipFile(buffer, "w", compression) as out:
        for member in archive.namelist():
            out.writestr(member, change(member, archive.read(member)))
    return buffer.getvalue()


def models(good: bytes, draw: random.Random) -> Iterator[tuple[str, bytes]]:
    """Archives of models."""

    def replaced(member: str, content: bytes) -> bytes:
        return rezipped(good, lambda name, old: content if name == member else old, zipfile.ZIP_DEFLATED)

    with zipfile.ZipFile(io.BytesIO(good)) as archive:
        values, state = json.loads(archive.read("data")), archive.read("policy.pth")
    for which in ("observation_space", "action_space"):
        for label, content in spaces():
            entry = {":serialized:": base64.b64encode(content).decode()}
            yield f"{which} {label}", replaced("data", json.dumps({**values, which: entry}).encode())
        for entry in (None, 3, [], {}, {":serialized:": 3}, {":serialized:": "?"}):
            yield which, replaced("data", json.dumps({**values, which: entry}).encode())
    for label, content in weights(torch.load(io.BytesIO(state), weights_only=True)):
        yield f"weights {label}", replaced("policy.pth", content)
    texts = [
        b"",
        b"[]",
        b"3",
        b"{",
        b"[" * 100_000,
        b"[" + b"{}," * 12_000_000 + b"{}]",
        b'{"a": ' + b"9" * 5000 + b"}",
    ]
    for content in texts:
        yield "data", replaced("data", content)
    data = rezipped(good, lambda name, old: b" " * (1 << 28) if name == "data" else old, zipfile.ZIP_BZIP2)
    at = data.rfind(b"PK\x01\x02", 0, data.rfind(b"PK\x01\x02"))  # the directory says that it is short
    yield "bz2", data[: at + 24] + (100).to_bytes(4, "little") + data[at + 28 :]
    for change in ({"use_sde": True}, {"policy_class": None}, {"policy_class": {"__module__": "\x1b[2J" * 1000}}):
        yield "entry", replaced("data", json.dumps({**values, **change}).encode())
    for member in ("data", "policy.pth"):
        yield "without", rezipped(good, lambda name, old, gone=member: old).replace(member.encode(), b"x" * len(member))
    for _ in range(60):
        yield "truncated", good[: draw.randrange(len(good))]


def write_sb3_corpus(folder: Path, good: bytes, vecnormalize: bytes, seed: int) -> None:
    """Numbered files, of a model (``.zip``) and of statistics (``.pkl``), that must all be refused."""
    draw = random.Random(seed)
    files = [(label, data, "zip") for label, data in models(good, draw)]
    files += [(label, data, "zip") for label, data in foreign(folder)]
    files += [(label, data, "pkl") for label, data in statistics(vecnormalize)]
    for number, (label, data, suffix) in enumerate(files):
        (folder / f"{number:04d} {label}.{suffix}").write_bytes(data)
    with (folder / f"{len(files):04d} sparse.pkl").open("wb") as file:  # it claims to have 64 GiB
        file.write(vecnormalize)
        file.truncate(2**36)
