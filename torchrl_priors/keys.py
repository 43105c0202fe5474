"""Keys, settings and entries, as losses and transforms read them."""

from __future__ import annotations

import torch
from tensordict import NestedKey, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from tensordict.utils import unravel_key
from torch import Tensor

__all__ = ["check_option", "keep_where", "out_key", "read", "under_next"]


def under_next(key: NestedKey) -> NestedKey:
    """The key of the same entry of the next step."""
    return unravel_key(("next", key))


def out_key(network: TensorDictModuleBase, default: NestedKey) -> NestedKey:
    """Where a network writes its result: the default if it is one of its keys, else the last of them."""
    return default if default in network.out_keys else network.out_keys[-1]


def read(tensordict: TensorDictBase, key: NestedKey, hint: str) -> Tensor:
    """An entry of a batch.

    Raises:
        KeyError: it is missing; the message ends with ``hint``.
    """
    value = tensordict.get(key, None)
    if value is None:
        raise KeyError(f"The batch has no {key!r}: {hint}.")
    return value


def keep_where(mask: Tensor, tensordict: TensorDictBase) -> TensorDictBase:
    """The entries where ``mask`` ``[*B, 1]`` is true, and 0 elsewhere."""
    mask = mask.squeeze(-1)
    return tensordict.apply(
        lambda value: torch.where(mask[(...,) + (None,) * (value.ndim - mask.ndim)], value, torch.zeros_like(value))
    )


def check_option(name: str, value: str, options: tuple[str, ...]) -> None:
    """Refuses a setting that is not one of those known.

    Raises:
        ValueError: names the setting, its value and what was expected.
    """
    if value not in options:
        raise ValueError(f"{name} must be one of {', '.join(map(repr, options))}, got {value!r}.")
