"""Networks of known layers as JSON and tensors."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor, nn
from torchrl.modules import MLP

from torchrl_priors.artifacts.errors import ArtifactError
from torchrl_priors.artifacts.manifest import Sizes, check_against
from torchrl_priors.networks import ACTIVATIONS
from torchrl_priors.priors.layers import GaussianHead, NatureCNN, ScaleToBox, StateIndependentStd, TeacherInput

__all__ = ["build_network", "check_values", "describe_network"]

Parts = dict[str, Any]


def describe_network(network: nn.Module) -> Parts:
    """What kind of layers a network has, and their sizes.

    Raises:
        TypeError: it has a layer that is not known; its code has no place in a file.

    Examples:
        >>> describe_network(nn.Sequential(nn.Linear(3, 4), nn.Tanh()))
        {'layer': 'sequential', 'layers': [{'layer': 'linear', 'sizes': [3, 4], 'bias': True}, {'layer': 'tanh'}]}
    """
    kind = type(network)
    if kind in (nn.Sequential, MLP):
        return {"layer": "sequential", "layers": [describe_network(layer) for layer in network.children()]}
    for name, (known, describe, _) in _LAYERS.items():
        if kind is known:
            parts = {"layer": name, **describe(network)}
            twin = _skeleton(parts)
            if sizes(twin) == sizes(network) and _options(twin) == _options(network):
                return parts
    raise TypeError(
        f"A file can hold networks of {', '.join(sorted(known.__name__ for known, *_ in _LAYERS.values()))} in a"
        f" Sequential, with the default options of PyTorch, and no code of others: it can't hold {network}."
    )


def sizes(network: nn.Module) -> Sizes:
    """Names, shapes and types of what a network's ``state_dict`` holds."""
    return {name: (tuple(value.shape), value.dtype) for name, value in network.state_dict().items()}


def _options(network: nn.Module) -> str:
    """The options of a layer as PyTorch shows them, without how it uses memory."""
    return repr(network).replace("inplace=True", "")


def build_network(parts: Any, tensors: dict[str, Tensor]) -> nn.Module:
    """A network from its description and all of its tensors. No random number is drawn.

    Raises:
        ArtifactError: they do not fit each other, a tensor is not finite, or see :func:`check_values`.
    """
    network = _skeleton(parts)
    check_against(tensors, sizes(network))
    network.load_state_dict(tensors, assign=True)
    check_values(network)
    return network


def check_values(network: nn.Module) -> None:
    """Refuses finite numbers that make what is not finite.

    Raises:
        ArtifactError: a variance of observations is negative, or a standard deviation overflows or vanishes.
    """
    for layer in network.modules():
        if isinstance(layer, TeacherInput) and layer.var is not None and (layer.var < 0).any():
            raise ArtifactError("the statistics of its observations have a negative variance")
        if isinstance(layer, StateIndependentStd) and not _make_std(layer.log_std):
            raise ArtifactError("its standard deviations, the exponentials of log_std, overflow or vanish")


def _make_std(log_std: Tensor) -> bool:
    std = log_std.exp()
    return bool((std.isfinite() & (std > 0)).all())


def _skeleton(parts: Any) -> nn.Module:
    """The network without memory for its parameters."""
    try:
        # float32, whatever the default of the process
        before = torch.get_default_dtype()
        torch.set_default_dtype(torch.float32)
        try:
            with torch.device("meta"):
                return _layer(parts)
        finally:
            torch.set_default_dtype(before)
    except ArtifactError:
        raise
    except (ArithmeticError, KeyError, LookupError, RecursionError, RuntimeError, TypeError, ValueError) as error:
        raise ArtifactError(f"its network can't be built: {type(error).__name__}: {error}") from None


