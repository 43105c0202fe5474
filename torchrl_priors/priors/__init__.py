"""Soft action priors: one interface, :class:`Prior`, and ready-made teachers."""

from torchrl_priors.priors.action_prior import ActionPrior
from torchrl_priors.priors.affordance import AffordancePrior
from torchrl_priors.priors.boltzmann import BoltzmannPrior
from torchrl_priors.priors.callable import CallablePrior
from torchrl_priors.priors.mixture import MixturePrior
from torchrl_priors.priors.module import ModulePrior
from torchrl_priors.priors.policy import policy_prior
from torchrl_priors.priors.prior import Prior
from torchrl_priors.priors.rescale import RescaledPrior
from torchrl_priors.priors.uniform import UniformPrior

__all__ = [
    "ActionPrior",
    "AffordancePrior",
    "BoltzmannPrior",
    "CallablePrior",
    "MixturePrior",
    "ModulePrior",
    "Prior",
    "RescaledPrior",
    "UniformPrior",
    "policy_prior",
]
