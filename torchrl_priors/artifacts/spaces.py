"""Whether a prior is one for the spaces of a student."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, TypeAlias

import torch
from tensordict import TensorDict
from torch import Tensor
from torch import distributions as d
from torchrl.data import Bounded, Categorical, Composite, OneHot, TensorSpec
from torchrl.modules import TanhNormal

from torchrl_priors.artifacts.errors import ArtifactError, short
from torchrl_priors.distributions import TORCHRL_ONE_HOT, BoxUniform, action_shape
from torchrl_priors.priors import MixturePrior, Prior
from torchrl_priors.priors.layers import ClipToBox, ScaleToBox

Spec: TypeAlias = TensorSpec | Sequence[int] | int


def check_spaces(prior: Prior, observation_spec: Spec, action_spec: Spec | None = None) -> None:
    """Asks a prior about one observation, and holds its distribution against the actions.

    Instead of a spec the shape of an observation will do, and that of an action or the number of actions.
    """
    for spec in (observation_spec, action_spec):
        if isinstance(spec, Composite):
            raise TypeError(f"Pass the spec of one entry, not of several: {', '.join(map(str, spec.keys()))}.")
    if len(prior.in_keys) > 1:
        raise ArtifactError(f"it reads {prior.in_keys}, and observations of one key can be checked")
    observation = _zero(observation_spec)
    try:
        dist = prior.get_dist(TensorDict({key: observation.unsqueeze(0) for key in prior.in_keys}, [1]))
    except (IndexError, RuntimeError, TypeError, ValueError) as error:
        shape = tuple(observation.shape)
        raise ArtifactError(f"it can't read observations of shape {shape}, {observation.dtype}: {error}") from error
    if action_spec is not None:
        _check_actions(dist, action_spec)
        if isinstance(action_spec, Bounded):
            for bounds in _known_bounds(prior, dist):
                check_bounds(bounds, action_spec)


def _known_bounds(prior: Prior, dist: Any) -> list[tuple[Tensor, Tensor]]:
    """The bounds of a prior's actions, where they are known: of its distribution, or the last of its layers."""
    if isinstance(dist, TanhNormal):
        return [(torch.as_tensor(dist.low), torch.as_tensor(dist.high))]
    if isinstance(dist, BoxUniform):
        return [(dist.base_dist.low, dist.base_dist.high)]
    parts = prior.priors if isinstance(prior, MixturePrior) else [prior]
    boxes = [[layer for layer in part.modules() if isinstance(layer, (ClipToBox, ScaleToBox))] for part in parts]
    return [(layers[-1].low, layers[-1].high) for layers in boxes if layers]


def check_bounds(bounds: tuple[Tensor, Tensor], spec: Bounded) -> None:
    """Holds the bounds of a teacher's actions against the student's."""
    of_student = spec.space.low, spec.space.high
    for mine, student in zip(bounds, of_student, strict=True):
        mine, student = torch.broadcast_tensors(mine.to(student), student)
        known = (mine.abs() < torch.finfo(torch.float32).max) & student.isfinite()
        if not torch.allclose(mine[known], student[known], rtol=1e-4, atol=1e-6):
            low, high = (bound.flatten().tolist() for bound in bounds)
            to_low, to_high = (bound.flatten().tolist() for bound in of_student)
            raise ArtifactError(
                f"it acts within {short(low)} and {short(high)}, and the student within {short(to_low)} and"
                f" {short(to_high)}, as behind ActionScaling: load it without action_spec, and pass"
                " torchrl_priors.priors.RescaledPrior(prior, low, high, to_low=..., to_high=...)"
            )


def _check_actions(dist: Any, spec: Spec) -> None:
    """Holds a distribution against the actions, whose spec may have the batch of several environments in front."""
    advised: tuple[int, ...] = tuple(action_shape(dist)[len(dist.batch_shape) :])
    one_hot = isinstance(dist, TORCHRL_ONE_HOT)
    number = dist.logits.shape[-1] if type(dist) is d.Categorical else None  # of indices
    if isinstance(spec, int):
        fits = number == spec if number is not None else advised == (spec,)
    elif not isinstance(spec, TensorSpec):
        fits = advised == tuple(spec)
    elif type(spec) is Categorical:
        fits = number == spec.n
    elif type(spec) is OneHot:
        fits = one_hot and tuple(spec.shape[-1:]) == advised
    else:
        continuous = number is None and not one_hot and spec.dtype.is_floating_point
        fits = continuous and tuple(spec.shape[spec.ndim - len(advised) :]) == advised
    if not fits:
        over = f"{number} indices" if number is not None else f"shape {advised}{', one-hot' if one_hot else ''}"
        raise ArtifactError(f"it advises on actions of {over}, and the student's are {spec}")


def _zero(spec: Spec) -> Tensor:
    if isinstance(spec, TensorSpec):
        return spec.zero()
    return torch.zeros((spec,) if isinstance(spec, int) else tuple(spec))
