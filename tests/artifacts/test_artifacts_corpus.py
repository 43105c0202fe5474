"""A thousand damaged and foreign files: each is refused with a reason, none does anything."""

from __future__ import annotations

import json
import subprocess
import sys
from collections import Counter
from dataclasses import asdict
from pathlib import Path

import pytest
import torch
from artifact_corpus import not_files, write_corpus
from sb3_corpus import write_sb3_corpus

from torchrl_priors import BoltzmannPrior, MixturePrior, ModulePrior, policy_prior
from torchrl_priors.artifacts import load_prior, read_manifest, save_prior
from torchrl_priors.collectors import RunningNorm
from torchrl_priors.networks import make_actor

# Reads every file of a folder in a process of its own, with little memory, and tells what came of it. What the readers
# do to the machine is seen by an audit hook: files that are opened, code that is compiled, imported or unpickled,
# processes and connections.
READER = """
import json, resource, sys
from pathlib import Path
from torchrl_priors.artifacts import load_prior, read_manifest

folder = Path(sys.argv[1])
for good in sys.argv[2:]:
    load_prior(good), read_manifest(good)  # what is imported late, is imported now
events, opened, watching = set(), set(), False

def hook(event, args):
    if watching:
        events.add(event)
        if event == "open":
            opened.add((str(args[0]), str(args[1])))

sys.addaudithook(hook)
used = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
resource.setrlimit(resource.RLIMIT_AS, (used + 2**30, used + 2**30))
outcomes = {}
for path in sorted(folder.iterdir()):
    outcome = []
    for reader in (load_prior, read_manifest):
        watching = True
        try:
            reader(path)
            error = None
        except BaseException as caught:
            error = caught
        watching = False
        outcome.append([type(error).__name__, str(error)])
    outcomes[path.name] = outcome
print(json.dumps({"outcomes": outcomes, "events": sorted(events), "opened": sorted(opened)}))
"""

# The same for the files of Stable-Baselines3. PyTorch reads their weights, and imports and opens what it likes.
SB3_READER = """
import json, resource, sys
from pathlib import Path
from torchrl_priors.artifacts import load_sb3_prior

folder, good, vecnormalize = Path(sys.argv[1]), sys.argv[2], sys.argv[3]
load_sb3_prior(good, vecnormalize=vecnormalize)
used = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
resource.setrlimit(resource.RLIMIT_AS, (used + 2**30, used + 2**30))
outcomes = {}
for path in sorted(folder.iterdir()):
    try:
        load_sb3_prior(good, vecnormalize=path) if path.suffix == ".pkl" else load_sb3_prior(path)
        error = None
    except BaseException as caught:
        error = caught
    outcomes[path.name] = type(error).__name__, str(error)
print(json.dumps(outcomes))
"""


def snapshot(folder: Path) -> dict[str, tuple[int, int]]:
    """Sizes and times of last change, of every file there is."""
    return {path.name: (path.stat().st_size, path.stat().st_mtime_ns) for path in folder.iterdir()}


def save_both(folder: Path) -> tuple[Path, Path]:
    """The files of a policy and of a mixture."""
    torch.manual_seed(0)
    normalizer = RunningNorm(3)
    normalizer.update(torch.randn(50, 3) + 3)
    policy = policy_prior(make_actor(3, 2, hidden=(4,)), normalizer)
    save_prior(folder / "policy.safetensors", policy, env_id="Hopper-v5", seed=0, frames=1)
    network = torch.nn.Sequential(torch.nn.Linear(3, 4), torch.nn.Tanh(), torch.nn.Linear(4, 2))
    mixture = MixturePrior([ModulePrior(network, "logits"), BoltzmannPrior(torch.rand(5, 2), 0.3)], [3.0, 1.0])
    save_prior(folder / "mixture.safetensors", mixture, env_id="Toy-v0")
    return folder / "policy.safetensors", folder / "mixture.safetensors"


def test_a_thousand_damaged_and_foreign_files_are_refused_and_do_nothing(tmp_path: Path) -> None:
    corpus, elsewhere = tmp_path / "corpus", tmp_path / "elsewhere"
    corpus.mkdir()
    elsewhere.mkdir()
    good = save_both(tmp_path)
    write_corpus(corpus, *(path.read_bytes() for path in good), [asdict(read_manifest(path)) for path in good], seed=0)
    before = snapshot(corpus)
    command = [sys.executable, "-c", READER, str(corpus), *map(str, good)]
    done = subprocess.run(command, cwd=elsewhere, capture_output=True, text=True, check=False, timeout=300)
    assert done.returncode == 0, done.stderr[-2000:]  # no crash
    told = json.loads(done.stdout)

    assert len(told["outcomes"]) == len(before) >= 1000
    wrong = {
        name: outcome
        for name, outcome in told["outcomes"].items()
        if not all(kind == "ArtifactError" and str(corpus / name) in message for kind, message in outcome)
    }
    assert wrong == {}
    messages = [message for outcome in told["outcomes"].values() for _, message in outcome]
    assert all(message.isprintable() and len(message) < 2000 for message in messages)
    assert len(Counter(message.partition(": ")[2] for message in messages)) > 100  # reasons, not one for all

    # nothing was compiled, imported, unpickled, started or sent; a prior that fails at last was copied and inspected
    assert set(told["events"]) - {"builtins.id", "object.__getattr__"} == {"open"}
    assert {mode for _, mode in told["opened"]} <= {"r", "rb"}
    assert {Path(path).parent for path, _ in told["opened"]} == {corpus}
    assert snapshot(corpus) == before
    assert list(elsewhere.iterdir()) == []


def test_hundreds_of_files_of_stable_baselines3_are_refused_and_do_nothing(tmp_path: Path) -> None:
    from sb3_cases import save_model

    corpus, elsewhere = tmp_path / "corpus", tmp_path / "elsewhere"
    corpus.mkdir()
    elsewhere.mkdir()
    model = save_model("a2c_linear", tmp_path)
    assert model.vecnormalize is not None
    write_sb3_corpus(corpus, model.path.read_bytes(), model.vecnormalize.read_bytes(), seed=0)
    before = snapshot(corpus)
    command = [sys.executable, "-c", SB3_READER, str(corpus), str(model.path), str(model.vecnormalize)]
    done = subprocess.run(command, cwd=elsewhere, capture_output=True, text=True, check=False, timeout=300)
    assert done.returncode == 0, done.stderr[-2000:]  # no crash
    outcomes = json.loads(done.stdout)
    assert len(outcomes) == len(before) >= 300
    wrong = {
        name: (kind, message)
        for name, (kind, message) in outcomes.items()
        if kind != "ArtifactError" or name not in message or not message.isprintable() or len(message) > 2000
    }
    assert wrong == {}
    assert snapshot(corpus) == before
    assert list(elsewhere.iterdir()) == []


def test_what_is_no_file_is_said_to_be_none(tmp_path: Path) -> None:
    paths = list(not_files(tmp_path))
    for path in paths:
        for reader in (load_prior, read_manifest):
            with pytest.raises(FileNotFoundError, match="No file of a prior at") as caught:
                reader(path)
            assert str(path) in str(caught.value)
    assert set(tmp_path.iterdir()) == set(paths[:-1])
