"""What losses and transforms need to read a batch: keys of the next step, masks, and checks of shapes and settings."""

from __future__ import annotations

import torch
from tensordict import NestedKey, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from tensordict.utils import unravel_key
from torch import Tensor

from torchrl_priors.functional import prior_weight_loss

__all__ = ["check_option", "keep_where", "out_key", "under_next", "weight_regression"]


def under_next(key: NestedKey) -> NestedKey:
    """The key of the same entry of the next step."""
    return unravel_key(("next", key))


def keep_where(mask: Tensor, tensordict: TensorDictBase) -> TensorDictBase:
    """The entries where ``mask`` ``[*B, 1]`` is true, and 0 elsewhere."""
    mask = mask.squeeze(-1)
    return tensordict.apply(
        lambda value: torch.where(mask[(...,) + (None,) * (value.ndim - mask.ndim)], value, torch.zeros_like(value))
    )


def weight_regression(target: Tensor, weight: Tensor, signal: Tensor) -> Tensor:
    """The prior weight's loss, refusing shapes that would broadcast to an outer product over the batch."""
    if not target.shape == weight.shape == signal.shape:
        raise ValueError(
            "The target of the prior weight, the weight and the log-probabilities of the prior must have one shape"
            f" [*B, 1], got {tuple(target.shape)}, {tuple(weight.shape)} and {tuple(signal.shape)}."
        )
    return prior_weight_loss(target, weight, signal)


def out_key(network: TensorDictModuleBase, default: NestedKey) -> NestedKey:
    """Where a network writes its result: the default if it is one of its keys, else the last of them."""
    return default if default in network.out_keys else network.out_keys[-1]


def check_option(name: str, value: str, options: tuple[str, ...]) -> None:
    """Refuses a setting that is not one of those known."""
    if value not in options:
        raise ValueError(f"{name} must be one of {', '.join(map(repr, options))}, got {value!r}.")
