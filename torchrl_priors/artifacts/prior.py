"""Priors as files: every kind whose parts are tensors."""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any, TypeVar

import torch
from tensordict import NestedKey
from tensordict.nn import TensorDictModule, TensorDictModuleBase
from tensordict.utils import unravel_key
from torch import Tensor, nn
from torch import distributions as d
from torchrl.data import Bounded, OneHot
from torchrl.modules import IndependentNormal, OneHotCategorical, TanhNormal

from torchrl_priors.artifacts.format import PRIOR, ArtifactError, PriorManifest, pack, write_atomically
from torchrl_priors.artifacts.network import build_network, describe_network
from torchrl_priors.lookup import StateTable
from torchrl_priors.priors import (
    ActionPrior,
    AffordancePrior,
    BoltzmannPrior,
    MixturePrior,
    ModulePrior,
    UniformPrior,
)
from torchrl_priors.priors.mixture import FixedWeights, distribution_class

__all__ = ["build_prior", "save_prior"]

Tensors = dict[str, Tensor]
_Prior = TypeVar("_Prior", bound=ActionPrior)
_DISTRIBUTIONS: dict[str, Any] = {
    "categorical": d.Categorical,
    "one_hot": OneHotCategorical,
    "normal": IndependentNormal,
    "tanh_normal": TanhNormal,
}


def save_prior(
    path: str | os.PathLike[str],
    prior: ActionPrior,
    *,
    env_id: str,
    evaluation: Mapping[str, Any] | None = None,
    training: Mapping[str, Any] | None = None,
) -> PriorManifest:
    """Writes a prior to one ``.safetensors`` file, whole or not at all; :func:`load_prior` reads it.

    Tables and networks of known layers go into a file, and so do mixtures of such priors. Code does not: a
    :class:`CallablePrior`, a function, a network with layers of its own. A policy of
    :func:`~torchrl_priors.networks.make_actor` is for :func:`save_policy`.

    Args:
        path (str or path): the file; its folder exists. A file of that name is replaced.
        prior (ActionPrior): a :class:`ModulePrior`, :class:`BoltzmannPrior`, :class:`AffordancePrior`,
            :class:`UniformPrior`, :class:`MixturePrior`, or what :func:`load_sb3_prior` gives.

    Keyword Args:
        env_id (str): the environment that it advises on, e.g. ``"HalfCheetah-v5"``.
        evaluation, training (mapping, optional): what JSON can hold: how good it is, where it is from.

    Returns:
        PriorManifest: what was written beside the tensors.

    Raises:
        TypeError: a part of the prior is code that no file can hold.
        FileNotFoundError: the folder does not exist.
        ValueError: a value is not finite, or JSON can't hold ``evaluation`` or ``training``.
        ImportError: safetensors is not installed.

    Examples:
        >>> import tempfile, pathlib
        >>> from torchrl_priors.artifacts import load_prior
        >>> path = pathlib.Path(tempfile.mkdtemp(), "affordances.safetensors")
        >>> prior = AffordancePrior(torch.tensor([[True, True, False], [False, True, True]]))
        >>> manifest = save_prior(path, prior, env_id="MyGrid-v0")
        >>> load_prior(path).out_keys
        [('prior', 'logits')]
    """
    if not isinstance(prior, ActionPrior):
        raise TypeError(f"save_prior writes ActionPriors, got {type(prior).__name__}.")
    tensors: Tensors = {}
    parts = _describe(prior, tensors, "prior.")
    tensors = {name: value.detach().cpu().contiguous().clone() for name, value in tensors.items()}
    try:
        values = {
            "env_id": env_id,
            "prior": parts,
            "evaluation": dict(evaluation or {}),
            "training": dict(training or {}),
        }
        values = json.loads(json.dumps(values, allow_nan=False))
        manifest = PriorManifest(**values)
        if not isinstance(env_id, str) or not env_id:
            raise ValueError(f"it must name its environment, got env_id={env_id!r}")
        build_prior(dict(tensors), manifest.prior)  # what can't be read again is not written
    except (TypeError, ValueError) as error:
        raise ValueError(f"This prior can't be saved: {error}") from error
    write_atomically(Path(path), pack(tensors, asdict(manifest), kind=PRIOR))
    return manifest


