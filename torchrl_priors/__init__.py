"""Soft action priors for TorchRL: learn from a teacher that may be wrong."""

from torchrl_priors.degradation import RandomDegradation, StructuralDegradation
from torchrl_priors.envs import GridWorldEnv, GridWorlds, sample_worlds
from torchrl_priors.methods import METHODS, MethodSpec, get_method
from torchrl_priors.metrics import (
    area_ratio,
    area_under_curve,
    iqm,
    mean_confidence_interval,
    performance_profile,
    probability_of_improvement,
    stratified_bootstrap_ci,
)
from torchrl_priors.objectives import (
    AE2RLoss,
    AVECMixin,
    ClipPPOPriorLoss,
    MultiTeacherLoss,
    ValueOffset,
    cross_entropy,
)
from torchrl_priors.prior_weight import PriorWeight
from torchrl_priors.priors import (
    ActionPrior,
    AffordancePrior,
    BoltzmannPrior,
    CallablePrior,
    MixturePrior,
    ModulePrior,
    UniformPrior,
)
from torchrl_priors.transforms import PriorBonus, PriorLogProb, multi_teacher_transforms

__all__ = [
    "METHODS",
    "AE2RLoss",
    "AVECMixin",
    "ActionPrior",
    "AffordancePrior",
    "BoltzmannPrior",
    "CallablePrior",
    "ClipPPOPriorLoss",
    "GridWorldEnv",
    "GridWorlds",
    "MethodSpec",
    "MixturePrior",
    "ModulePrior",
    "MultiTeacherLoss",
    "PriorBonus",
    "PriorLogProb",
    "PriorWeight",
    "RandomDegradation",
    "StructuralDegradation",
    "UniformPrior",
    "ValueOffset",
    "area_ratio",
    "area_under_curve",
    "cross_entropy",
    "get_method",
    "iqm",
    "mean_confidence_interval",
    "multi_teacher_transforms",
    "performance_profile",
    "probability_of_improvement",
    "sample_worlds",
    "stratified_bootstrap_ci",
]
