"""This library's names in YAML files that Hydra composes."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest
from hydra import compose, initialize_config_dir
from hydra.errors import ConfigCompositionException
from hydra.utils import instantiate
from omegaconf import DictConfig
from torch import nn
from torchrl.envs import RewardSum
from torchrl.modules import ValueOperator

import torchrl_priors
from torchrl_priors import ActionPrior, AE2RLoss, PriorBonus, PriorLogProb, PriorShaping, PriorWeight, UniformPrior

YAML = """
defaults:
  - transform@log_prob: prior_log_prob
  - transform@bonus: prior_bonus
  - transform@theirs: reward_sum
  - loss: ae2r
  - prior: uniform
  - hook: prior_shaping
  - model@weight: prior_weight
  - _self_
prior: {actions: 2, action_key: [agent, action], namespace: [agent, prior]}
log_prob: {prior: "${prior}", boundary: zero, done_key: [agent, done]}
bonus: {method: er, bonus_coeff: 0.5, reward_key: [agent, reward]}
weight: {net: {_target_: torch.nn.Linear, in_features: 3, out_features: 1}, out_keys: [[agent, weight]]}
loss: {prior: "${prior}", method: e2r, aux_coeff: 0.1, keys: {reward: [agent, reward]}}
hook: {boundary: sample}
"""


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    torchrl_priors.register_configs()
    torchrl_priors.register_configs()  # again, which does no harm
    (tmp_path / "config.yaml").write_text(YAML, encoding="utf-8")
    return tmp_path


def composed(folder: Path, *overrides: str) -> DictConfig:
    with initialize_config_dir(str(folder), version_base="1.3"):
        return compose("config", overrides=list(overrides))


def make_actor() -> ActionPrior:
    return UniformPrior(2).module


def test_names_stand_beside_torchrls_own(folder: Path) -> None:
    config = composed(folder)
    prior = instantiate(config.prior)
    assert isinstance(prior, UniformPrior)
    assert prior.action_key == ("agent", "action")
    assert prior.out_keys[0][:2] == ("agent", "prior")
    log_prob = instantiate(config.log_prob)
    assert isinstance(log_prob, PriorLogProb)
    assert log_prob.done_key == ("next", "agent", "done")
    bonus = instantiate(config.bonus)
    assert isinstance(bonus, PriorBonus)
    assert (bonus.shift, bonus.reward_key) == ("current", ("next", "agent", "reward"))
    weight = instantiate(config.weight)
    assert isinstance(weight, PriorWeight)
    assert weight.out_keys == [("agent", "weight")]
    assert instantiate(config.hook).kwargs["boundary"] == "sample"
    assert isinstance(instantiate(config.hook), PriorShaping)
    assert isinstance(instantiate(config.theirs), RewardSum)


def test_a_loss_is_made_of_python_objects_and_settings_of_yaml(folder: Path) -> None:
    loss = instantiate(composed(folder).loss, actor_network=make_actor())
    assert isinstance(loss, AE2RLoss)
    assert loss.spec.bonus == "next"
    assert loss.aux_coeff.item() == pytest.approx(0.1)
    assert loss.tensor_keys.reward == ("agent", "reward")


@pytest.mark.parametrize("td_error", ["original", "shaped"])
def test_ppo_of_yaml_gives_its_networks_to_the_priors_loss(folder: Path, td_error: str) -> None:
    overrides = ["+loss@ppo=clip_ppo_prior", "loss.method=ae2r", f"loss.td_error={td_error}", "loss._partial_=true"]
    config = composed(folder, *overrides, "loss.actor_network=null", "ppo.prior_loss=${loss}")
    actor, critic = make_actor(), ValueOperator(nn.Linear(3, 1), in_keys=["observation"])
    config.loss.critic_network = {"_target_": "torchrl.modules.ValueOperator", "module": "${weight.net}"}
    config.loss.prior_weight = "${weight}"
    loss = instantiate(config.ppo, actor_network=actor, critic_network=critic)
    assert loss.prior_loss.actor_network is actor
    assert (loss.prior_loss.critic_network is critic) == (td_error == "shaped")
    assert loss.prior_loss.tensor_keys.reward == ("agent", "reward")


def test_objects_of_python_are_shared_with_a_transform_of_yaml(folder: Path) -> None:
    weight = PriorWeight(nn.Linear(3, 1))
    bonus = instantiate(composed(folder, "bonus.method=ae2r").bonus, prior_weight=weight)
    assert bonus.__dict__["prior_weight"] is weight


def test_a_typo_in_an_override_is_an_error(folder: Path) -> None:
    with pytest.raises(ConfigCompositionException, match="bonus_coef"):
        composed(folder, "bonus.bonus_coef=1")


def test_a_missing_hydra_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "hydra.core.config_store", None)
    monkeypatch.delitem(sys.modules, "torchrl_priors.configs", raising=False)
    with pytest.raises(ImportError, match="recipes"):
        torchrl_priors.register_configs()
