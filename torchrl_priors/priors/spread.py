"""What a teacher that names one action leaves to the others, so that its log-probabilities are finite."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor


def smoothed_logits(weights: Tensor, epsilon: float) -> Tensor:
    r"""The log-probabilities :math:`\log[(1-\epsilon)\,w_a/\sum_b w_b + \epsilon/A]`, ``[*B, A]``.

    Where all weights are 0, nothing is known, and all actions are equally probable.

    Examples:
        >>> smoothed_logits(torch.tensor([1.0, 0.0, 1.0, 0.0]), 0.2).exp()
        tensor([0.4500, 0.0500, 0.4500, 0.0500])
    """
    weights = weights if weights.is_floating_point() else weights.to(torch.get_default_dtype())
    if not torch.compiler.is_compiling() and not (weights.isfinite() & (weights >= 0)).all():
        raise ValueError("Weights of actions must be finite and not negative.")
    total = weights.sum(-1, keepdim=True)
    uniform = torch.full_like(weights, 1 / weights.shape[-1])
    return torch.where(total > 0, (1 - epsilon) * weights / total + epsilon * uniform, uniform).log()


def check_epsilon(epsilon: float) -> float:
    """Refuses an ``epsilon`` outside of (0, 1]: with 0 some log-probabilities would be infinite."""
    if not 0 < epsilon <= 1:
        raise ValueError(f"epsilon is the probability of any action at random, in (0, 1], got {epsilon}.")
    return float(epsilon)


def as_std(std: float | Sequence[float] | Tensor) -> Tensor:
    """The spread around a continuous action as a tensor of its own, refused if it is not positive and finite."""
    value = torch.as_tensor(std, dtype=torch.get_default_dtype()).detach().clone()
    if value.ndim > 1 or not ((value > 0) & value.isfinite()).all():
        raise ValueError(f"std must be positive and finite, a number or one per dimension, got {value.tolist()}.")
    return value