def build_prior(
    tensors: Tensors, parts: Any, *, in_key: NestedKey | None = None, namespace: NestedKey = "prior"
) -> ActionPrior:
    """The prior of a file, from all of its tensors.

    Raises:
        ArtifactError: the tensors are not those of its description.
    """
    left = dict(tensors)
    try:
        prior = _build(parts, left, "prior.", None, namespace)
        if in_key is not None and prior.in_keys != [in_key]:
            if len(prior.in_keys) != 1:
                raise ArtifactError(f"it reads {prior.in_keys}: in_key can't replace them")
            prior = _build(parts, dict(tensors), "prior.", in_key, namespace)
    except ArtifactError:
        raise
    except (ArithmeticError, LookupError, RecursionError, RuntimeError, TypeError, ValueError) as error:
        raise ArtifactError(f"its prior can't be built: {type(error).__name__}: {error}") from error
    if left:
        raise ArtifactError(f"its tensors are not those of its manifest; unexpected: {', '.join(sorted(left))}")
    return prior


# Each kind has a pair of functions: from a prior to JSON, putting its tensors under a prefix; and back, taking them.


def _describe(prior: ActionPrior, tensors: Tensors, prefix: str) -> dict[str, Any]:
    for name, (kind, describe, _) in _KINDS.items():
        if type(prior) is kind:
            return {"prior": name, **describe(prior, tensors, prefix)}
    raise TypeError(
        f"A file can hold priors of {', '.join(kind.__name__ for kind, *_ in _KINDS.values())}, and no code of others:"
        f" it can't hold a {type(prior).__name__}."
    )


def _build(parts: Any, left: Tensors, prefix: str, in_key: NestedKey | None, namespace: NestedKey) -> ActionPrior:
    if not isinstance(parts, dict) or not isinstance(parts.get("prior"), str) or parts["prior"] not in _KINDS:
        found = parts.get("prior") if isinstance(parts, dict) else parts
        raise ArtifactError(f"its kind of prior is unknown: {found!r}")
    options = {name: value for name, value in parts.items() if name != "prior"}
    return _KINDS[parts["prior"]][2](left, prefix, in_key, namespace, **options)


def _describe_module(prior: ModulePrior, tensors: Tensors, prefix: str) -> dict[str, Any]:
    first, last = prior.module
    params, kwargs = first.module, dict(last.distribution_kwargs)
    if params.std is not None:
        tensors[f"{prefix}std"] = params.std
    box = kwargs.keys() == {"low", "high"}
    if kwargs and not box:
        raise TypeError(f"A file can hold the distribution_kwargs low and high, got {', '.join(sorted(kwargs))}.")
    for name in kwargs:
        tensors[prefix + name] = torch.as_tensor(kwargs[name])
    return {
        "network": _put_network(params.network, tensors, f"{prefix}network."),
        "output": prior.output,
        "std": params.std is not None,
        "distribution": _distribution_name(prior),
        "box": box,
        "in_keys": _to_json(prior.in_keys),
    }


def _build_module(
    left: Tensors, prefix: str, in_key: NestedKey | None, namespace: NestedKey, **options: Any
) -> ModulePrior:
    network, output, std, distribution, box, keys = _take(
        options, "network", "output", "std", "distribution", "box", "in_keys"
    )
    bounds = {name: _pop(left, prefix + name) for name in ("low", "high")} if box else None
    if bounds is not None and not (bounds["low"] < bounds["high"]).all():
        raise ArtifactError("the lower bounds of its actions must be below the upper ones")
    return ModulePrior(
        build_network(network, _strip(left, f"{prefix}network.")),
        output,
        std=_pop(left, f"{prefix}std") if std else None,
        in_keys=_keys(keys, in_key),
        distribution_class=_distribution(distribution),
        distribution_kwargs=bounds,
        namespace=namespace,
    )


