"""Priors as files: every kind whose parts are tensors."""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

import torch
from tensordict import NestedKey
from torch import Tensor, nn
from torchrl.data import Bounded, OneHot
from torchrl.modules import OneHotCategorical

from torchrl_priors.artifacts.errors import ArtifactError, differing
from torchrl_priors.artifacts.format import PRIOR, pack, write_atomically
from torchrl_priors.artifacts.manifest import PriorManifest
from torchrl_priors.artifacts.network import build_network
from torchrl_priors.artifacts.prior_parts import (
    Tensors,
    find_distribution,
    keys_from_json,
    keys_to_json,
    name_distribution,
    put_network,
    put_source,
    take_bounds,
    take_options,
    take_source,
    take_tensor,
    take_tensors,
)
from torchrl_priors.priors import (
    AffordancePrior,
    BoltzmannPrior,
    MixturePrior,
    ModulePrior,
    Prior,
    UniformPrior,
)

__all__ = ["build_prior", "save_prior"]


def save_prior(
    path: str | os.PathLike[str],
    prior: Prior,
    *,
    env_id: str,
    evaluation: Mapping[str, Any] | None = None,
    training: Mapping[str, Any] | None = None,
) -> PriorManifest:
    """Writes a prior to one ``.safetensors`` file, whole or not at all; :func:`load_prior` reads it.

    Tables and networks of known layers go into a file, and so do mixtures of such priors. Code does not: a
    :class:`CallablePrior`, a function, a network with layers of its own. A policy of
    :func:`~torchrl_priors.networks.make_actor` is for :func:`save_policy`; what :func:`load_prior` makes of such a file
    can't be written again, in a mixture neither: keep the file, and mix what it gives.

    Args:
        path (str or path): the file; its folder exists. A file of that name is replaced.
        prior (Prior): a :class:`ModulePrior`, :class:`BoltzmannPrior`, :class:`AffordancePrior`,
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
    if not isinstance(prior, Prior):
        raise TypeError(f"save_prior writes priors, got {type(prior).__name__}.")
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
) -> Prior:
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
        raise ArtifactError(f"its prior can't be built: {type(error).__name__}: {error}") from None
    if left:
        raise ArtifactError(f"its tensors are not those of its manifest; unexpected: {differing(left)}")
    return prior


# Each kind has a pair of functions: from a prior to JSON, putting its tensors under a prefix; and back, taking them.


def _describe(prior: Prior, tensors: Tensors, prefix: str) -> dict[str, Any]:
    for name, (kind, describe, _) in _KINDS.items():
        if type(prior) is kind:
            return {"prior": name, **describe(prior, tensors, prefix)}
    raise TypeError(
        f"A file can hold priors of {', '.join(kind.__name__ for kind, *_ in _KINDS.values())}, and no code of others:"
        f" it can't hold this {type(prior).__name__}. (load_prior makes an ActionPrior of a file of save_policy: keep"
        " that file.)"
    )


def _build(parts: Any, left: Tensors, prefix: str, in_key: NestedKey | None, namespace: NestedKey) -> Prior:
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
        "network": put_network(params.network, tensors, f"{prefix}network."),
        "output": prior.output,
        "std": params.std is not None,
        "distribution": name_distribution(prior),
        "box": box,
        "in_keys": keys_to_json(prior.in_keys),
    }


def _build_module(
    left: Tensors, prefix: str, in_key: NestedKey | None, namespace: NestedKey, **options: Any
) -> ModulePrior:
    network, output, std, distribution, box, keys = take_options(
        options, "network", "output", "std", "distribution", "box", "in_keys"
    )
    bounds = take_bounds(left, prefix) if box else None
    return ModulePrior(
        build_network(network, take_tensors(left, f"{prefix}network.")),
        output,
        std=take_tensor(left, f"{prefix}std") if std else None,
        in_keys=keys_from_json(keys, in_key),
        distribution_class=find_distribution(distribution),
        distribution_kwargs=bounds,
        namespace=namespace,
    )


def _describe_values(prior: BoltzmannPrior, tensors: Tensors, prefix: str) -> dict[str, Any]:
    source, softmax, _ = prior.module
    return {
        "q": put_source(source, tensors, f"{prefix}q."),
        "temperature": float(softmax.module.temperature),
        "distribution": name_distribution(prior),
    }


def _build_values(
    left: Tensors, prefix: str, in_key: NestedKey | None, namespace: NestedKey, **options: Any
) -> BoltzmannPrior:
    q, temperature, distribution = take_options(options, "q", "temperature", "distribution")
    values, in_keys = take_source(q, left, f"{prefix}q.", in_key)
    _check_temperature(temperature, values)
    return BoltzmannPrior(
        values, temperature, in_keys=in_keys, distribution_class=find_distribution(distribution), namespace=namespace
    )


def _check_temperature(temperature: Any, values: Tensor | nn.Module) -> None:
    """A finite number can still be 0 in float32, or make a finite action value infinite."""
    divisor = torch.tensor(float(temperature)) if type(temperature) in (int, float) else torch.tensor(0.0)
    if not 0 < divisor < torch.inf:
        raise ArtifactError(f"its temperature must be a positive number, got {temperature!r}")
    if isinstance(values, Tensor) and ((values / divisor).isfinite() != values.isfinite()).any():
        raise ArtifactError(f"its action values overflow at temperature {temperature!r}")


def _describe_affordances(prior: AffordancePrior, tensors: Tensors, prefix: str) -> dict[str, Any]:
    return {
        "weights": put_source(prior.module[0], tensors, f"{prefix}weights."),
        "epsilon": prior.epsilon,
        "distribution": name_distribution(prior),
    }


def _build_affordances(
    left: Tensors, prefix: str, in_key: NestedKey | None, namespace: NestedKey, **options: Any
) -> AffordancePrior:
    weights, epsilon, distribution = take_options(options, "weights", "epsilon", "distribution")
    source, in_keys = take_source(weights, left, f"{prefix}weights.", in_key)
    return AffordancePrior(
        source, epsilon, in_keys=in_keys, distribution_class=find_distribution(distribution), namespace=namespace
    )


def _describe_uniform(prior: UniformPrior, tensors: Tensors, prefix: str) -> dict[str, Any]:
    constant = prior.module[0]
    for name in constant.out_keys:
        tensors[prefix + name] = getattr(constant, name)
    return {"over": "box" if "low" in constant.out_keys else name_distribution(prior)}


def _build_uniform(
    left: Tensors, prefix: str, in_key: NestedKey | None, namespace: NestedKey, **options: Any
) -> UniformPrior:
    (over,) = take_options(options, "over")
    if over == "box":
        low = (bounds := take_bounds(left, prefix))["low"]
        return UniformPrior(Bounded(**bounds, shape=low.shape, dtype=low.dtype), namespace=namespace)
    logits = take_tensor(left, f"{prefix}logits")
    if logits.ndim != 1 or not logits.isfinite().all():  # a shape such as [0, 2**33] takes no bytes of the file
        raise ArtifactError(f"{prefix}logits must be finite and of one dimension, got shape {tuple(logits.shape)}")
    number = len(logits)
    return UniformPrior(OneHot(number) if find_distribution(over) is OneHotCategorical else number, namespace=namespace)


def _describe_mixture(prior: MixturePrior, tensors: Tensors, prefix: str) -> dict[str, Any]:
    return {
        "priors": [_describe(part, tensors, f"{prefix}{number}.") for number, part in enumerate(prior.priors)],
        "weights": put_source(prior.weights, tensors, f"{prefix}weights."),
    }


def _build_mixture(
    left: Tensors, prefix: str, in_key: NestedKey | None, namespace: NestedKey, **options: Any
) -> MixturePrior:
    priors, weights = take_options(options, "priors", "weights")
    if not isinstance(priors, list):
        raise ArtifactError(f"a mixture must have a list of priors, got {priors!r}")
    built = [_build(part, left, f"{prefix}{number}.", in_key, "prior") for number, part in enumerate(priors)]
    source, in_keys = take_source(weights, left, f"{prefix}weights.", in_key)
    return MixturePrior(built, source, in_keys=in_keys, namespace=namespace)


_KINDS: dict[str, tuple[type[Prior], Callable[..., dict[str, Any]], Callable[..., Prior]]] = {
    "module": (ModulePrior, _describe_module, _build_module),
    "boltzmann": (BoltzmannPrior, _describe_values, _build_values),
    "affordance": (AffordancePrior, _describe_affordances, _build_affordances),
    "uniform": (UniformPrior, _describe_uniform, _build_uniform),
    "mixture": (MixturePrior, _describe_mixture, _build_mixture),
}
