"""Soft action priors for TorchRL: learn from a teacher that may be wrong."""

from torchrl_priors.artifacts import load_prior, load_sb3_prior, save_prior
from torchrl_priors.degradation import RandomDegradation, StructuralDegradation
from torchrl_priors.episode_returns import Plateau
from torchrl_priors.objectives import AE2RLoss, AVECMixin, ClipPPOPriorLoss, MultiTeacherLoss, ValueOffset
from torchrl_priors.prior_weight import PriorWeight
from torchrl_priors.priors import (
    ActionPrior,
    AffordancePrior,
    BoltzmannPrior,
    CallablePrior,
    MixturePrior,
    ModulePrior,
    Prior,
    UniformPrior,
    policy_prior,
)
from torchrl_priors.teacher_trial import TeacherTrial
from torchrl_priors.trainer_hook import PriorShaping
from torchrl_priors.transforms import PriorBonus, PriorLogProb, prior_transforms

__all__ = [
    "AE2RLoss",
    "AVECMixin",
    "ActionPrior",
    "AffordancePrior",
    "BoltzmannPrior",
    "CallablePrior",
    "ClipPPOPriorLoss",
    "MixturePrior",
    "ModulePrior",
    "MultiTeacherLoss",
    "Plateau",
    "Prior",
    "PriorBonus",
    "PriorLogProb",
    "PriorShaping",
    "PriorWeight",
    "RandomDegradation",
    "StructuralDegradation",
    "TeacherTrial",
    "UniformPrior",
    "ValueOffset",
    "load_prior",
    "load_sb3_prior",
    "policy_prior",
    "prior_transforms",
    "register_configs",
    "save_prior",
]


def register_configs() -> None:
    """Adds this library to TorchRL's Hydra config groups, so that a YAML file can name it beside TorchRL's own.

    ``transform``: ``prior_log_prob``, ``prior_bonus``. ``loss``: ``ae2r``, ``clip_ppo_prior``. ``model``:
    ``prior_weight``. ``hook``: ``prior_shaping``, which gives a trainer both transforms. ``prior``, a group of this
    library: ``action``, ``artifact``, ``boltzmann``, ``uniform``. Call it before Hydra composes a config; more than
    once does no harm. TorchRL's own configs are registered too.

    Raises:
        ImportError: Hydra is not installed.

    Examples:
        >>> import torchrl_priors
        >>> torchrl_priors.register_configs()  # doctest: +SKIP
        >>> # defaults: [transform: prior_bonus, loss: clip_ppo_prior, _self_]
    """
    from torchrl_priors.configs import register

    register()
