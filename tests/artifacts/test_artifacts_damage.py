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
from artifacts_cases import ACTIONS, NETWORK, OBS, SCALE, STORABLE, Saved, contents, gaussian, refused, save
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from torch import nn

from torchrl_priors import load_prior, policy_prior, save_prior
from torchrl_priors.artifacts import ArtifactError, read_manifest
from torchrl_priors.artifacts.format import _NO_DIGEST, KIND, _seal, pack
from torchrl_priors.collectors import RunningNorm
from torchrl_priors.networks import make_actor
from torchrl_priors.priors.layers import ClipToBox, GaussianHead, StateIndependentStd, TeacherInput


@pytest.fixture
def saved(tmp_path: Path) -> Saved:
    return save(tmp_path / "teacher.safetensors")


class TestDamage:
    """Small files, so that every byte can be damaged."""

    @pytest.fixture(scope="class")
    def tiny(self, tmp_path_factory: pytest.TempPathFactory) -> bytes:
        path = tmp_path_factory.mktemp("tiny") / "policy"
        prior = policy_prior(make_actor(2, 1, hidden=(2,)), RunningNorm(2))
        save_prior(path, prior, env_id="Hopper-v5", evaluation={"mean": 1.0})
        return path.read_bytes()

    def test_every_flipped_byte_is_refused(self, tiny: bytes, tmp_path: Path) -> None:
        assert len(tiny) < 2500
        for position in range(len(tiny)):
            for mask in (0x01, 0x20):  # another number or letter, and the other case
                damaged = bytearray(tiny)
                damaged[position] ^= mask
                (tmp_path / "damaged").write_bytes(damaged)
                with pytest.raises(ArtifactError):
                    read_manifest(tmp_path / "damaged")

    def test_every_truncation_is_refused(self, tiny: bytes, tmp_path: Path) -> None:
        for length in range(len(tiny)):
            (tmp_path / "damaged").write_bytes(tiny[:length])
            with pytest.raises(ArtifactError):
                read_manifest(tmp_path / "damaged")

    @settings(suppress_health_check=[HealthCheck.function_scoped_fixture], max_examples=300)
    @given(st.data())
    def test_every_other_damage_is_refused(self, tiny: bytes, tmp_path: Path, data: st.DataObject) -> None:
        damaged = tiny
        for _ in range(data.draw(st.integers(1, 3))):
            start = data.draw(st.integers(0, len(damaged)))
            stop = data.draw(st.integers(start, min(start + 40, len(damaged))))
            middle = data.draw(st.binary(max_size=40) | st.just(damaged[start:stop] * 2))
            damaged = damaged[:start] + middle + damaged[stop:]
        (tmp_path / "damaged").write_bytes(damaged)
        if damaged == tiny:
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
    def test_a_missing_file_is_refused(self, tmp_path: Path) -> None:
        for path in (tmp_path / "no", tmp_path):
            for reader in (load_prior, read_manifest):
                with pytest.raises(FileNotFoundError, match="No file of a prior at"):
                    reader(path)

    @pytest.mark.parametrize("data", [b"", b"policy", b"\x80\x04", b"PK\x03\x04" + b"\0" * 100, b"{}" * 50])
    def test_a_file_that_is_no_safetensors_is_refused(self, tmp_path: Path, data: bytes) -> None:
        (tmp_path / "policy").write_bytes(data)
        refused(tmp_path / "policy", "not a safetensors file")

    @pytest.mark.parametrize(
        ("metadata", "match"), [(None, "with metadata"), ({"format": "pt"}, "not one of torchrl_priors.save_prior")]
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
        safetensors.torch.save_file({"w": torch.zeros(1)}, tmp_path / "policy", {KIND: about})
        refused(tmp_path / "policy", "manifest is not")

    @pytest.mark.parametrize("version", [0, 1, 3, "1", None, True, 2.0])
    def test_a_file_of_another_version_is_refused(self, saved: Saved, version: Any) -> None:
        saved.path.write_bytes(pack(*contents(saved.path), version=version))
        what = "write it again by save_prior" if str(version) == "1" != version else "newer torchrl_priors"
        refused(saved.path, f"of version {version!r}, .*{what}")

    def test_the_former_format_of_policies(self, saved: Saved) -> None:
        safetensors.torch.save_file({"w": torch.zeros(1)}, saved.path, {"torchrl_priors.policy": "{}"})
        refused(saved.path, "it is a policy of an older torchrl_priors, .*: write it again by save_prior")

    @pytest.mark.parametrize(
        ("entry", "value", "match"),
        [
            ("env_id", "", "name its environment, got env_id=''"),
            ("env_id", 1, "name its environment, got env_id=1"),
            ("seed", "0", "its seed must be null or an integer of at least 0, got '0'"),
            ("frames", 1.5, "its frames must be null or an integer of at least 0, got 1.5"),
            ("evaluation", [], "its evaluation must be an object of JSON, got"),
            ("training", None, "its training must be an object of JSON, got None"),
            ("prior", [], "its prior must be an object of JSON, got"),
        ],
    )
    def test_a_file_with_an_impossible_manifest_is_refused(
        self, saved: Saved, entry: str, value: Any, match: str
    ) -> None:
        tensors, manifest = contents(saved.path)
        saved.path.write_bytes(pack(tensors, {**manifest, entry: value}))
        refused(saved.path, match)

    def test_a_manifest_with_other_entries(self, saved: Saved) -> None:
        tensors, manifest = contents(saved.path)
        for other in ({**manifest, "code": "print()"}, {k: v for k, v in manifest.items() if k != "seed"}, None):
            saved.path.write_bytes(pack(tensors, other))
            refused(saved.path, "must have the entries env_id, evaluation, ")

    @pytest.mark.parametrize("dtype", ["F4", "F8_E8M0", "C64", "BOOL", "U16", "object", ""])
    @pytest.mark.parametrize("shape", [[ACTIONS], [-ACTIONS], [0], [2**62, 2], ["3"]])
    @pytest.mark.parametrize("offsets", [(0, 12), (12, 0), (0, 2**62), (4, 16), (-12, 0)])
    def test_a_file_with_an_impossible_header_is_refused(
        self, saved: Saved, dtype: str, shape: list[Any], offsets: tuple[int, int]
    ) -> None:
        data = saved.path.read_bytes()
        size = int.from_bytes(data[:8], "little")
        header = json.loads(data[8 : 8 + size])
        about = json.loads(header["__metadata__"][KIND])
        header["__metadata__"][KIND] = json.dumps({**about, "sha256": _NO_DIGEST})
        header[SCALE] = {"dtype": dtype, "shape": shape, "data_offsets": offsets}
        forged = json.dumps(header).encode()
        saved.path.write_bytes(_seal(struct.pack("<Q", len(forged)) + forged + data[8 + size :]))
        refused(saved.path, f"its tensors can't be read|{SCALE}")


def forge(path: Path, prior: Any, change: Any) -> None:
    """The file of a prior with other parts and tensors, whose digest is right."""
    save_prior(path, prior(), env_id="Toy-v0")
    tensors, manifest = contents(path)
    change(manifest["prior"], tensors)
    path.write_bytes(pack(tensors, manifest))


def put(name: str, value: Any, dtype: torch.dtype = torch.float32) -> Any:
    return lambda parts, tensors: tensors.update({name: torch.as_tensor(value, dtype=dtype)})


def tell(**entries: Any) -> Any:
    return lambda parts, tensors: parts.update(entries)


def layer(number: int, **options: Any) -> Any:
    return lambda parts, tensors: parts["network"]["layers"][number].update(options)


def policy() -> Any:
    return policy_prior(make_actor(OBS, ACTIONS, hidden=(8, 8)), RunningNorm(OBS))


def own_std() -> Any:
    return gaussian(nn.Linear(OBS, 2), StateIndependentStd(torch.zeros(2)))


def linear() -> Any:
    return gaussian(TeacherInput((OBS,), statistics=(torch.zeros(OBS),) * 2), GaussianHead(OBS, 2))


def clipped() -> Any:
    return gaussian(nn.Linear(OBS, 2), ClipToBox(torch.zeros(2), torch.ones(2)), StateIndependentStd(torch.zeros(2)))


SQUASHED, TABLE, UNIFORM = (STORABLE[name] for name in ("squashed", "table", "uniform"))
FORGED = [
    (policy, tell(prior="pickle"), "its kind of prior is unknown: 'pickle'"),
    (policy, tell(prior="x" * 900_000), r"its kind of prior is unknown: 'xxx.*\.\.\..*xxx'"),
    (policy, tell(distribution="Delta"), "its distribution is unknown: 'Delta', expected one of categorical"),
    (policy, tell(output="action"), "Unknown output 'action'"),
    (policy, tell(output="mean"), r"missing: prior\.std"),
    (policy, tell(box=1), "its box must be true or false, got 1"),
    (policy, tell(in_keys=[3]), r"its in_keys must be lists of names, got \[3\]"),
    (policy, tell(extra=1), "a prior 'module' has the entries network, .*, got .*extra"),
    (policy, tell(network={"layer": "os.system"}), "its layer is unknown: 'os.system'"),
    (policy, tell(network=["tanh"]), r"a layer must be an object of JSON, got \['tanh'\]"),
    (policy, tell(network={"layer": "linear", "size": 3}), "a layer 'linear' has the options in_features, .*got size"),
    (policy, layer(1, activation="sin"), "activation of a layer 'gaussian_mlp' must be one of elu, .*, got 'sin'"),
    (policy, layer(1, obs_dim=0), "obs_dim of a layer 'gaussian_mlp' must be a positive integer, got 0"),
    (policy, layer(1, hidden=[1] * 101), "more layers than its tensors could fill"),
    (policy, layer(1, hidden=[8, -8]), r"hidden of a layer .* must be a positive integer, got \[8, -8\]"),
    (policy, layer(0, clip=-1), "clip of a layer 'running_norm' must be a positive number, got -1"),
    (policy, layer(0, eps=10**400), "eps of a layer 'running_norm' must be a positive number, got 1000"),
    # well formed, but not what the tensors are
    (
        policy,
        layer(1, obs_dim=5),
        r"prior\.network\.1.mean.0.weight must be torch.float32 of shape \(8, 5\), got .*8, 4",
    ),
    (policy, layer(1, hidden=[8]), rf"missing or unexpected: {NETWORK}1\.mean\.4\.bias"),
    (policy, layer(1, hidden=[2**30, 2**30]), "must be torch.float32 of shape"),
    # tensors that are not those of the description
    (policy, lambda _, tensors: tensors.pop(SCALE), f"missing or unexpected: {SCALE}"),
    (policy, put("a\x1b[2J", [0.0]), r"unexpected: a\\x1b\[2J\."),
    (policy, put(f"{NETWORK}a\x1b[2J", [0.0]), r"unexpected: prior\.network\.a\\x1b\[2J\."),
    (policy, put(SCALE, torch.zeros(ACTIONS + 1)), rf"{SCALE} must be torch.float32 of shape \(3,\)"),
    (policy, put(SCALE, torch.zeros(ACTIONS), torch.float64), "got torch.float64"),
    (policy, put(SCALE, [math.nan] * ACTIONS), f"{SCALE} is not finite"),
    (UNIFORM, put("prior.logits", torch.zeros(0, 2**40)), r"is empty: it is of shape \(0, "),
    (UNIFORM, put("prior.logits", torch.zeros(1, 4)), r"one dimension, got shape \(1, 4\)"),
    (TABLE, put("prior.q.table", torch.zeros(2**40, 0)), r"is empty: it is of shape \(1099"),
    # numbers that make what is none
    (policy, put(SCALE, [0.0, 0.0, 1000.0]), "exponentials of state_independent_scale, overflow or vanish"),
    (policy, put(f"{NETWORK}0.var", [-1.0] * OBS, torch.float64), "negative variance"),
    (policy, put(f"{NETWORK}0.count", -1.0, torch.float64), "negative count"),
    (policy, put(f"{NETWORK}0.mean", [1e300] * OBS, torch.float64), "statistics of its observations overflow"),
    (own_std, put(f"{NETWORK}1.log_std", [0.0, 1000.0]), "exponentials of log_std, overflow or vanish"),
    (clipped, put(f"{NETWORK}1.low", [0.0, 1.5]), "lower bounds of its actions are above the upper ones"),
    (linear, put(f"{NETWORK}0.var", [-1.0] * OBS, torch.float64), "negative variance"),
    *(
        (linear, layer(1, log_std_range=list(values)), "log_std_range of a layer 'gaussian_head' must be a lower and")
        for values in (("nan", "inf"), (2, -20), (-20, 1000), (-1000, -999), (True, True), (1,))
    ),
    (linear, layer(0, statistics=[[OBS]]), "statistics of a layer 'teacher_input' must be null, or the shapes of a"),
    (SQUASHED, put("prior.low", [-math.inf] * ACTIONS), r"bounds of its actions, prior\.low and high, must be finite"),
    (SQUASHED, put("prior.low", [3.0] * ACTIONS), "the lower ones below the upper ones"),
    (TABLE, tell(temperature=1e-300), "its temperature must be a positive number, got 1e-300"),
    (TABLE, tell(temperature="1"), "its temperature must be a positive number, got '1'"),
    (TABLE, tell(temperature=1e-40), "overflow at temperature 1e-40"),
    (TABLE, tell(q={"in_keys": []}), r"its in_keys must be lists of names, got \[\]"),
    (STORABLE["affordances"], tell(epsilon=True), "its epsilon must be a number, got True"),
    (STORABLE["mixture"], tell(priors={}), "a mixture must have a list of priors, got"),
]


@pytest.mark.parametrize(("prior", "change", "match"), FORGED)
def test_what_does_not_fit_or_gives_no_numbers_or_fills_the_memory_or_the_screen_is_refused(
    tmp_path: Path, prior: Any, change: Any, match: str
) -> None:
    forge(tmp_path / "prior", prior, change)
    refused(tmp_path / "prior", match)


def test_reading_uses_no_pickle(saved: Saved, monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(*args: Any, **kwargs: Any) -> None:
        raise AssertionError("pickle was used")

    for module, name in ((pickle, "load"), (pickle, "loads"), (pickle, "Unpickler"), (torch, "load")):
        monkeypatch.setattr(module, name, fail)
    load_prior(saved.path)
