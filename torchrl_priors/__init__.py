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
from torchrl_priors.objectives import AE2RLoss, AVECMixin, ClipPPOPriorLoss, ValueOffset, cross_entropy
from torchrl_priors.prior_weight import PriorWeight
from torchrl_priors.priors import ActionPrior, BoltzmannPrior, UniformPrior
from torchrl_priors.schedules import CoeffScheduler, CosineSchedule, LinearSchedule, PiecewiseSchedule
from torchrl_priors.transforms import PriorBonus, PriorLogProb

__all__ = [
    "METHODS",
    "AE2RLoss",
    "AVECMixin",
    "ActionPrior",
    "BoltzmannPrior",
    "ClipPPOPriorLoss",
    "CoeffScheduler",
    "CosineSchedule",
    "GridWorldEnv",
    "GridWorlds",
    "LinearSchedule",
    "MethodSpec",
    "PiecewiseSchedule",
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
    "performance_profile",
    "probability_of_improvement",
    "sample_worlds",
    "stratified_bootstrap_ci",
]
