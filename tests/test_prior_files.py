"""Claims about priors in files."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import pytest
import safetensors.torch
import torch
from tensordict import TensorDict
from torch import nn
from torchrl.data import (
    Binary,
    Bounded,
    Categorical,
    MultiCategorical,
    MultiOneHot,
    OneHot,
    TensorSpec,
    Unbounded,
    UnboundedDiscrete,
)
from torchrl.modules import OneHotCategorical, TanhNormal

from torchrl_priors import (
    ActionPrior,
    AffordancePrior,
    BoltzmannPrior,
    CallablePrior,
    MixturePrior,
    ModulePrior,
    UniformPrior,
)
from torchrl_priors.artifacts import ArtifactError, load_policy, load_prior, read_manifest, save_prior
from torchrl_priors.artifacts.format import PRIOR, pack
from torchrl_priors.artifacts.prior import build_prior
from torchrl_priors.networks import make_actor
from torchrl_priors.priors.layers import GaussianHead, StateIndependentStd, TeacherInput

OBS, ACTIONS = 3, 4


def table(seed: int = 0, states: int = 5) -> torch.Tensor:
    return torch.rand(states, ACTIONS, generator=torch.Generator().manual_seed(seed))


def net(out: int = ACTIONS) -> nn.Sequential:
    return nn.Sequential(nn.Linear(OBS, 8), nn.SiLU(), nn.Linear(8, out))


class Own(nn.Tanh):
    """A layer that no file knows."""


STORABLE = {
    "logits": lambda: ModulePrior(net(), "logits", in_keys=[("agent", "observation")]),
    "mean": lambda: ModulePrior(net(), "mean", std=torch.tensor([0.1, 0.2, 0.3, 0.4])),
    "squashed": lambda: ModulePrior(
        net(), "mean", std=0.2, distribution_class=TanhNormal,
        distribution_kwargs={"low": torch.zeros(ACTIONS), "high": 2 * torch.ones(ACTIONS)},
    ),
    "table": lambda: BoltzmannPrior(table(), 0.3),
    "worlds": lambda: BoltzmannPrior(torch.stack([table(), table(1)]), distribution_class=OneHotCategorical),
    "q_network": lambda: BoltzmannPrior(net(), 2.0),
    "affordances": lambda: AffordancePrior(table() > 0.4, 0.2),
    "uniform": lambda: UniformPrior(ACTIONS),
    "box": lambda: UniformPrior(Bounded(torch.zeros(2), torch.ones(2), shape=(2,))),
    "mixture": lambda: MixturePrior(
        [BoltzmannPrior(table()), MixturePrior([ModulePrior(net(), "logits"), UniformPrior(ACTIONS)], [3.0, 1.0])],
        torch.rand(5, 2),
    ),
    "gaussian_mixture": lambda: MixturePrior(
        [ModulePrior(net(), "mean", std=0.1), ModulePrior(net(), "mean", std=0.2)], [0.2, 0.8]
    ),
}  # fmt: skip


class TestFiles:
    @pytest.mark.parametrize("name", STORABLE)
    def test_round_trip(self, name: str, tmp_path: Any) -> None:
        prior = STORABLE[name]()
        manifest = save_prior(tmp_path / "prior", prior, env_id="Toy-v0", evaluation={"mean_return": 1.5})
        loaded = load_prior(tmp_path / "prior", namespace="other", env_id="Toy-v0")
        assert manifest == read_manifest(tmp_path / "prior")
        assert type(loaded) is type(prior)
        assert loaded.in_keys == prior.in_keys
        x = torch.randn(2, 6, OBS)
        batch = TensorDict(
            observation=x, agent=TensorDict(observation=x, batch_size=[2, 6]), state=torch.randint(5, (2, 6)),
            batch_size=[2, 6],
        )  # fmt: skip
        batch["action"] = prior.get_dist(batch).sample()
        assert torch.equal(loaded.log_prob(batch), prior.log_prob(batch))
        with pytest.raises(ArtifactError, match="load_prior reads"):
            load_policy(tmp_path / "prior")

    def test_another_key_can_be_read(self, tmp_path: Any) -> None:
        save_prior(tmp_path / "prior", STORABLE["logits"](), env_id="Toy-v0")
        assert load_prior(tmp_path / "prior", in_key="pixels").in_keys == ["pixels"]
        save_prior(tmp_path / "prior", STORABLE["mixture"](), env_id="Toy-v0")
        with pytest.raises(ArtifactError, match="in_key can't replace"):
            load_prior(tmp_path / "prior", in_key="pixels")

    @pytest.mark.parametrize(
        ("prior", "match"),
        [
            (lambda: CallablePrior(lambda x: x, std=1.0), "can't hold this CallablePrior"),
            (lambda: ModulePrior(Own(), "logits"), "can't hold Own"),
            (lambda: AffordancePrior(lambda x: x), "can't hold code"),
            (lambda: ModulePrior(nn.Sequential(net(), Own()), "logits"), "can't hold Own"),
            (lambda: ModulePrior(nn.Sequential(nn.ELU(0.5), net()), "logits"), "default options"),
            (lambda: MixturePrior([UniformPrior(2), CallablePrior(lambda x: 0, num_actions=2)]), "CallablePrior"),
            (lambda: ModulePrior(net(), "logits").adversary(), "can't hold this NegatedPrior"),
            (lambda: net(), "got Sequential"),
            (lambda: ActionPrior(make_actor(OBS, ACTIONS)), "this ActionPrior.*keep that file"),
        ],
    )
    def test_code_has_no_place_in_a_file(self, prior: Any, match: str, tmp_path: Any) -> None:
        with pytest.raises(TypeError, match=match):
            save_prior(tmp_path / "prior", prior(), env_id="Toy-v0")
        assert not list(tmp_path.iterdir())

    def test_a_description_that_does_not_fit_is_refused(self, tmp_path: Any) -> None:
        save_prior(tmp_path / "prior", STORABLE["mean"](), env_id="Toy-v0")
        tensors = safetensors.torch.load((tmp_path / "prior").read_bytes())
        parts = read_manifest(tmp_path / "prior").prior  # type: ignore[union-attr]
        assert isinstance(build_prior(tensors, parts), ActionPrior)
        huge = {"layer": "linear", "sizes": [2**30, 2**30], "bias": True}
        for change, match in (
            ({"prior": "pickle"}, "kind of prior is unknown: 'pickle'"),
            ({"network": huge}, "missing or unexpected"),
            ({"network": {"layer": "linear", "sizes": [-1, 2], "bias": True}}, "positive integers"),
            ({"network": {"layer": "os.system"}}, "layer is unknown: 'os.system'"),
            ({"network": {"layer": "linear", "size": 3}}, "can't be built"),
            ({"distribution": "Delta"}, "distribution is unknown"),
            ({"output": "action"}, "Unknown output"),
            ({"std": False}, "pass std"),
            ({"in_keys": [3]}, "in_keys must be"),
            ({"extra": 1}, "has the entries"),
        ):
            with pytest.raises(ArtifactError, match=match):
                build_prior(tensors, {**parts, **change})
        with pytest.raises(ArtifactError, match="unexpected: more"):
            build_prior({**tensors, "more": torch.zeros(1)}, parts)
        tensors["prior.network.0.bias"][0] = math.nan
        with pytest.raises(ArtifactError, match="not finite"):
            build_prior(tensors, parts)


def forge(path: Path, prior: ActionPrior, change: Any) -> None:
    """The file of a prior with other parts and tensors, whose digest is right."""
    save_prior(path, prior, env_id="Toy-v0")
    tensors, manifest = safetensors.torch.load(path.read_bytes()), read_manifest(path)
    change(manifest.prior, tensors)  # type: ignore[union-attr]
    path.write_bytes(pack(tensors, {**vars(manifest)}, kind=PRIOR))


def gaussian(*layers: nn.Module) -> Any:
    return lambda: ModulePrior(nn.Sequential(*layers), "mean_std")


NORMALISED = TeacherInput((OBS,), statistics=(torch.zeros(OBS), torch.ones(OBS)))
LAYER = "prior.network."


def put(name: str, value: Any, dtype: torch.dtype = torch.float32) -> Any:
    return lambda parts, tensors: tensors.update({name: torch.as_tensor(value, dtype=dtype)})


def put_range(*values: Any) -> Any:
    return lambda parts, tensors: parts["network"]["layers"][0].update(log_std_range=list(values))


@pytest.mark.parametrize(
    ("prior", "change", "match"),
    [
        (
            gaussian(nn.Linear(OBS, 2), StateIndependentStd(torch.zeros(2))),
            put(f"{LAYER}1.log_std", [0.0, 1000.0]),
            "exponentials of log_std, overflow or vanish",
        ),
        (
            gaussian(nn.Linear(OBS, 2), StateIndependentStd(torch.zeros(2))),
            put(f"{LAYER}1.log_std", [0.0, -1000.0]),
            "exponentials of log_std, overflow or vanish",
        ),
        (
            gaussian(NORMALISED, GaussianHead(OBS, 2)),
            put(f"{LAYER}0.var", [1.0, 1.0, -1.0], torch.float64),
            "negative variance",
        ),
        *(
            (gaussian(GaussianHead(OBS, 2)), put_range(*values), "log_std_range must be a lower and an upper bound")
            for values in (("nan", "inf"), (2, -20), (-20, 1000), (-1000, -999), (True, True), (1,))
        ),
        (STORABLE["squashed"], put("prior.low", [-math.inf] * ACTIONS), "bounds of its actions must be finite"),
        (STORABLE["squashed"], put("prior.low", [3.0] * ACTIONS), "the lower ones below the upper ones"),
        (STORABLE["squashed"], put("prior.low", [0.0]), "bounds of its actions"),
        (STORABLE["box"], put("prior.high", [math.nan, 1.0]), "bounds of its actions"),
        (STORABLE["uniform"], put("prior.logits", torch.zeros(1, ACTIONS)), r"one dimension, got shape \(1, 4\)"),
        (STORABLE["uniform"], put("prior.logits", torch.zeros(0, 2**40)), r"is empty: it is of shape \(0, "),
        (STORABLE["table"], put("prior.q.table", torch.zeros(2**40, 0)), r"is empty: it is of shape \(1099"),
        (STORABLE["table"], lambda parts, _: parts.update(temperature=1e-300), "temperature must be a positive"),
        (STORABLE["table"], lambda parts, _: parts.update(temperature="1"), "temperature must be a positive"),
        (STORABLE["table"], lambda parts, _: parts.update(temperature=1e-40), "overflow at temperature 1e-40"),
        (STORABLE["uniform"], put("a\x1b[2J", [0.0]), r"unexpected: a\\x1b\[2J\."),
        (STORABLE["logits"], put(f"{LAYER}a\x1b[2J", [0.0]), r"unexpected: a\\x1b\[2J\."),
        (STORABLE["uniform"], lambda parts, _: parts.update(prior="x" * 900_000), r"unknown: 'xxx.* \.\.\. .*xxx"),
    ],
)
def test_what_would_give_no_numbers_or_fill_the_memory_or_the_screen_is_refused(
    tmp_path: Path, prior: Any, change: Any, match: str
) -> None:
    forge(tmp_path / "prior", prior(), change)
    with pytest.raises(ArtifactError, match=match) as caught:
        load_prior(tmp_path / "prior")
    assert str(tmp_path / "prior") in str(caught.value)
    assert str(caught.value).isprintable()
    assert len(str(caught.value)) < 2000


def of_actions(kind: str) -> ActionPrior:
    network = nn.Linear(OBS, ACTIONS)
    if kind == "gaussian":
        return ModulePrior(network, "mean", std=0.1)
    return ModulePrior(network, "logits", distribution_class=OneHotCategorical if kind == "one_hot" else None)


FITTING: list[tuple[str, TensorSpec | tuple[int, ...] | int]] = [
    ("index", ACTIONS),
    ("index", ()),
    ("index", Categorical(ACTIONS)),
    ("index", Categorical(ACTIONS, shape=(2,))),
    ("one_hot", ACTIONS),
    ("one_hot", OneHot(ACTIONS)),
    ("one_hot", OneHot(ACTIONS, shape=(2, ACTIONS))),
    ("gaussian", ACTIONS),
    ("gaussian", (ACTIONS,)),
    ("gaussian", Bounded(-1.0, 1.0, shape=(ACTIONS,))),
    ("gaussian", Unbounded((2, ACTIONS), dtype=torch.float64)),
]
OTHERS: list[tuple[str, TensorSpec | tuple[int, ...] | int]] = [
    ("index", ACTIONS + 1),
    ("index", Categorical(ACTIONS + 1)),
    ("index", OneHot(ACTIONS)),
    ("index", Binary(ACTIONS)),
    ("index", MultiCategorical([ACTIONS])),
    ("index", Bounded(0, 3, shape=(), dtype=torch.int64)),
    ("one_hot", OneHot(ACTIONS + 1)),
    ("one_hot", Categorical(ACTIONS)),
    ("one_hot", MultiOneHot([2, 2])),
    ("one_hot", Unbounded(ACTIONS)),
    ("gaussian", OneHot(ACTIONS)),
    ("gaussian", MultiOneHot([2, 2])),
    ("gaussian", Binary(ACTIONS)),
    ("gaussian", Categorical(ACTIONS)),
    ("gaussian", UnboundedDiscrete(ACTIONS)),
    ("gaussian", Unbounded(ACTIONS + 1)),
    ("gaussian", (ACTIONS, 1)),
]


class TestSpaces:
    @pytest.mark.parametrize(("kind", "spec"), FITTING)
    @pytest.mark.parametrize("batch", [(), (2,)])
    def test_actions_that_fit_are_taken(self, tmp_path: Path, kind: str, spec: Any, batch: tuple[int, ...]) -> None:
        save_prior(tmp_path / "prior", of_actions(kind), env_id="Toy-v0")
        load_prior(tmp_path / "prior", observation_spec=Unbounded((*batch, OBS)), action_spec=spec)

    @pytest.mark.parametrize(("kind", "spec"), OTHERS)
    def test_other_actions_are_refused(self, tmp_path: Path, kind: str, spec: Any) -> None:
        save_prior(tmp_path / "prior", of_actions(kind), env_id="Toy-v0")
        with pytest.raises(ArtifactError, match="it advises on actions"):
            load_prior(tmp_path / "prior", observation_spec=OBS, action_spec=spec)

    def test_a_prior_that_reads_nothing_is_checked_too(self, tmp_path: Path) -> None:
        save_prior(tmp_path / "prior", UniformPrior(ACTIONS), env_id="Toy-v0")
        load_prior(tmp_path / "prior", observation_spec=OBS, action_spec=ACTIONS)
        with pytest.raises(ArtifactError, match="it advises on actions"):
            load_prior(tmp_path / "prior", observation_spec=OBS, action_spec=ACTIONS + 1)

    def test_actions_alone_are_not_checked_and_so_refused(self, tmp_path: Path) -> None:
        save_prior(tmp_path / "prior", of_actions("index"), env_id="Toy-v0")
        with pytest.raises(ValueError, match="observation_spec is needed"):
            load_prior(tmp_path / "prior", action_spec=ACTIONS)