def _layer(parts: Any) -> nn.Module:
    if not isinstance(parts, dict):
        raise ArtifactError(f"a layer must be an object of JSON, got {parts!r}")
    options = dict(parts)
    name = options.pop("layer", None)
    if name == "sequential" and options.keys() == {"layers"} and isinstance(options["layers"], list):
        return nn.Sequential(*map(_layer, options["layers"]))
    if not isinstance(name, str) or name not in _LAYERS:
        raise ArtifactError(f"its layer is unknown: {name!r}")
    return _LAYERS[name][2](**options)


def _counts(values: Any, number: int | None = None) -> list[int]:
    if (
        not isinstance(values, list)
        or (number is not None and len(values) != number)
        or not all(type(value) is int and 1 <= value < 1 << 31 for value in values)
    ):
        raise ArtifactError(f"sizes of a layer must be positive integers, got {values!r}")
    return values


def _positive(value: Any) -> float:
    if type(value) not in (int, float) or not 0 < value < float("inf"):
        raise ArtifactError(f"an option of a layer must be a positive number, got {value!r}")
    return float(value)


def _flag(value: Any) -> bool:
    if type(value) is not bool:
        raise ArtifactError(f"an option of a layer must be true or false, got {value!r}")
    return value


def _make_input(*, shape: Any, normalize: Any, eps: Any, clip: Any, pixels: Any, flatten: Any) -> TeacherInput:
    shape = _counts(shape)
    return TeacherInput(
        shape,
        statistics=(torch.zeros(shape), torch.zeros(shape)) if _flag(normalize) else None,
        eps=_positive(eps),
        clip=_positive(clip),
        pixels=_flag(pixels),
        flatten=_flag(flatten),
    )


def _make_linear(*, sizes: Any, bias: Any) -> nn.Linear:
    inputs, outputs = _counts(sizes, 2)
    return nn.Linear(inputs, outputs, bias=_flag(bias))


def _make_head(*, sizes: Any, log_std_range: Any) -> GaussianHead:
    if (
        not isinstance(log_std_range, list)
        or len(log_std_range) != 2
        or not all(type(bound) in (int, float) for bound in log_std_range)
        or not log_std_range[0] <= log_std_range[1]
        or not _make_std(torch.tensor(log_std_range, dtype=torch.float32, device="cpu"))
    ):
        raise ArtifactError(
            "log_std_range must be a lower and an upper bound of the logarithm of a standard deviation, got"
            f" {log_std_range!r}"
        )
    low, high = map(float, log_std_range)
    return GaussianHead(*_counts(sizes, 2), log_std_range=(low, high))


_LAYERS: dict[str, tuple[type[nn.Module], Callable[[Any], Parts], Callable[..., nn.Module]]] = {
    "linear": (
        nn.Linear,
        lambda layer: {"sizes": [layer.in_features, layer.out_features], "bias": layer.bias is not None},
        _make_linear,
    ),
    "teacher_input": (
        TeacherInput,
        lambda layer: {
            "shape": list(layer.shape),
            "normalize": layer.mean is not None,
            "eps": layer.eps,
            "clip": layer.clip,
            "pixels": layer.pixels,
            "flatten": layer.flatten,
        },
        _make_input,
    ),
    "nature_cnn": (
        NatureCNN,
        lambda layer: {"shape": list(layer.shape), "features": layer.features},
        lambda *, shape, features: NatureCNN(_counts(shape, 3), *_counts([features])),
    ),
    "state_independent_std": (
        StateIndependentStd,
        lambda layer: {"size": len(layer.log_std)},
        lambda *, size: StateIndependentStd(torch.zeros(_counts([size]))),
    ),
    "gaussian_head": (
        GaussianHead,
        lambda layer: {
            "sizes": [layer.mean.in_features, layer.mean.out_features],
            "log_std_range": list(layer.log_std_range),
        },
        _make_head,
    ),
    "scale_to_box": (
        ScaleToBox,
        lambda layer: {"size": len(layer.low)},
        lambda *, size: ScaleToBox(torch.zeros(_counts([size])), torch.zeros(_counts([size]))),
    ),
    **{name: (kind, lambda layer: {}, kind) for name, kind in ACTIVATIONS.items()},
}
