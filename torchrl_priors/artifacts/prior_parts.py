"""What the priors of files are made of: tensors, tables or networks by state, distributions and keys, as JSON."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from tensordict import NestedKey
from tensordict.nn import TensorDictModule, TensorDictModuleBase
from tensordict.utils import unravel_key
from torch import Tensor, nn
from torch import distributions as d
from torchrl.modules import IndependentNormal, OneHotCategorical, TanhNormal

from torchrl_priors.artifacts.errors import ArtifactError, short
from torchrl_priors.artifacts.network import build_network, describe_network
from torchrl_priors.priors import Prior
from torchrl_priors.state_table import Constant, StateTable

Parts = dict[str, Any]
_DISTRIBUTIONS: dict[str, Any] = {
    "categorical": d.Categorical,
    "one_hot": OneHotCategorical,
    "normal": IndependentNormal,
    "tanh_normal": TanhNormal,
}


class Scope:
    """The tensors of one part of a prior, whose names in the file begin with the part's.

    It fills the dictionary of all tensors of a file to write it, and empties it to read it.
    """

    def __init__(self, tensors: dict[str, Tensor], prefix: str = "prior.") -> None:
        self.tensors, self.prefix = tensors, prefix

    def inside(self, name: object) -> Scope:
        """The tensors of a part of this part."""
        return Scope(self.tensors, f"{self.prefix}{name}.")

    def put(self, tensors: Mapping[str, Tensor]) -> None:
        """Puts tensors by name."""
        self.tensors.update({self.prefix + name: value for name, value in tensors.items()})

    def take(self, name: str) -> Tensor:
        """Takes one tensor."""
        if self.prefix + name not in self.tensors:
            raise ArtifactError(f"its tensors are not those of its manifest; missing: {self.prefix}{name}")
        return self.tensors.pop(self.prefix + name)

    def take_all(self) -> dict[str, Tensor]:
        """Takes all that are left."""
        names = [name for name in self.tensors if name.startswith(self.prefix)]
        return {name.removeprefix(self.prefix): self.tensors.pop(name) for name in names}

    def take_bounds(self) -> dict[str, Tensor]:
        """Takes the bounds of actions."""
        low, high = self.take("low"), self.take("high")
        if low.shape != high.shape or not (low.isfinite() & high.isfinite() & (low < high)).all():
            raise ArtifactError(
                f"the bounds of its actions, {self.prefix}low and high, must be finite, and the lower ones below the"
                " upper ones"
            )
        return {"low": low, "high": high}


def put_network(network: Any, scope: Scope, in_keys: Sequence[NestedKey]) -> Parts:
    """Describes a network of one input, and puts its tensors."""
    if len(in_keys) != 1:
        raise TypeError(f"A file can hold networks that read one entry, got in_keys={list(in_keys)}.")
    if not isinstance(network, nn.Module):
        raise TypeError(f"A file can't hold code, such as the function {network!r}.")
    scope.inside("network").put(network.state_dict())
    return describe_network(network)


def take_network(parts: Any, scope: Scope) -> nn.Module:
    """A network from its description."""
    inside = scope.inside("network")
    return build_network(parts, inside.take_all(), inside.prefix)


def put_source(source: TensorDictModuleBase, scope: Scope) -> Parts:
    """Describes a table or a network, and puts its tensors."""
    if type(source) is TensorDictModule:
        return {"network": put_network(source.module, scope, source.in_keys), "in_keys": keys_to_json(source.in_keys)}
    if type(source) in (StateTable, Constant):
        scope.put({"table": source.table if isinstance(source, StateTable) else source.weights})
        return {"in_keys": keys_to_json(source.in_keys)}
    raise TypeError(f"A file can hold tables and plain networks by state, and no code of others: no {source}.")


def take_source(parts: Any, scope: Scope) -> tuple[Tensor | nn.Module, list[NestedKey] | None]:
    """A table or a network from its description, and what it reads, if anything."""
    if not isinstance(parts, dict) or not {"in_keys"} <= parts.keys() <= {"in_keys", "network"}:
        raise ArtifactError(f"values by state must be a table or a network with its in_keys, got {short(parts)}")
    source = take_network(parts["network"], scope) if "network" in parts else scope.take("table")
    fixed = isinstance(source, Tensor) and source.ndim == 1 and parts["in_keys"] == []
    return source, None if fixed else keys_from_json(parts["in_keys"])


def name_distribution(prior: Prior) -> str:
    """What a file calls the distribution of a prior."""
    for name, known in _DISTRIBUTIONS.items():
        if prior.distribution_class is known:
            return name
    kinds = ", ".join(_DISTRIBUTIONS)
    raise TypeError(f"A file can hold distributions of kind {kinds}, got {prior.distribution_class}.")


def find_distribution(name: Any) -> Any:
    """The distribution that a file names."""
    if not isinstance(name, str) or name not in _DISTRIBUTIONS:
        raise ArtifactError(f"its distribution is unknown: {short(name)}, expected one of {', '.join(_DISTRIBUTIONS)}")
    return _DISTRIBUTIONS[name]


def keys_to_json(keys: list[NestedKey]) -> list[list[str]]:
    """Keys as lists of names."""
    return [[key] if isinstance(key, str) else list(key) for key in keys]


def keys_from_json(values: Any) -> list[NestedKey]:
    """The keys that a file names."""
    if (
        not isinstance(values, list)
        or not values
        or not all(isinstance(key, list) and key and all(isinstance(part, str) for part in key) for key in values)
    ):
        raise ArtifactError(f"its in_keys must be lists of names, got {short(values)}")
    return [unravel_key(tuple(key)) for key in values]
