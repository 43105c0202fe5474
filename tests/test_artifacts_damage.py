"""Damaged and foreign files are refused, and nothing of them is run."""

from __future__ import annotations

import json
import math
import pickle
import struct
from pathlib import Path
from typing import Any

import pytest
import safetensors.torch
import torch
from artifacts_cases import ACTIONS, OBS, SCALE, Saved, contents, refused, save
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from torchrl_priors.artifacts import ArtifactError, load_policy, load_prior, read_manifest, save_policy
from torchrl_priors.artifacts.format import _NO_DIGEST, _seal, pack
from torchrl_priors.collectors.running_norm import RunningNorm
from torchrl_priors.networks import make_actor


@pytest.fixture
def saved(tmp_path: Path) -> Saved:
    return save(tmp_path / "teacher.safetensors")


class TestDamage:
    """Small files, so that every byte can be damaged."""

    @staticmethod
    def tiny(path: Path) -> bytes:
        save_policy(path, make_actor(2, 1, hidden=(2,)), RunningNorm(2), env_id="Hopper-v5", evaluation={"mean": 1.0})
        return path.read_bytes()

    def test_every_flipped_byte_is_refused(self, tmp_path: Path) -> None:
        data = self.tiny(tmp_path / "policy")
        assert len(data) < 2000
        for position in range(len(data)):
            for mask in (0x01, 0x20):  # another number or letter, and the other case
                damaged = bytearray(data)
                damaged[position] ^= mask
                (tmp_path / "damaged").write_bytes(damaged)
                with pytest.raises(ArtifactError):
                    read_manifest(tmp_path / "damaged")

    def test_every_truncation_is_refused(self, tmp_path: Path) -> None:
        data = self.tiny(tmp_path / "policy")
        for length in range(len(data)):
            (tmp_path / "damaged").write_bytes(data[:length])
            with pytest.raises(ArtifactError):
                read_manifest(tmp_path / "damaged")

    @settings(suppress_health_check=[HealthCheck.function_scoped_fixture], max_examples=300)
    @given(st.data())
    def test_every_other_damage_is_refused(self, tmp_path: Path, data: st.DataObject) -> None:
        original = self.tiny(tmp_path / "policy")
        damaged = original
        for _ in range(data.draw(st.integers(1, 3))):
            start = data.draw(st.integers(0, len(damaged)))
            stop = data.draw(st.integers(start, min(start + 40, len(damaged))))
            middle = data.draw(st.binary(max_size=40) | st.just(damaged[start:stop] * 2))
            damaged = damaged[:start] + middle + damaged[stop:]
        (tmp_path / "damaged").write_bytes(damaged)
        if damaged == original:
            read_manifest(tmp_path / "damaged")
        else:
            with pytest.raises(ArtifactError):
                read_manifest(tmp_path / "damaged")

    @settings(suppress_health_check=[HealthCheck.function_scoped_fixture])
    @given(st.binary(max_size=200), st.booleans())
    def test_arbitrary_bytes_are_refused(self, tmp_path: Path, data: bytes, framed: bool) -> None:
        (tmp_path / "policy").write_bytes(struct.pack("<Q", len(data)) + data if framed else data)
        with pytest.raises(ArtifactError):
            read_manifest(tmp_path / "policy")

    def test_a_damaged_weight_is_named_as_damage(self, saved: Saved) -> None:
        data = bytearray(saved.path.read_bytes())
        data[-3] ^= 1  # still a finite number
        saved.path.write_bytes(data)
        refused(saved.path, "damaged: its content does not match its digest")


