"""Losses that learn from soft action priors."""

from __future__ import annotations

from .ae2r import AE2RLoss
from .avec import AVECMixin, ValueOffset
from .compiled_step import CompiledStep
from .multi_teacher import MultiTeacherLoss
from .ppo import ClipPPOPriorLoss

__all__ = ["AE2RLoss", "AVECMixin", "ClipPPOPriorLoss", "CompiledStep", "MultiTeacherLoss", "ValueOffset"]
