"""Losses that learn from soft action priors."""

from __future__ import annotations

from .ae2r import AE2RLoss
from .avec import AVECMixin, ValueOffset
from .compiled_step import CompiledStep
from .cross_entropy import cross_entropy, has_analytic_cross_entropy, kl_divergence
from .multi_teacher import MultiTeacherLoss
from .ppo import ClipPPOPriorLoss

__all__ = [
    "AE2RLoss",
    "AVECMixin",
    "ClipPPOPriorLoss",
    "CompiledStep",
    "MultiTeacherLoss",
    "ValueOffset",
    "cross_entropy",
    "has_analytic_cross_entropy",
    "kl_divergence",
]
