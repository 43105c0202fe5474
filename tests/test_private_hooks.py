"""What the library uses of others' private names, so that an upgrade that takes one away fails here, by its name."""

from __future__ import annotations

import ast
import importlib
from pathlib import Path
from typing import Any

import pytest
import torch
from tensordict.nn import TensorDictModule
from torchrl.modules import IndependentNormal, ProbabilisticActor
from torchrl.objectives import ClipPPOLoss

ROOT = Path(__file__).parents[1] / "torchrl_priors"

#: Of classes and modules, by where they are.
OF_CLASSES = {
    "torchrl.objectives.LossModule": [
        "_clear_weakrefs",
        "_forward_value_estimator_keys",
        "_loss_mask_keys",
        "_reduce_loss",
        "_reset_module_parameters",
    ],
    "torchrl.objectives.ClipPPOLoss": ["_critic_loss_inputs", "_get_cur_log_prob", "_set_in_keys"],
    "torch.Tensor": ["_version"],
    "torch.distributions.kl": ["_KL_MEMOIZE", "_dispatch_kl"],
    "torch": ["_foreach_add_", "_foreach_copy_", "_guards", "_inductor", "_ops", "_subclasses"],
}
#: Of objects.
OF_A_LOSS = ["_value_estimator"]
OF_A_MODULE = ["_buffers", "_forward_hooks", "_forward_pre_hooks", "_modules", "_parameters"]
OF_A_TENSORDICT_MODULE = ["_kwargs"]
OF_A_HEAD = ["_generator_key"]
#: MuJoCo's environments and their wrappers keep these; where one is missing, plain steps are taken instead.
WITH_A_WAY_AROUND = {
    "_contact_cost_range",
    "_contact_cost_weight",
    "_contact_force_range",
    "_ctrl_cost_weight",
    "_elapsed_steps",
    "_exclude_current_positions_from_observation",
    "_forward_reward_weight",
    "_healthy_angle_range",
    "_healthy_reward",
    "_healthy_state_range",
    "_healthy_z_range",
    "_include_cfrc_ext_in_observation",
    "_main_body",
    "_max_episode_steps",
    "_terminate_when_unhealthy",
    "_use_contact_forces",
}
DOCUMENTED = {"_asdict", "_replace"}  # of named tuples


def find(path: str) -> Any:
    module, _, name = path.rpartition(".")
    return getattr(importlib.import_module(module), name) if module else importlib.import_module(path)


@pytest.mark.parametrize(("owner", "name"), [(owner, name) for owner, names in OF_CLASSES.items() for name in names])
def test_every_class_of_torchrl_has_its_private_hook(owner: str, name: str) -> None:
    if owner == "torch" and not name.startswith("_foreach"):
        importlib.import_module(f"torch.{name}")
    assert hasattr(find(owner), name)


def test_objects_have_their_hooks() -> None:
    network = torch.nn.Linear(2, 1)
    critic = TensorDictModule(network, in_keys=["observation"], out_keys=["state_value"])
    policy = TensorDictModule(torch.nn.Linear(2, 2), in_keys=["observation"], out_keys=["loc", "scale"])
    actor = ProbabilisticActor(policy, in_keys=["loc", "scale"], distribution_class=IndependentNormal)
    for owner, names in (
        (network, OF_A_MODULE),
        (critic, OF_A_TENSORDICT_MODULE),
        (actor.module[-1], OF_A_HEAD),
        (ClipPPOLoss(actor, critic), OF_A_LOSS),
    ):
        assert [name for name in names if not hasattr(owner, name)] == []


def names_of_others() -> set[str]:
    """Names with an underscore that the library uses and defines nowhere itself."""
    trees = [ast.parse(file.read_text()) for file in ROOT.rglob("*.py")]
    nodes = [node for tree in trees for node in ast.walk(tree)]
    own = {node.name for node in nodes if isinstance(node, (ast.FunctionDef, ast.ClassDef))}
    own |= {node.id for node in nodes if isinstance(node, ast.Name)} | {n.arg for n in nodes if isinstance(n, ast.arg)}
    own |= {node.attr for node in nodes if isinstance(node, ast.Attribute) and isinstance(node.ctx, ast.Store)}
    used = {node.attr for node in nodes if isinstance(node, ast.Attribute)}
    for node in nodes:
        if isinstance(node, ast.ImportFrom):
            used |= {alias.name for alias in node.names} | set((node.module or "").split("."))
    return {name for name in used - own if name.startswith("_") and not name.startswith("__")}


def test_no_other_private_name_is_used() -> None:
    known = {name for names in OF_CLASSES.values() for name in names} | WITH_A_WAY_AROUND | DOCUMENTED
    known |= {*OF_A_LOSS, *OF_A_MODULE, *OF_A_TENSORDICT_MODULE, *OF_A_HEAD}
    assert names_of_others() - known == set()
