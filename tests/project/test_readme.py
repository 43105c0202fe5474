"""What the README tells a reader to do works, and what it names exists."""

from __future__ import annotations

import copy
import re
from pathlib import Path
from typing import Any

import pytest
import torch
from tensordict.nn import AddStateIndependentNormalScale, TensorDictModule
from torch import Tensor, nn
from torchrl.envs import CatTensors, Compose, InitTracker, StepCounter, TransformedEnv, UnsqueezeTransform
from torchrl.envs.custom import PendulumEnv
from torchrl.modules import MLP, IndependentNormal, ProbabilisticActor, ValueOperator

ROOT = Path(__file__).parents[2]
README = (ROOT / "README.md").read_text(encoding="utf-8")


def code_below(marker: str) -> str:
    block = re.search(rf"<!-- {marker} -->\n```\w+\n(.*?)```", README, flags=re.DOTALL)
    assert block is not None, f"README.md has no block of code below <!-- {marker} -->"
    return block[1]


def make_actor() -> ProbabilisticActor:
    net = nn.Sequential(MLP(2, 1, num_cells=[16]), AddStateIndependentNormalScale(1))
    module = TensorDictModule(net, in_keys=["observation"], out_keys=["loc", "scale"])
    return ProbabilisticActor(
        module, in_keys=["loc", "scale"], distribution_class=IndependentNormal, return_log_prob=True
    )


def a_readers_own_objects() -> dict[str, Any]:
    """What the example takes for granted."""
    parts = UnsqueezeTransform(-1, in_keys=["th", "thdot"], out_keys=["angle", "speed"])
    observation = CatTensors(["angle", "speed"], "observation")
    return {
        "env": TransformedEnv(PendulumEnv(), Compose(parts, observation, StepCounter(max_steps=40), InitTracker())),
        "actor": make_actor(),
        "teacher": make_actor(),
        "critic": ValueOperator(MLP(2, 1, num_cells=[16]), in_keys=["observation"]),
        "raw_critic": ValueOperator(MLP(2, 1, num_cells=[16]), in_keys=["observation"]),
        "weight_net": MLP(2, 1, num_cells=[16]),
    }


def run_example(code: str) -> tuple[dict[str, Any], dict[str, dict[str, Tensor]]]:
    """The objects after the run, and their parameters before it."""
    code, found = re.subn(
        r"frames_per_batch=1000, total_frames=100_000", "frames_per_batch=100, total_frames=200", code
    )
    assert found == 1
    names = a_readers_own_objects()
    before = {name: copy.deepcopy(value.state_dict()) for name, value in names.items() if isinstance(value, nn.Module)}
    exec(compile(code, "README.md", "exec"), names)
    return names, before


def same(before: dict[str, Tensor], after: dict[str, Tensor]) -> bool:
    return all(torch.equal(value, after[key]) for key, value in before.items())


def test_the_example_trains_everything_but_the_teacher(capsys: pytest.CaptureFixture[str]) -> None:
    names, before = run_example(code_below("tested: example"))
    assert capsys.readouterr().out.count("prior weight") == 2
    unchanged = {name for name in before if name != "env" and same(before[name], names[name].state_dict())}
    assert unchanged == {"teacher"}
    assert {"loss_objective", "loss_critic", "loss_prior", "loss_prior_weight", "loss_prior_critic"} <= set(
        names["losses"]
    )
    assert all(value.isfinite().all() for value in names["losses"].values())


def test_the_example_shapes_the_reward_without_touching_it() -> None:
    names, _ = run_example(code_below("tested: example"))
    data = names["data"]
    shaped = data["next", "reward"] + data["next", "prior_bonus"]
    torch.testing.assert_close(data["next", "shaped_reward"], shaped)
    assert (data["next", "prior_bonus"] != 0).any()


def test_the_example_is_as_short_as_it_says() -> None:
    lines = code_below("tested: example").strip().splitlines()
    assert len(lines) <= 24
    assert max(map(len, lines)) <= 120


def test_every_link_to_a_file_leads_somewhere() -> None:
    links = [link for link in re.findall(r"\]\(([^)#]+)\)", README) if "://" not in link]
    assert links
    assert [link for link in links if not (ROOT / link).exists()] == []
