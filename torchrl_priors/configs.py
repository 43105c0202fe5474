"""This library in TorchRL's Hydra config groups.

A config has the fields of the class that it builds, with its defaults, and one or two more that are said below. Keys
are written as in TorchRL's own configs: ``action_key: [agent, action]`` is ``("agent", "action")``.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable
from dataclasses import field, make_dataclass
from functools import partial
from typing import Any

try:
    from hydra.core.config_store import ConfigStore
    from omegaconf import MISSING
except ImportError as error:
    raise ImportError(
        "Configs need Hydra: install the extra 'recipes' (pip install 'torchrl-priors[recipes]') or hydra-core."
    ) from error
from tensordict import NestedKey
from torchrl.objectives import ClipPPOLoss, PPOLoss
from torchrl.trainers.algorithms.configs import ConfigBase, HookConfig, LossConfig, TransformConfig

from torchrl_priors.artifacts import load_prior
from torchrl_priors.objectives import AE2RLoss, ClipPPOPriorLoss
from torchrl_priors.prior_weight import PriorWeight
from torchrl_priors.priors import ActionPrior, BoltzmannPrior, UniformPrior
from torchrl_priors.trainer_hook import PriorShaping
from torchrl_priors.transforms import PriorBonus, PriorLogProb

# deprecated by TorchRL, or, as classes, nothing that YAML has (their defaults are the constructors')
_SKIPPED = {"self", "actor", "critic", "advantage_key", "value_target_key", "value_key", "distribution_class"}


def nested_key(value: Any) -> NestedKey:
    """A key from YAML: a list of its parts, or a string."""
    if value is None or isinstance(value, str):
        return value
    parts = tuple(value)
    return parts[0] if len(parts) == 1 else parts


def _plain(name: str, value: Any) -> Any:
    """A setting from YAML as the constructors take it."""
    if name.endswith("_key") or name == "namespace":
        return nested_key(value)
    if name.endswith("_keys") and value is not None:
        return [nested_key(key) for key in value]
    if name == "clip_epsilon" and value is not None and not isinstance(value, (int, float)):
        return tuple(value)
    return value


def _settings(settings: dict[str, Any]) -> dict[str, Any]:
    return {name: _plain(name, value) for name, value in settings.items()}


def _maker(cls: Callable[..., Any]) -> Callable[..., Any]:
    """What builds an object of a class from YAML; a prior can be told its ``action_key`` too."""

    def make(action_key: Any = None, **settings: Any) -> Any:
        made = cls(**_settings(settings))
        if action_key is not None:
            made.set_keys(action=nested_key(action_key))
        return made

    return make


# What configs name as their targets.
make_action_prior = _maker(ActionPrior)
make_artifact_prior = _maker(load_prior)
make_boltzmann_prior = _maker(BoltzmannPrior)
make_uniform_prior = _maker(UniformPrior)
make_prior_weight = _maker(PriorWeight)
make_prior_log_prob = _maker(PriorLogProb)
make_prior_shaping = _maker(PriorShaping)


def make_prior_bonus(method: str | None = None, **settings: Any) -> PriorBonus:
    """What ``transform: prior_bonus`` builds; ``method`` stands for ``shift`` and ``relative``."""
    settings = _settings(settings)
    if method is None:
        return PriorBonus(**settings)
    for name in ("shift", "relative"):
        settings.pop(name, None)
    return PriorBonus.from_method(method, **settings)


def make_ae2r_loss(keys: Any = None, **settings: Any) -> AE2RLoss:
    """What ``loss: ae2r`` builds; ``keys`` are for ``set_keys``."""
    loss = AE2RLoss(**_settings(settings))
    loss.set_keys(**{name: nested_key(key) for name, key in (keys or {}).items()})
    return loss


def make_clip_ppo_prior_loss(
    actor_network: Any, critic_network: Any, prior_loss: Any, keys: Any = None, **settings: Any
) -> ClipPPOPriorLoss:
    """What ``loss: clip_ppo_prior`` builds; ``keys`` are for ``set_keys``.

    Two references to one network in YAML are two networks: ``prior_loss``, a config of ``loss: ae2r`` with ``_partial_:
    true``, is given this loss's student, and its critic where ``td_error: shaped``.
    """
    if isinstance(prior_loss, partial):
        shaped = prior_loss.keywords.get("td_error") == "shaped"
        prior_loss = prior_loss(actor_network=actor_network, **({"critic_network": critic_network} if shaped else {}))
    loss = ClipPPOPriorLoss(actor_network, critic_network, prior_loss, **_settings(settings))
    loss.set_keys(**{name: nested_key(key) for name, key in (keys or {}).items()})
    return loss


def _config(make: str, base: type, *sources: Callable[..., Any], without: tuple[str, ...] = (), **more: Any) -> type:
    """A config with the parameters of ``sources`` as fields, the later ones winning."""
    parameters: dict[str, Any] = {}
    skipped = _SKIPPED - {"actor"} if base is TransformConfig else _SKIPPED  # the transforms' actor is not deprecated
    for source in sources:
        of = source.__init__ if inspect.isclass(source) else source
        for name, parameter in inspect.signature(of).parameters.items():
            if parameter.kind not in (parameter.VAR_KEYWORD, parameter.VAR_POSITIONAL) and name not in skipped:
                parameters[name] = MISSING if parameter.default is parameter.empty else parameter.default
    for name in without:
        del parameters[name]
    fields = {**parameters, **more, "_target_": f"{__name__}.make_{make}", "_partial_": False}
    return make_dataclass(
        make.title().replace("_", "") + "Config",
        [(name, Any, field(default=value)) for name, value in fields.items()],
        bases=(base,),
        namespace={"__post_init__": lambda self: None, "__module__": __name__},
    )


def register() -> None:
    """Stores the configs beside TorchRL's own; see :func:`torchrl_priors.register_configs`."""
    store = ConfigStore.instance().store
    ppo, of_prior = (PPOLoss, ClipPPOLoss, ClipPPOPriorLoss), ("functional", "gamma")
    for group, name, node in (
        ("prior", "action", _config("action_prior", ConfigBase, ActionPrior, action_key=None)),
        ("prior", "artifact", _config("artifact_prior", ConfigBase, load_prior, action_key=None)),
        ("prior", "boltzmann", _config("boltzmann_prior", ConfigBase, BoltzmannPrior, action_key=None)),
        ("prior", "uniform", _config("uniform_prior", ConfigBase, UniformPrior, action_key=None)),
        ("model", "prior_weight", _config("prior_weight", ConfigBase, PriorWeight)),
        ("transform", "prior_log_prob", _config("prior_log_prob", TransformConfig, PriorLogProb)),
        ("transform", "prior_bonus", _config("prior_bonus", TransformConfig, PriorBonus, method=None)),
        ("loss", "ae2r", _config("ae2r_loss", LossConfig, AE2RLoss, keys=None)),
        ("loss", "clip_ppo_prior", _config("clip_ppo_prior_loss", LossConfig, *ppo, without=of_prior, keys=None)),
        ("hook", "prior_shaping", _config("prior_shaping", HookConfig, PriorShaping)),
    ):
        store(group=group, name=name, node=node, provider="torchrl_priors")
