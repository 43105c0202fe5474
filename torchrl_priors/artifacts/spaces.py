"""Whether a prior is one for the spaces of a student."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, TypeAlias

import torch
from tensordict import TensorDict
from torch import Tensor
from torch import distributions as d
from torchrl.data import Categorical, Composite, OneHot, TensorSpec

from torchrl_priors.artifacts.errors import ArtifactError
from torchrl_priors.priors.action_prior import ActionPrior, _action_shape

__all__ = ["check_spaces"]

Spec: TypeAlias = TensorSpec | Sequence[int] | int


def check_spaces(prior: ActionPrior, observation_spec: Spec, action_spec: Spec | None = None) -> None:
    """Asks a prior about one observation, and holds its distribution against the actions.

    Args:
        prior (ActionPrior): reads one key.
        observation_spec (TensorSpec, sequence of int or int): the observations, or the shape of one.
        action_spec (TensorSpec, sequence of int or int, optional): the actions, or the shape of one.

    Raises:
        ArtifactError: it can't read the observations, or advises on other actions.
        TypeError: a spec is one of several entries.
    """
    for spec in (observation_spec, action_spec):
        if isinstance(spec, Composite):
            raise TypeError(f"Pass the spec of one entry, not of several: {', '.join(map(str, spec.keys()))}.")
    if len(prior.in_keys) != 1:
        raise ArtifactError(f"it reads {prior.in_keys}, and observations of one key can be checked")
    observation = _zero(observation_spec)
    try:
        dist: Any = prior.get_dist(TensorDict({prior.in_keys[0]: observation.unsqueeze(0)}, [1]))
    except (IndexError, RuntimeError, TypeError, ValueError) as error:
        shape = tuple(observation.shape)
        raise ArtifactError(f"it can't read observations of shape {shape}, {observation.dtype}: {error}") from error
    if action_spec is None:
        return
    advised: tuple[int, ...] = tuple(_action_shape(dist)[1:])
    discrete = type(dist) is d.Categorical
    if isinstance(action_spec, Categorical) and not isinstance(action_spec, OneHot):
        fits = discrete and dist.logits.shape[-1] == action_spec.n
    elif isinstance(action_spec, TensorSpec):
        fits = not discrete and tuple(action_spec.shape[-1:]) == advised
    else:
        fits = advised == ((action_spec,) if isinstance(action_spec, int) else tuple(action_spec))
    if not fits:
        over = f"{dist.logits.shape[-1]} indices" if discrete else f"shape {advised}"
        raise ArtifactError(f"it advises on actions of {over}, and the student's are {action_spec}")


def _zero(spec: Spec) -> Tensor:
    if isinstance(spec, TensorSpec):
        return spec.zero()
    return torch.zeros((spec,) if isinstance(spec, int) else tuple(spec))
