"""Soft action priors: one interface, :class:`ActionPrior`, and ready-made teachers."""

from torchrl_priors.priors.action_prior import ActionPrior
from torchrl_priors.priors.boltzmann import BoltzmannPrior
from torchrl_priors.priors.uniform import UniformPrior

__all__ = ["ActionPrior", "BoltzmannPrior", "UniformPrior"]
