"""What losses and transforms share: keys and entries of batches, and checks of what they are given."""

from __future__ import annotations

import itertools
import warnings
from collections.abc import Iterable
from typing import Any

import torch
from tensordict import NestedKey, TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from tensordict.utils import expand_as_right, unravel_key
from torch import Tensor, nn
from torch import distributions as d
from torch.compiler import is_compiling

#: What to do about a batch without next observations.
NO_NEXT = (
    "the next step's observation is read, which environments write and NextStateReconstructor puts back where a"
    " collector left it out (compact_obs=True)"
)
#: The parameters that say of a distribution whether it can advise.
_PARAMETERS = ("logits", "loc", "scale", "scale_tril", "concentration1", "concentration0", "low", "high")


def under_next(key: NestedKey) -> NestedKey:
    """The key of the same entry of the next step."""
    return unravel_key(("next", key))


def out_key(network: TensorDictModuleBase, default: NestedKey) -> NestedKey:
    """Where a network writes its result: the default if it is one of its keys, else the last of them."""
    return default if default in network.out_keys else network.out_keys[-1]


def read(tensordict: TensorDictBase, key: NestedKey, hint: str) -> Tensor:
    """An entry of a batch; where it is missing, the message ends with the hint."""
    value = tensordict.get(key, None)
    if value is None:
        raise KeyError(f"The batch has no {key!r}: {hint}.")
    return value


def next_step(
    tensordict: TensorDictBase, keys: Iterable[NestedKey], terminated: Tensor, done: Tensor | None = None
) -> TensorDict:
    """What the next step holds under ``keys``, dense, and this step's entries where there is no next observation.

    Environments that reset themselves, and TorchRL's ``NextStateReconstructor``, leave NaN there at
    any end of a trajectory, and ``AutoResetTransform`` -1 or, of types without a sign, 0. This step's entry takes its
    place, as in TorchRL's ``GAE``; it always does after a termination, where nothing is made of the next state. Entries
    that are computed at the next step may be there alone.
    """
    done = tensordict.get(under_next("done"), None) if done is None else done
    done = terminated if done is None or done.shape != terminated.shape else done
    dims = terminated.ndim - 1  # of the batch
    out = TensorDict({}, tensordict.batch_size, device=tensordict.device)
    for key in keys:
        value = read(tensordict, under_next(key), NO_NEXT)
        here = tensordict.get(key, None)
        if here is None or here.shape != value.shape:
            here = torch.zeros_like(value)
        shape = (*terminated.shape[:-1], *[1] * (value.ndim - dims))
        if value.is_floating_point():
            absent = value.isnan()
        else:
            absent = value == (-1 if value.dtype.is_signed else 0)
            absent = absent.flatten(dims).all(-1) if value.ndim > dims else absent
            absent = absent.reshape(shape) & done.reshape(shape)
        out.set(key, torch.where(terminated.reshape(shape) | absent, here, value))
    return out


def without_padding(tensordict: TensorDictBase, keys: Iterable[NestedKey], mask: Tensor) -> TensorDictBase:
    """A batch ``[*B]`` with the entries of its first valid step where ``mask`` is false: they can be scored.

    What is computed there is dropped later. Left as they are, the zeros or NaN of padding may be out of bounds, or
    spoil gradients though their loss is not used.
    """
    first = mask.reshape(-1).int().argmax().reshape(1)
    out = tensordict.copy()
    for key in keys:
        value = tensordict.get(key, None)
        if value is not None:
            fill = value.flatten(0, mask.ndim - 1).index_select(0, first).squeeze(0)
            out.set(key, torch.where(expand_as_right(mask, value), value, fill))
    return out


def check_option(name: str, value: str, options: tuple[str, ...]) -> None:
    """Refuses a setting that is not one of those known."""
    if value not in options:
        raise ValueError(f"{name} must be one of {', '.join(map(repr, options))}, got {value!r}.")


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


def check_advice(value: Tensor, prior_dist: d.Distribution, dist: d.Distribution | None = None) -> None:
    """Refuses log-probabilities or cross-entropies that are not finite. Compiled code does not look at data: no check.

    The message names both distributions and the cause, the student's own NaN first. The student's is not at hand where
    the value is of actions that it took.
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
