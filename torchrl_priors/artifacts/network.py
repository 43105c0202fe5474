"""Networks of known layers as JSON and tensors."""

from __future__ import annotations

import sys
from collections.abc import Callable
from typing import Any

import torch
from tensordict.nn import AddStateIndependentNormalScale
from torch import Tensor, nn
from torchrl.modules import MLP

from torchrl_priors.artifacts.errors import ArtifactError, differing, short
from torchrl_priors.collectors.running_norm import RunningNorm
from torchrl_priors.networks import ACTIVATIONS, GaussianMLP
from torchrl_priors.priors.layers import (
    ClipToBox,
    GaussianHead,
    NatureCNN,
    ScaleToBox,
    StateIndependentStd,
    TeacherInput,
)

Parts = dict[str, Any]
_MAX_SIZES = 100  # of a tensor or a multilayer perceptron


def describe_network(network: nn.Module) -> Parts:
    """What kind of layers a network has, and their options: numbers as they are, a tensor by its shape."""
    kind = type(network)
    layers: Any = network._modules if kind in (nn.Sequential, MLP) else {}  # children() leaves repeated ones out
    if list(layers) != [str(number) for number in range(len(layers))]:
        raise TypeError(f"A file can hold a Sequential whose layers have no names, got {', '.join(layers)}.")
    if kind is MLP and not isinstance(network.out_features, int):
        raise TypeError(f"A file can't hold an MLP that reshapes its output: it has {network.out_features=}.")
    if kind in (nn.Sequential, MLP):
        return {"layer": "sequential", "layers": [describe_network(layer) for layer in layers.values()]}
    for name, (known, options) in _LAYERS.items():
        if kind is known:
            parts = {"layer": name, **{option: _to_json(getattr(network, option)) for option in options}}
            twin = _skeleton(parts)
            if _sizes(twin) == _sizes(network) and _shown(twin) == _shown(network):
                return parts
    raise TypeError(
        f"A file can hold networks of {', '.join(sorted(known.__name__ for known, _ in _LAYERS.values()))} in a"
        f" Sequential, in float32 and with the default options of PyTorch, and no code of others: it can't hold"
        f" {network}."
    )


def build_network(parts: Any, tensors: dict[str, Tensor], prefix: str = "") -> nn.Module:
    """A network from its description and its ``state_dict``, without drawing a random number.

    What does not fit, or is not finite, is an :class:`ArtifactError`; messages put ``prefix`` before a tensor's name.
    """
    if _count_layers(parts) > 4 * (len(tensors) + 8):  # else they would all be made before one is found to be missing
        raise ArtifactError("its network has more layers than its tensors could fill")
    network = _skeleton(parts)
    expected = _sizes(network)
    if tensors.keys() != expected.keys():
        names = differing(prefix + name for name in tensors.keys() ^ expected.keys())
        raise ArtifactError(f"its tensors are not those of its manifest; missing or unexpected: {names}")
    for name, (shape, dtype) in expected.items():
        value = tensors[name]
        if tuple(value.shape) != shape or value.dtype is not dtype:
            found = f"{value.dtype} of {tuple(value.shape)}"
            raise ArtifactError(f"{prefix}{name} must be {dtype} of shape {shape}, got {found}")
        if not value.isfinite().all():
            raise ArtifactError(f"{prefix}{name} is not finite: it has NaN or infinite entries")
    network.load_state_dict(tensors, assign=True)
    check_values(network)
    return network


def check_values(network: nn.Module) -> None:
    """Refuses finite numbers that make what is not finite: statistics, standard deviations and bounds of actions."""
    for layer in network.modules():
        if isinstance(layer, (ClipToBox, ScaleToBox)) and (layer.low > layer.high).any():
            raise ArtifactError("the lower bounds of its actions are above the upper ones")
        if isinstance(layer, (TeacherInput, RunningNorm)) and layer.var is not None and (layer.var < 0).any():
            raise ArtifactError("the statistics of its observations have a negative variance")
        if isinstance(layer, RunningNorm):
            if layer.count < 0:
                raise ArtifactError("the statistics of its observations have a negative count")
            if not all(value.isfinite().all() for value in layer.affine()):
                raise ArtifactError("the statistics of its observations overflow")
        if isinstance(layer, (StateIndependentStd, AddStateIndependentNormalScale)):
            for name, value in layer.named_parameters():
                if not _make_std(value):
                    raise ArtifactError(f"its standard deviations, the exponentials of {name}, overflow or vanish")


def _make_std(log_std: Tensor) -> bool:
    std = log_std.exp()
    return bool((std.isfinite() & (std > 0)).all())


def _sizes(network: nn.Module) -> dict[str, tuple[tuple[int, ...], torch.dtype]]:
    """Names, shapes and types of what a network's ``state_dict`` holds."""
    return {name: (tuple(value.shape), value.dtype) for name, value in network.state_dict().items()}


def _shown(network: nn.Module) -> str:
    """A layer and its options as PyTorch shows them, without how it uses memory."""
    return repr(network).replace("inplace=True", "")


