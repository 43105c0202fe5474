"""What the priors of files are made of: networks, and tables or networks by state, as JSON and tensors."""

from __future__ import annotations

from typing import Any

from tensordict import NestedKey
from tensordict.nn import TensorDictModule, TensorDictModuleBase
from tensordict.utils import unravel_key
from torch import Tensor, nn
from torch import distributions as d
from torchrl.modules import IndependentNormal, OneHotCategorical, TanhNormal

from torchrl_priors.artifacts.errors import ArtifactError
from torchrl_priors.artifacts.network import build_network, describe_network
from torchrl_priors.lookup import StateTable
from torchrl_priors.priors import Prior
from torchrl_priors.priors.mixture import FixedWeights

__all__ = [
    "Tensors",
    "find_distribution",
    "keys_from_json",
    "keys_to_json",
    "name_distribution",
    "put_network",
    "put_source",
    "take_bounds",
    "take_options",
    "take_source",
    "take_tensor",
    "take_tensors",
]

Tensors = dict[str, Tensor]
_DISTRIBUTIONS: dict[str, Any] = {
    "categorical": d.Categorical,
    "one_hot": OneHotCategorical,
    "normal": IndependentNormal,
    "tanh_normal": TanhNormal,
}


def put_network(network: Any, tensors: Tensors, prefix: str) -> dict[str, Any]:
    """Describes a network, and puts its tensors under a prefix.

    Raises:
        TypeError: it is code.
    """
    if not isinstance(network, nn.Module):
        raise TypeError(f"A file can't hold code, such as the function {network!r}.")
    tensors |= {prefix + name: value for name, value in network.state_dict().items()}
    return describe_network(network)


def put_source(source: TensorDictModuleBase, tensors: Tensors, prefix: str) -> dict[str, Any]:
    """Describes a table or a network, and puts its tensors under a prefix.

    Raises:
        TypeError: it is code.
    """
    if type(source) is TensorDictModule:
        network = put_network(source.module, tensors, f"{prefix}network.")
        return {"network": network, "in_keys": keys_to_json(source.in_keys)}
    if type(source) is StateTable:
        tensors[f"{prefix}table"] = source.table
        return {"in_keys": keys_to_json(source.in_keys)}
    if type(source) is FixedWeights:
        tensors[f"{prefix}table"] = source.values
        return {"in_keys": []}
    raise TypeError(f"A file can hold tables and plain networks by state, and no code of others: no {source}.")


def take_source(
    parts: Any, left: Tensors, prefix: str, in_key: NestedKey | None
) -> tuple[Tensor | nn.Module, list[NestedKey] | None]:
    """A table or a network from its description, and what it reads."""
    if not isinstance(parts, dict) or not {"in_keys"} <= parts.keys() <= {"in_keys", "network"}:
        raise ArtifactError(f"values by state must be a table or a network with its in_keys, got {parts!r}")
    keys = keys_from_json(parts["in_keys"], in_key) if parts["in_keys"] != [] else None
    if "network" in parts:
        return build_network(parts["network"], take_tensors(left, f"{prefix}network.")), keys
    return take_tensor(left, f"{prefix}table"), keys


def take_options(options: dict[str, Any], *names: str) -> tuple[Any, ...]:
    """The entries of a description, which has no others."""
    if options.keys() != set(names):
        raise ArtifactError(f"a prior of its kind has the entries {', '.join(names)}, got {', '.join(options)}")
    return tuple(options[name] for name in names)


def take_tensors(left: Tensors, prefix: str) -> Tensors:
    """Takes the tensors under a prefix."""
    return {name.removeprefix(prefix): left.pop(name) for name in list(left) if name.startswith(prefix)}


def take_tensor(left: Tensors, name: str) -> Tensor:
    """Takes one tensor."""
    if name not in left:
        raise ArtifactError(f"its tensors are not those of its manifest; missing: {name}")
    return left.pop(name)


def take_bounds(left: Tensors, prefix: str) -> dict[str, Tensor]:
    """The bounds of actions."""
    low, high = take_tensor(left, f"{prefix}low"), take_tensor(left, f"{prefix}high")
    if low.shape != high.shape or not (low.isfinite() & high.isfinite() & (low < high)).all():
        raise ArtifactError("the bounds of its actions must be finite, and the lower ones below the upper ones")
    return {"low": low, "high": high}


def name_distribution(prior: Prior) -> str:
    """What a file calls the distribution of a prior."""
    kind = prior.distribution_class
    for name, known in _DISTRIBUTIONS.items():
        if kind is known:
            return name
    raise TypeError(f"A file can hold distributions of kind {', '.join(_DISTRIBUTIONS)}, got {kind}.")


def find_distribution(name: Any) -> Any:
    """The distribution that a file names."""
    if not isinstance(name, str) or name not in _DISTRIBUTIONS:
        raise ArtifactError(f"its distribution is unknown: {name!r}")
    return _DISTRIBUTIONS[name]


def keys_to_json(keys: list[NestedKey]) -> list[list[str]]:
    """Keys as lists of names."""
    return [[key] if isinstance(key, str) else list(key) for key in keys]


def keys_from_json(values: Any, in_key: NestedKey | None) -> list[NestedKey]:
    """The keys that a file names, or the one to read instead."""
    if (
        not isinstance(values, list)
        or not values
        or not all(isinstance(key, list) and key and all(isinstance(part, str) for part in key) for key in values)
    ):
        raise ArtifactError(f"its in_keys must be lists of names, got {values!r}")
    return [unravel_key(tuple(key)) for key in values] if in_key is None else [in_key]
