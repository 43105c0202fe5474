"""Counter-based random numbers: row ``i`` of a batch draws from its own stream, whatever else is in the batch.

A :class:`torch.Generator` hands out numbers in the order of the tensor: a run's draws would depend on its neighbours.
Philox4x32-10 (Salmon et al., "Parallel Random Numbers: As Easy as 1, 2, 3", 2011) is a pure function of a key and a
counter instead: it needs no state, gives the same numbers on every device, and fuses into a compiled step. PyTorch has
the same generator in ``torch.func._random``, but (as of 2.13) private and without a CPU kernel.
"""

from __future__ import annotations

import zlib

import torch
from torch import Tensor

__all__ = ["derive_key", "philox", "uniform"]

_MASK = 0xFFFFFFFF
# The multipliers are odd 32-bit numbers above 2**31; minus 2**32 they keep every product inside int64.
_M0, _M1 = 0xD2511F53 - (1 << 32), 0xCD9E8D57 - (1 << 32)
_W0, _W1 = 0x9E3779B9, 0xBB67AE85


def _mulhilo(multiplier: int, x: Tensor) -> tuple[Tensor, Tensor]:
    """High and low 32 bits of (multiplier + 2**32) * x, for 0 <= x < 2**32."""
    product = x * multiplier
    return ((product >> 32) + x) & _MASK, product & _MASK


def philox(
    key: Tensor, counter: tuple[Tensor | int, Tensor | int], rounds: int = 10
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Philox4x32: four 32-bit words for a 64-bit key and the two low words of the counter.

    Args:
        key (Tensor): int64, ``[*B]``; all 64 bits count.
        counter (tuple of two Tensors or ints): words 0 and 1 of the counter, each in ``[0, 2**32)``; they broadcast
            with ``key``.
        rounds (int): 10 in the published generator.

    Returns:
        four Tensors: int64 words in ``[0, 2**32)``, ``[*B]``.

    Examples:
        >>> words = philox(torch.tensor(0), (0, 0))  # the authors' known-answer test
        >>> [f"{word.item():08x}" for word in words]
        ['6627e8d5', 'e169c58d', 'bc57ac4c', '9b00dbd8']
    """
    k0, k1 = key & _MASK, (key >> 32) & _MASK
    zero = torch.zeros_like(key)
    c0, c1, c2, c3 = zero + counter[0], zero + counter[1], zero, zero
    for _ in range(rounds):
        hi0, lo0 = _mulhilo(_M0, c0)
        hi1, lo1 = _mulhilo(_M1, c2)
        c0, c1, c2, c3 = hi1 ^ c1 ^ k0, lo1, hi0 ^ c3 ^ k1, lo0
        k0, k1 = (k0 + _W0) & _MASK, (k1 + _W1) & _MASK
    return c0, c1, c2, c3


def uniform(key: Tensor, step: Tensor | int, stream: Tensor | int = 0) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Four independent uniform numbers in [0, 1) per key, float32 with 24 random bits.

    Args:
        key (Tensor): int64, ``[*B]``, see :func:`derive_key`.
        step (Tensor or int): the counter; another step gives other numbers.
        stream (Tensor or int): a second counter, for draws of another kind at the same step.

    Examples:
        >>> a, b, c, d = uniform(derive_key(0, "docs"), 7)
        >>> bool(0 <= a < 1), bool(a == uniform(derive_key(0, "docs"), 7)[0])
        (True, True)
    """
    first, second, third, fourth = ((word >> 8).to(torch.float32) * 2.0**-24 for word in philox(key, (step, stream)))
    return first, second, third, fourth


def derive_key(seed: int | Tensor, *path: int | str | Tensor) -> Tensor:
    """The key of a run, from a seed and what names the run (numbers and words), independent of any order of runs.

    Args:
        seed (int or Tensor): the seed, int64.
        path (int, str or Tensor): what tells this stream from others, e.g. a world's index and a method's name. Numbers
            are at least 0; tensors broadcast.

    Returns:
        Tensor: int64 keys of the broadcast shape.

    Examples:
        >>> derive_key(1, torch.arange(3), "ae2r").shape
        torch.Size([3])
        >>> bool(derive_key(1, 2, "er") == derive_key(1, 2, "aer"))
        False
    """
    key = torch.as_tensor(seed, dtype=torch.int64)
    for part in path:
        # A word is its checksum as a number below 0, so that it is never one of the numbers.
        number = zlib.crc32(part.encode()) - (1 << 32) if isinstance(part, str) else part
        number = torch.as_tensor(number, dtype=torch.int64, device=key.device)
        w0, w1, _, _ = philox(key, (number & _MASK, (number >> 32) & _MASK))
        key = w0 | (w1 << 32)
    return key