def _to_json(value: Any) -> Any:
    if isinstance(value, Tensor):
        return list(value.shape)
    return [_to_json(item) for item in value] if isinstance(value, tuple) else value


def _count_layers(parts: Any) -> int:
    """How many layers a description stands for, those of its lists of sizes included."""
    number, waiting = 0, [parts]
    while waiting:
        part = waiting.pop()
        if isinstance(part, dict):
            waiting += [item for value in part.values() if isinstance(value, list) for item in value]
        number += 1
    return number


def _skeleton(parts: Any) -> nn.Module:
    """The network without memory for its parameters."""
    before = torch.get_default_dtype()
    try:
        torch.set_default_dtype(torch.float32)  # whatever the default of the process
        with torch.device("meta"):
            return _layer(parts)
    except ArtifactError:
        raise
    except (ArithmeticError, LookupError, RecursionError, RuntimeError, TypeError, ValueError) as error:
        raise ArtifactError(f"its network can't be built: {type(error).__name__}: {error}") from None
    finally:
        torch.set_default_dtype(before)


def _layer(parts: Any) -> nn.Module:
    if not isinstance(parts, dict):
        raise ArtifactError(f"a layer must be an object of JSON, got {short(parts)}")
    name, given = parts.get("layer"), {option: value for option, value in parts.items() if option != "layer"}
    if name == "sequential" and given.keys() == {"layers"} and isinstance(given["layers"], list):
        return nn.Sequential(*map(_layer, given["layers"]))
    if not isinstance(name, str) or name not in _LAYERS:
        raise ArtifactError(f"its layer is unknown: {short(name)}")
    kind, options = _LAYERS[name]
    if given.keys() != options.keys():
        raise ArtifactError(f"a layer {name!r} has the options {', '.join(options)}, got {', '.join(given)}")
    values = {}
    for option, read in options.items():
        try:
            values[option] = read(given[option])
        except _Expected as error:
            raise ArtifactError(f"{option} of a layer {name!r} must be {error}, got {short(given[option])}") from None
    return kind(**values)


class _Expected(Exception):
    """What an option should have been."""


def _count(value: Any) -> int:
    if type(value) is not int or not 1 <= value < 1 << 31:
        raise _Expected("a positive integer")
    return value


def _counts(value: Any) -> list[int]:
    if not isinstance(value, list) or len(value) > _MAX_SIZES:
        raise _Expected(f"a list of at most {_MAX_SIZES} sizes")
    return [_count(size) for size in value]


def _positive(value: Any) -> float:
    if type(value) not in (int, float) or not 0 < value <= sys.float_info.max:
        raise _Expected("a positive number")
    return value


def _flag(value: Any) -> bool:
    if type(value) is not bool:
        raise _Expected("true or false")
    return value


def _activation(value: Any) -> str:
    if not isinstance(value, str) or value not in ACTIVATIONS:
        raise _Expected(f"one of {', '.join(sorted(ACTIVATIONS))}")
    return value


def _tensor(value: Any) -> Tensor:
    return torch.zeros(_counts(value))


def _has_tensor(value: Any) -> bool:
    return value is not None and _tensor(value).ndim > 0


def _statistics(value: Any) -> tuple[Tensor, Tensor] | None:
    if value is not None and (not isinstance(value, list) or len(value) != 2):
        raise _Expected("null, or the shapes of a mean and a variance")
    return None if value is None else (_tensor(value[0]), _tensor(value[1]))


def _log_std_range(value: Any) -> tuple[float, float]:
    if (
        not isinstance(value, list)
        or len(value) != 2
        or not all(type(bound) in (int, float) for bound in value)
        or not value[0] <= value[1]
        or not _make_std(torch.tensor(value, dtype=torch.float32, device="cpu"))
    ):
        raise _Expected("a lower and an upper bound of the logarithm of a standard deviation")
    return value[0], value[1]


_LAYERS: dict[str, tuple[type[nn.Module], dict[str, Callable[[Any], Any]]]] = {
    "clip_to_box": (ClipToBox, {"low": _tensor, "high": _tensor}),
    "gaussian_head": (GaussianHead, {"features": _count, "act_dim": _count, "log_std_range": _log_std_range}),
    "gaussian_mlp": (GaussianMLP, {"obs_dim": _count, "act_dim": _count, "hidden": _counts, "activation": _activation}),
    "linear": (nn.Linear, {"in_features": _count, "out_features": _count, "bias": _has_tensor}),
    "nature_cnn": (NatureCNN, {"shape": _counts, "features": _count}),
    "running_norm": (RunningNorm, {"shape": _counts, "eps": _positive, "clip": _positive}),
    "scale_to_box": (ScaleToBox, {"low": _tensor, "high": _tensor}),
    "state_independent_std": (StateIndependentStd, {"log_std": _tensor}),
    "teacher_input": (
        TeacherInput,
        {
            "shape": _counts,
            "statistics": _statistics,
            "eps": _positive,
            "clip": _positive,
            "pixels": _flag,
            "flatten": _flag,
        },
    ),
    **{name: (kind, {}) for name, kind in ACTIVATIONS.items()},
}
"""By the name of a layer: its class, and for each of its arguments, which are its attributes too, how JSON is read."""