def _describe_values(prior: BoltzmannPrior, tensors: Tensors, prefix: str) -> dict[str, Any]:
    source, softmax, _ = prior.module
    return {
        "q": _put_source(source, tensors, f"{prefix}q."),
        "temperature": float(softmax.module.temperature),
        "distribution": _distribution_name(prior),
    }


def _build_values(
    left: Tensors, prefix: str, in_key: NestedKey | None, namespace: NestedKey, **options: Any
) -> BoltzmannPrior:
    q, temperature, distribution = _take(options, "q", "temperature", "distribution")
    values, in_keys = _take_source(q, left, f"{prefix}q.", in_key)
    return BoltzmannPrior(
        values, temperature, in_keys=in_keys, distribution_class=_distribution(distribution), namespace=namespace
    )


def _describe_affordances(prior: AffordancePrior, tensors: Tensors, prefix: str) -> dict[str, Any]:
    return {
        "weights": _put_source(prior.module[0], tensors, f"{prefix}weights."),
        "epsilon": prior.epsilon,
        "distribution": _distribution_name(prior),
    }


def _build_affordances(
    left: Tensors, prefix: str, in_key: NestedKey | None, namespace: NestedKey, **options: Any
) -> AffordancePrior:
    weights, epsilon, distribution = _take(options, "weights", "epsilon", "distribution")
    source, in_keys = _take_source(weights, left, f"{prefix}weights.", in_key)
    return AffordancePrior(
        source, epsilon, in_keys=in_keys, distribution_class=_distribution(distribution), namespace=namespace
    )


def _describe_uniform(prior: UniformPrior, tensors: Tensors, prefix: str) -> dict[str, Any]:
    constant = prior.module[0]
    for name in constant.out_keys:
        tensors[prefix + name] = getattr(constant, name)
    return {"over": "box" if "low" in constant.out_keys else _distribution_name(prior)}


def _build_uniform(
    left: Tensors, prefix: str, in_key: NestedKey | None, namespace: NestedKey, **options: Any
) -> UniformPrior:
    (over,) = _take(options, "over")
    if over == "box":
        low, high = _pop(left, f"{prefix}low"), _pop(left, f"{prefix}high")
        return UniformPrior(Bounded(low, high, shape=low.shape, dtype=low.dtype), namespace=namespace)
    logits = _pop(left, f"{prefix}logits")
    if logits.ndim != 1 or not logits.isfinite().all():  # a shape such as [0, 2**33] takes no bytes of the file
        raise ArtifactError(f"{prefix}logits must be finite and of one dimension")
    number = len(logits)
    return UniformPrior(OneHot(number) if _distribution(over) is OneHotCategorical else number, namespace=namespace)


def _describe_mixture(prior: MixturePrior, tensors: Tensors, prefix: str) -> dict[str, Any]:
    return {
        "priors": [_describe(part, tensors, f"{prefix}{number}.") for number, part in enumerate(prior.priors)],
        "weights": _put_source(prior.weights, tensors, f"{prefix}weights."),
    }


def _build_mixture(
    left: Tensors, prefix: str, in_key: NestedKey | None, namespace: NestedKey, **options: Any
) -> MixturePrior:
    priors, weights = _take(options, "priors", "weights")
    if not isinstance(priors, list):
        raise ArtifactError(f"a mixture must have a list of priors, got {priors!r}")
    built = [_build(part, left, f"{prefix}{number}.", in_key, "prior") for number, part in enumerate(priors)]
    source, in_keys = _take_source(weights, left, f"{prefix}weights.", in_key)
    return MixturePrior(built, source, in_keys=in_keys, namespace=namespace)


