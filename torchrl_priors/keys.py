"""Keys, settings and entries, as losses and transforms read them."""

from __future__ import annotations

from collections.abc import Iterable

import torch
from tensordict import NestedKey, TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from tensordict.utils import unravel_key
from torch import Tensor

__all__ = ["check_option", "next_step", "out_key", "read", "under_next"]

#: What to do about a batch without next observations.
NO_NEXT = (
    "the next step's observation is read, which environments write and NextStateReconstructor puts back where a"
    " collector left it out (compact_obs=True)"
)


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


def next_step(tensordict: TensorDictBase, keys: Iterable[NestedKey], terminated: Tensor) -> TensorDict:
    """What the next step holds under ``keys``, dense, and this step's entries where there is no next observation.

    Environments that reset themselves, and TorchRL's ``NextStateReconstructor``, leave NaN there at
    any end of a trajectory. This step's entry takes its place, as in TorchRL's ``GAE``;
    it always does after a termination, where nothing is made of the next state.

    Args:
        tensordict (TensorDictBase): a batch ``[*B]`` of any layout.
        keys (iterable of NestedKey): as at the root; those of entries that are computed at the next step may be there
            alone.
        terminated (Tensor): bool, ``[*B, 1]``.

    Raises:
        KeyError: the next step lacks an entry.
    """
    out = TensorDict({}, tensordict.batch_size, device=tensordict.device)
    for key in keys:
        value = read(tensordict, under_next(key), NO_NEXT)
        here = tensordict.get(key, None)
        if here is None or here.shape != value.shape:
            here = torch.zeros_like(value)
        mask = terminated.reshape(*terminated.shape[:-1], *[1] * (value.ndim - terminated.ndim + 1))
        out.set(key, torch.where(mask | value.isnan(), here, value))
    return out


def check_option(name: str, value: str, options: tuple[str, ...]) -> None:
    """Refuses a setting that is not one of those known.

    Raises:
        ValueError: names the setting, its value and what was expected.
    """
    if value not in options:
        raise ValueError(f"{name} must be one of {', '.join(map(repr, options))}, got {value!r}.")