class TestForeignFiles:
    def test_a_missing_file(self, tmp_path: Path) -> None:
        for path in (tmp_path / "no", tmp_path):
            for reader in (load_policy, load_prior, read_manifest):
                with pytest.raises(FileNotFoundError, match="No policy file at"):
                    reader(path)

    @pytest.mark.parametrize("data", [b"", b"policy", b"\x80\x04", b"PK\x03\x04" + b"\0" * 100, b"{}" * 50])
    def test_no_safetensors(self, tmp_path: Path, data: bytes) -> None:
        (tmp_path / "policy").write_bytes(data)
        refused(tmp_path / "policy", "not a safetensors file")

    @pytest.mark.parametrize(
        ("metadata", "match"), [(None, "with metadata"), ({"format": "pt"}, "not one of torchrl_priors.save_policy")]
    )
    def test_safetensors_of_another_program(self, tmp_path: Path, metadata: Any, match: str) -> None:
        safetensors.torch.save_file({"weight": torch.zeros(3)}, tmp_path / "policy", metadata=metadata)
        refused(tmp_path / "policy", match)

    def test_a_large_foreign_model_is_not_read(self, tmp_path: Path) -> None:
        header = json.dumps({"weight": {"dtype": "F32", "shape": [2**40], "data_offsets": [0, 2**42]}}).encode()
        with (tmp_path / "model").open("wb") as file:
            file.write(struct.pack("<Q", len(header)) + header)
            file.truncate(2**36)  # sparse: reading it would need 64 GiB
        refused(tmp_path / "model", "with metadata")

    @pytest.mark.parametrize("about", ["1", "[]", "null", '"text"', "{", "[" * 100_000, '{"version": NaN}'])
    def test_a_manifest_of_another_kind(self, tmp_path: Path, about: str) -> None:
        safetensors.torch.save_file({"w": torch.zeros(1)}, tmp_path / "policy", {"torchrl_priors.policy": about})
        refused(tmp_path / "policy", "manifest is not")

    @pytest.mark.parametrize("version", [2, 0, "1", None, True, 1.0])
    def test_an_unknown_version(self, saved: Saved, version: Any) -> None:
        saved.path.write_bytes(pack(*contents(saved.path), version=version))
        refused(saved.path, "version")

    @pytest.mark.parametrize(
        ("entry", "value", "match"),
        [
            ("architecture", "transformer", "architecture is unknown: 'transformer'"),
            ("architecture", None, "architecture is unknown"),
            ("activation", "sin", "activation is unknown: 'sin'"),
            ("activation", ["tanh"], "activation is unknown"),
            ("env_id", "", "name its environment"),
            ("env_id", 1, "name its environment"),
            ("obs_dim", 0, "obs_dim must be a positive integer"),
            ("obs_dim", 4.0, "obs_dim must be a positive integer"),
            ("act_dim", True, "act_dim must be a positive integer"),
            ("hidden", 8, "positive sizes"),
            ("hidden", [8, -8], "positive sizes"),
            ("hidden", [8, "8"], "positive sizes"),
            ("normalizer", True, "positive eps and clip"),
            ("normalizer", {}, "positive eps and clip"),
            ("normalizer", {"eps": 1e-8, "clip": -1}, "positive eps and clip"),
            ("normalizer", {"eps": "0", "clip": 10}, "positive eps and clip"),
            ("seed", "0", "seed must be an integer"),
            ("evaluation", [], "evaluation must be an object"),
            ("training", None, "training must be an object"),
            # well formed, but not what the tensors are
            ("obs_dim", 5, "must be torch.float32 of shape"),
            ("act_dim", 2**60, "must be torch.float32 of shape"),
            ("hidden", [8], "missing or unexpected: actor"),
            ("hidden", [2**60, 2**60], "must be torch.float32 of shape"),
            ("normalizer", None, "missing or unexpected: normalizer"),
        ],
    )
    def test_an_impossible_manifest(self, saved: Saved, entry: str, value: Any, match: str) -> None:
        tensors, manifest = contents(saved.path)
        saved.path.write_bytes(pack(tensors, {**manifest, entry: value}))
        refused(saved.path, match)

    def test_a_manifest_with_other_entries(self, saved: Saved) -> None:
        tensors, manifest = contents(saved.path)
        for other in ({**manifest, "code": "print()"}, {k: v for k, v in manifest.items() if k != "hidden"}, None):
            saved.path.write_bytes(pack(tensors, other))  # type: ignore[arg-type]
            refused(saved.path, "must have the entries")

    @pytest.mark.parametrize(
        ("changes", "match"),
        [
            ({SCALE: None}, f"missing or unexpected: {SCALE}"),
            ({"actor.mean.9.weight": torch.zeros(2)}, "missing or unexpected: actor.mean.9.weight"),
            ({SCALE: torch.zeros(ACTIONS + 1)}, r"must be torch.float32 of shape \(3,\)"),
            ({SCALE: torch.zeros(ACTIONS, dtype=torch.float64)}, "got torch.float64"),
            ({SCALE: torch.zeros(ACTIONS, dtype=torch.bfloat16)}, "got torch.bfloat16"),
            ({SCALE: torch.zeros(0)}, "shape"),
            ({SCALE: torch.full((ACTIONS,), math.nan)}, "not finite"),
            ({"actor.mean.0.bias": torch.full((8,), -math.inf)}, "not finite"),
            ({"normalizer.mean": torch.full((OBS,), math.nan).double()}, "not finite"),
            ({"normalizer.mean": torch.zeros(OBS)}, "must be torch.float64"),
            ({"normalizer.var": -torch.ones(OBS).double()}, "negative variance"),
            ({"normalizer.count": torch.tensor(-1.0).double()}, "negative variance or count"),
        ],
    )
    def test_impossible_tensors(self, saved: Saved, changes: dict[str, Any], match: str) -> None:
        tensors, manifest = contents(saved.path)
        tensors = {name: value for name, value in (tensors | changes).items() if value is not None}
        saved.path.write_bytes(pack(tensors, manifest))
        refused(saved.path, match)

    @pytest.mark.parametrize("dtype", ["F4", "F8_E8M0", "C64", "BOOL", "U16", "object", ""])
    @pytest.mark.parametrize("shape", [[ACTIONS], [-ACTIONS], [0], [2**62, 2], ["3"]])
    @pytest.mark.parametrize("offsets", [(0, 12), (12, 0), (0, 2**62), (4, 16), (-12, 0)])
    def test_an_impossible_header(self, saved: Saved, dtype: str, shape: list[Any], offsets: tuple[int, int]) -> None:
        data = saved.path.read_bytes()
        size = int.from_bytes(data[:8], "little")
        header = json.loads(data[8 : 8 + size])
        about = json.loads(header["__metadata__"]["torchrl_priors.policy"])
        header["__metadata__"]["torchrl_priors.policy"] = json.dumps({**about, "sha256": _NO_DIGEST})
        header[SCALE] = {"dtype": dtype, "shape": shape, "data_offsets": offsets}
        forged = json.dumps(header).encode()
        saved.path.write_bytes(_seal(struct.pack("<Q", len(forged)) + forged + data[8 + size :]))
        refused(saved.path, "its tensors can't be read|actor")


class TestNothingIsUnpickled:
    class Bomb:
        def __reduce__(self) -> Any:
            return Path.touch, (Path("unpickled"),)

    def test_pickled_files_are_refused_unread(self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.chdir(tmp_path)
        (tmp_path / "plain.pkl").write_bytes(pickle.dumps(self.Bomb()))
        torch.save(self.Bomb(), tmp_path / "torch.pt")
        for name in ("plain.pkl", "torch.pt"):
            refused(tmp_path / name, "not a safetensors file")
        assert not (tmp_path / "unpickled").exists()

    def test_reading_uses_no_pickle(self, saved: Saved, monkeypatch: pytest.MonkeyPatch) -> None:
        def fail(*args: Any, **kwargs: Any) -> None:
            raise AssertionError("pickle was used")

        for module, name in ((pickle, "load"), (pickle, "loads"), (pickle, "Unpickler"), (torch, "load")):
            monkeypatch.setattr(module, name, fail)
        load_policy(saved.path)
        load_prior(saved.path)
