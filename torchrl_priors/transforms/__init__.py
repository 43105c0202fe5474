"""Transforms of batches of trajectories: the prior's log-probabilities, and the reward bonus that is made of them."""

from torchrl_priors.transforms.of_loss import prior_transforms
from torchrl_priors.transforms.prior_bonus import PriorBonus
from torchrl_priors.transforms.prior_log_prob import PriorLogProb

__all__ = ["PriorBonus", "PriorLogProb", "prior_transforms"]
