"""What the file of a prior says of it."""

from __future__ import annotations

from dataclasses import dataclass, field, fields
from typing import Any

from torchrl_priors.artifacts.errors import ArtifactError, short


@dataclass(frozen=True)
class PriorManifest:
    """What the file of a prior (:func:`~torchrl_priors.artifacts.save_prior`) says of it.

    Args:
        env_id (str): the environment that it advises on, e.g. ``"HalfCheetah-v5"``.
        prior (dict): its parts: kinds of priors, layers of networks, and their options.
        seed (int, optional): of its training.
        frames (int, optional): environment steps of its training.
        evaluation (dict): how good it is, e.g. ``{"mean_return": 1828.0, "episodes": 50}``.
        training (dict): where it is from, e.g. the configuration of the run.
    """

    env_id: str
    prior: dict[str, Any]
    seed: int | None = None
    frames: int | None = None
    evaluation: dict[str, Any] = field(default_factory=dict)
    training: dict[str, Any] = field(default_factory=dict)


def parse_manifest(values: Any) -> PriorManifest:
    """A manifest from JSON, checked entry by entry, but for ``prior``, which is checked when it is built."""
    names = sorted(item.name for item in fields(PriorManifest))
    if not isinstance(values, dict) or sorted(values) != names:
        raise ArtifactError(f"its manifest must have the entries {', '.join(names)}")
    env_id = values["env_id"]
    if not isinstance(env_id, str) or not env_id or not env_id.isprintable():  # messages show it
        raise ArtifactError(f"it must name its environment, got env_id={short(env_id)}")
    for name in ("seed", "frames"):
        value = values[name]
        if value is not None and (type(value) is not int or value < 0):
            raise ArtifactError(f"its {name} must be null or an integer of at least 0, got {short(value)}")
    for name in ("prior", "evaluation", "training"):
        if not isinstance(values[name], dict):
            raise ArtifactError(f"its {name} must be an object of JSON, got {short(values[name])}")
    return PriorManifest(**values)
