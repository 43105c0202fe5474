"""Priors as JSON and tensors: every kind whose parts are tensors."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from typing import Any

import torch
from tensordict import NestedKey
from torch import Tensor, nn
from torchrl.data import Bounded, OneHot
from torchrl.modules import OneHotCategorical

from torchrl_priors.artifacts.errors import ArtifactError, differing, short
from torchrl_priors.artifacts.prior_parts import (
    Parts,
    Scope,
    find_distribution,
    keys_from_json,
    keys_to_json,
    name_distribution,
    put_network,
    put_source,
    take_network,
    take_source,
)
from torchrl_priors.priors import AffordancePrior, BoltzmannPrior, MixturePrior, ModulePrior, Prior, UniformPrior


def describe_prior(prior: Prior) -> tuple[Parts, dict[str, Tensor]]:
    """The parts of a prior, for JSON, and its tensors by name; a part that is code is a ``TypeError``."""
    tensors: dict[str, Tensor] = {}
    parts = _describe(prior, Scope(tensors))
    return parts, {name: value.detach().cpu().contiguous().clone() for name, value in tensors.items()}


def build_prior(
    parts: Any, tensors: dict[str, Tensor], *, in_key: NestedKey | None = None, namespace: NestedKey = "prior"
) -> Prior:
    """The prior of a file, from its description and all of its tensors."""
    left = dict(tensors)
    try:
        prior = _build(parts, Scope(left), namespace)
    except ArtifactError:
        raise
    except (ArithmeticError, LookupError, RecursionError, RuntimeError, TypeError, ValueError) as error:
        raise ArtifactError(f"its prior can't be built: {type(error).__name__}: {error}") from None
    if left:
        raise ArtifactError(f"its tensors are not those of its manifest; unexpected: {differing(left)}")
    if in_key is None or prior.in_keys == [in_key]:
        return prior
    if len(prior.in_keys) != 1:
        raise ArtifactError(f"it reads {prior.in_keys}: in_key can't replace them")
    return build_prior(_read_instead(parts, keys_to_json([in_key])), tensors, namespace=namespace)


def _read_instead(parts: Any, keys: list[list[str]]) -> Any:
    """The same description with other ``in_keys``, wherever it has any."""
    if isinstance(parts, list):
        return [_read_instead(part, keys) for part in parts]
    if not isinstance(parts, dict):
        return parts
    return {name: keys if name == "in_keys" and part else _read_instead(part, keys) for name, part in parts.items()}


# Each kind has a pair of functions: from a prior to JSON, putting its tensors; and from JSON, whose entries are the
# names of the arguments, to what the class is called with.


def _describe(prior: Prior, scope: Scope) -> Parts:
    for name, (kind, describe, _) in _KINDS.items():
        if type(prior) is kind:
            return {"prior": name, **describe(prior, scope)}
    raise TypeError(
        f"A file can hold priors of {', '.join(kind.__name__ for kind, *_ in _KINDS.values())}, and no code of others:"
        f" it can't hold this {type(prior).__name__}. (policy_prior makes a ModulePrior of a policy of make_actor.)"
    )


def _build(parts: Any, scope: Scope, namespace: NestedKey = "prior") -> Prior:
    name = parts.get("prior") if isinstance(parts, dict) else parts
    if not isinstance(name, str) or name not in _KINDS:
        raise ArtifactError(f"its kind of prior is unknown: {short(name)}")
    kind, _, read = _KINDS[name]
    entries = {entry: value for entry, value in parts.items() if entry != "prior"}
    if entries.keys() != set(_ENTRIES[name]):
        raise ArtifactError(f"a prior {name!r} has the entries {', '.join(_ENTRIES[name])}, got {', '.join(entries)}")
    return kind(**read(scope, **entries), namespace=namespace)


def _describe_module(prior: ModulePrior, scope: Scope) -> Parts:
    first, last = prior.module
    params, kwargs = first.module, dict(last.distribution_kwargs)
    if params.std is not None:
        scope.put({"std": params.std})
    if kwargs and kwargs.keys() != {"low", "high"}:
        raise TypeError(f"A file can hold the distribution_kwargs low and high, got {', '.join(sorted(kwargs))}.")
    scope.put({name: torch.as_tensor(value) for name, value in kwargs.items()})
    return {
        "network": put_network(params.network, scope, prior.in_keys),
        "output": prior.output,
        "distribution": name_distribution(prior),
        "box": bool(kwargs),
        "in_keys": keys_to_json(prior.in_keys),
    }


def _read_module(scope: Scope, network: Any, output: Any, distribution: Any, box: Any, in_keys: Any) -> dict[str, Any]:
    if type(box) is not bool:
        raise ArtifactError(f"its box must be true or false, got {short(box)}")
    return {
        "module": take_network(network, scope),
        "output": output,
        "std": scope.take("std") if output == "mean" else None,
        "in_keys": keys_from_json(in_keys),
        "distribution_class": find_distribution(distribution),
        "distribution_kwargs": scope.take_bounds() if box else None,
    }


def _describe_values(prior: BoltzmannPrior, scope: Scope) -> Parts:
    source, softmax, _ = prior.module
    return {
        "q": put_source(source, scope.inside("q")),
        "temperature": float(softmax.module.temperature),
        "distribution": name_distribution(prior),
    }


def _read_values(scope: Scope, q: Any, temperature: Any, distribution: Any) -> dict[str, Any]:
    values, in_keys = take_source(q, scope.inside("q"))
    _check_temperature(temperature, values)
    return {
        "q": values,
        "temperature": temperature,
        "in_keys": in_keys,
        "distribution_class": find_distribution(distribution),
    }


def _check_temperature(temperature: Any, values: Tensor | nn.Module) -> None:
    """A finite number can still be 0 in float32, or make a finite action value infinite."""
    divisor = torch.tensor(float(temperature)) if type(temperature) in (int, float) else torch.tensor(0.0)
    if not 0 < divisor < torch.inf:
        raise ArtifactError(f"its temperature must be a positive number, got {short(temperature)}")
    if isinstance(values, Tensor) and ((values / divisor).isfinite() != values.isfinite()).any():
        raise ArtifactError(f"its action values overflow at temperature {temperature!r}")


def _describe_affordances(prior: AffordancePrior, scope: Scope) -> Parts:
    return {
        "weights": put_source(prior.module[0], scope.inside("weights")),
        "epsilon": prior.epsilon,
        "distribution": name_distribution(prior),
    }


def _read_affordances(scope: Scope, weights: Any, epsilon: Any, distribution: Any) -> dict[str, Any]:
    source, in_keys = take_source(weights, scope.inside("weights"))
    if type(epsilon) not in (int, float):
        raise ArtifactError(f"its epsilon must be a number, got {short(epsilon)}")
    return {
        "weights": source,
        "epsilon": epsilon,
        "in_keys": in_keys,
        "distribution_class": find_distribution(distribution),
    }


def _describe_uniform(prior: UniformPrior, scope: Scope) -> Parts:
    constant = prior.module[0]
    scope.put({name: getattr(constant, name) for name in constant.out_keys})
    return {"over": "box" if "low" in constant.out_keys else name_distribution(prior)}


def _read_uniform(scope: Scope, over: Any) -> dict[str, Any]:
    if over == "box":
        bounds = scope.take_bounds()
        return {"actions": Bounded(**bounds, shape=bounds["low"].shape, dtype=bounds["low"].dtype)}
    logits = scope.take("logits")
    if logits.ndim != 1 or not logits.isfinite().all():  # a shape such as [0, 2**33] takes no bytes of the file
        raise ArtifactError(
            f"{scope.prefix}logits must be finite and of one dimension, got shape {tuple(logits.shape)}"
        )
    return {"actions": OneHot(len(logits)) if find_distribution(over) is OneHotCategorical else len(logits)}


def _describe_mixture(prior: MixturePrior, scope: Scope) -> Parts:
    return {
        "priors": [_describe(part, scope.inside(number)) for number, part in enumerate(prior.priors)],
        "weights": put_source(prior.weights, scope.inside("weights")),
    }


def _read_mixture(scope: Scope, priors: Any, weights: Any) -> dict[str, Any]:
    if not isinstance(priors, list):
        raise ArtifactError(f"a mixture must have a list of priors, got {short(priors)}")
    source, in_keys = take_source(weights, scope.inside("weights"))
    return {
        "priors": [_build(part, scope.inside(number)) for number, part in enumerate(priors)],
        "weights": source,
        "in_keys": in_keys,
    }


_KINDS: dict[str, tuple[type[Prior], Callable[..., Parts], Callable[..., dict[str, Any]]]] = {
    "module": (ModulePrior, _describe_module, _read_module),
    "boltzmann": (BoltzmannPrior, _describe_values, _read_values),
    "affordance": (AffordancePrior, _describe_affordances, _read_affordances),
    "uniform": (UniformPrior, _describe_uniform, _read_uniform),
    "mixture": (MixturePrior, _describe_mixture, _read_mixture),
}
_ENTRIES = {name: list(inspect.signature(read).parameters)[1:] for name, (*_, read) in _KINDS.items()}
