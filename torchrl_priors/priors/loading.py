"""What happens to a teacher when the state of something around it is loaded."""

from __future__ import annotations

import itertools
import warnings
from typing import Any

import torch
from torch import Tensor, nn

__all__ = ["warn_of_another_teacher"]


def warn_of_another_teacher(module: nn.Module, state_dict: dict[str, Any], prefix: str, *_: Any) -> None:
    """A pre-hook of ``load_state_dict`` for what holds a ``prior``: it warns if the state has another teacher's."""
    prior: Any = getattr(module, "prior", None)
    if not isinstance(prior, nn.Module):
        return
    for name, value in itertools.chain(prior.named_parameters(), prior.named_buffers()):
        other = state_dict.get(f"{prefix}prior.{name}")
        if isinstance(other, Tensor) and other.shape == value.shape and not torch.equal(other.to(value), value):
            warnings.warn(
                f"load_state_dict gives {type(module).__name__} another teacher: {prefix}prior.{name} differs from that"
                " of the prior that it was made with. Make it with the teacher of the checkpoint.",
                stacklevel=4,
            )
            return
