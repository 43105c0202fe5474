"""Whether the advice of a prior is finite, and if not, whose fault it is."""

from __future__ import annotations

import torch
from torch import Tensor
from torch import distributions as d
from torch.compiler import is_compiling

__all__ = ["check_advice", "parameter_fault"]

#: The parameters that say of a distribution whether it can advise.
_PARAMETERS = ("logits", "loc", "scale", "scale_tril", "concentration1", "concentration0", "low", "high")


def check_advice(value: Tensor, prior_dist: d.Distribution, dist: d.Distribution | None = None) -> None:
    """Refuses log-probabilities or cross-entropies that are not finite. Compiled code does not look at data: no check.

    Args:
        value (Tensor): of any shape.
        prior_dist (torch.distributions.Distribution): the prior's.
        dist (torch.distributions.Distribution, optional): the student's. Defaults to ``None``: it is not at hand, for
            ``value`` is of actions that it took.

    Raises:
        ValueError: it names both distributions and the cause, the student's own NaN first.
    """
    if is_compiling():
        return
    finite = value.float().square().isfinite()  # what gradients and Adam make of it shall be finite, too
    if finite.all():
        return
    who = "what the student took" if dist is None else f"the student's {type(dist).__name__}"
    raise ValueError(
        f"The advice of the prior's {type(prior_dist).__name__} on {who} is not finite in"
        f" {int((~finite).sum())} of {value.numel()} steps: {_cause(prior_dist, dist)}."
    )


def parameter_fault(params: dict[str, Tensor]) -> str | None:
    """What is wrong with the parameters of a distribution, by name, in words, or ``None``."""
    for name, tensor in params.items():
        value = tensor.detach()
        if value.isnan().any():
            return f"{name} has NaN entries"
        if name == "logits":
            if value.isposinf().any() or value.isneginf().all(-1).any():
                return "logits are +inf for an action, or -inf for all actions of a state"
        elif name == "probs" and (value < 0).any():
            return f"probs are probabilities, got {float(value.min()):.3g} (are they logits?)"
        elif value.isinf().any():
            return f"{name} has infinite entries"
        if name == "scale" and not (value > 0).all():
            return f"scale is a standard deviation, got {float(value.min()):.3g} (is it a log-std?)"
    return None


def _cause(prior_dist: d.Distribution, dist: d.Distribution | None) -> str:
    """Why the advice is not finite."""
    for whose, other in (("student", dist), ("prior", prior_dist)):
        if other is not None and (fault := parameter_fault(_parameters(other))):
            return f"the {whose}'s {fault}"
    logits = _parameters(prior_dist).get("logits")
    if logits is not None and logits.isneginf().any():
        return (
            "the prior gives probability 0 to an action that the student takes. Mask the student as the prior is, or"
            " smooth the prior, as AffordancePrior(epsilon=...) does"
        )
    return "no parameter is, so the two are too far apart, or the prior's bounds are near. Smooth or widen the prior"


def _parameters(dist: d.Distribution) -> dict[str, Tensor]:
    while isinstance(dist, (d.Independent, d.MixtureSameFamily)):
        dist = dist.base_dist if isinstance(dist, d.Independent) else dist.component_distribution
    return {name: torch.as_tensor(getattr(dist, name)) for name in _PARAMETERS if hasattr(dist, name)}