_KINDS: dict[str, tuple[type[ActionPrior], Callable[..., dict[str, Any]], Callable[..., ActionPrior]]] = {
    "module": (ModulePrior, _describe_module, _build_module),
    "boltzmann": (BoltzmannPrior, _describe_values, _build_values),
    "affordance": (AffordancePrior, _describe_affordances, _build_affordances),
    "uniform": (UniformPrior, _describe_uniform, _build_uniform),
    "mixture": (MixturePrior, _describe_mixture, _build_mixture),
}


# What the kinds are made of: networks, and tables or networks by state.


def _put_network(network: Any, tensors: Tensors, prefix: str) -> dict[str, Any]:
    if not isinstance(network, nn.Module):
        raise TypeError(f"A file can't hold code, such as the function {network!r}.")
    tensors |= {prefix + name: value for name, value in network.state_dict().items()}
    return describe_network(network)


def _put_source(source: TensorDictModuleBase, tensors: Tensors, prefix: str) -> dict[str, Any]:
    if type(source) is TensorDictModule:
        network = _put_network(source.module, tensors, f"{prefix}network.")
        return {"network": network, "in_keys": _to_json(source.in_keys)}
    if type(source) is StateTable:
        tensors[f"{prefix}table"] = source.table
        return {"in_keys": _to_json(source.in_keys)}
    if type(source) is FixedWeights:
        tensors[f"{prefix}table"] = source.values
        return {"in_keys": []}
    raise TypeError(f"A file can hold tables and plain networks by state, and no code of others: no {source}.")


def _take_source(
    parts: Any, left: Tensors, prefix: str, in_key: NestedKey | None
) -> tuple[Tensor | nn.Module, list[NestedKey] | None]:
    if not isinstance(parts, dict) or not {"in_keys"} <= parts.keys() <= {"in_keys", "network"}:
        raise ArtifactError(f"values by state must be a table or a network with its in_keys, got {parts!r}")
    keys = _keys(parts["in_keys"], in_key) if parts["in_keys"] != [] else None
    if "network" in parts:
        return build_network(parts["network"], _strip(left, f"{prefix}network.")), keys
    return _pop(left, f"{prefix}table"), keys


def _take(options: dict[str, Any], *names: str) -> tuple[Any, ...]:
    if options.keys() != set(names):
        raise ArtifactError(f"a prior of its kind has the entries {', '.join(names)}, got {', '.join(options)}")
    return tuple(options[name] for name in names)


def _strip(left: Tensors, prefix: str) -> Tensors:
    """Takes the tensors under a prefix."""
    return {name.removeprefix(prefix): left.pop(name) for name in list(left) if name.startswith(prefix)}


def _pop(left: Tensors, name: str) -> Tensor:
    if name not in left:
        raise ArtifactError(f"its tensors are not those of its manifest; missing: {name}")
    return left.pop(name)


def _distribution_name(prior: ActionPrior) -> str:
    kind = distribution_class(prior)
    for name, known in _DISTRIBUTIONS.items():
        if kind is known:
            return name
    raise TypeError(f"A file can hold distributions of kind {', '.join(_DISTRIBUTIONS)}, got {kind}.")


def _distribution(name: Any) -> Any:
    if not isinstance(name, str) or name not in _DISTRIBUTIONS:
        raise ArtifactError(f"its distribution is unknown: {name!r}")
    return _DISTRIBUTIONS[name]


def _to_json(keys: list[NestedKey]) -> list[list[str]]:
    return [[key] if isinstance(key, str) else list(key) for key in keys]


def _keys(values: Any, in_key: NestedKey | None) -> list[NestedKey]:
    if (
        not isinstance(values, list)
        or not values
        or not all(isinstance(key, list) and key and all(isinstance(part, str) for part in key) for key in values)
    ):
        raise ArtifactError(f"its in_keys must be lists of names, got {values!r}")
    return [unravel_key(tuple(key)) for key in values] if in_key is None else [in_key]
