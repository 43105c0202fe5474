"""Dense Gaussian networks computed by NumPy, where that is faster than their modules and gives the same."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import numpy as np
import torch
from tensordict.nn import AddStateIndependentNormalScale
from torch import Tensor, nn
from torchrl.modules import MLP

from torchrl_priors.networks import ACTIVATIONS, GaussianMLP

_ONE_THREAD = 2**18  # multiplications of a matrix product up to which OpenBLAS keeps to one thread


class DenseGaussian:
    """A small dense network with a state-independent scale, computed by NumPy on memory that stays.

    The parameters are used where they are. NumPy's calls take a third of the time of PyTorch's, on such small matrices;
    larger ones, which its matrix product would spread over threads, are refused by :meth:`prepare`.

    ``layers`` are linear ones, each with the activation that follows it, if one does. ``scale`` is the last layer.
    """

    loc: Tensor
    scale: Tensor

    def __init__(
        self, layers: list[tuple[nn.Linear, nn.Module | None]], scale_layer: AddStateIndependentNormalScale
    ) -> None:
        self._layers = layers
        self._scale_layer = scale_layer
        self._steps: list[tuple[np.ndarray, np.ndarray, np.ndarray, Callable[..., object] | None]] = []
        self._source: Tensor | None = None
        self._input = np.empty(0)

    @classmethod
    def of(cls, module: nn.Module) -> DenseGaussian | None:
        """That of a module; None if there is more to it."""
        found = _layers(module)
        if not found or not isinstance(scale_layer := found.pop(), AddStateIndependentNormalScale):
            return None
        layers: list[tuple[nn.Linear, nn.Module | None]] = []
        for layer in found:
            if isinstance(layer, nn.Linear):
                layers.append((layer, None))
            elif type(layer) in ACTIVATIONS.values() and layers and layers[-1][1] is None:
                layers[-1] = (layers[-1][0], layer)
            else:
                return None
        plain = all(layer.weight.dtype == torch.float32 and layer.weight.device.type == "cpu" for layer, _ in layers)
        return cls(layers, scale_layer) if layers and plain else None

    def prepare(self, observation: Tensor) -> bool:
        """Takes memory for observations ``[N, features]`` such as this one; False if they are others, or too many."""
        if observation.ndim != 2 or observation.dtype != torch.float32:
            return False
        rows = len(observation)
        if any(rows * layer.in_features * layer.out_features > _ONE_THREAD for layer, _ in self._layers):
            return False
        for layer, activation in self._layers:
            self.loc = torch.empty(rows, layer.out_features)
            bias = torch.zeros(layer.out_features) if layer.bias is None else layer.bias.detach()
            function = None if activation is None else _in_place(activation, self.loc)
            self._steps.append((layer.weight.detach().t().numpy(), bias.numpy(), self.loc.numpy(), function))
        self.scale = self._scale_layer(self.loc)[1].contiguous()
        return True

    def __call__(self, observation: Tensor) -> None:
        """Writes the mean at observations ``[N, features]`` into ``loc``."""
        if observation is not self._source:
            self._source, self._input = observation, observation.numpy()
        x = self._input
        for weight, bias, out, function in self._steps:
            np.matmul(x, weight, out=out)
            np.add(out, bias, out=out)
            if function is not None:
                function(out, out=out)
            x = out


def _in_place(activation: nn.Module, tensor: Tensor) -> Callable[..., object]:
    """What applies an activation to the memory of a tensor, called as a ufunc on its array."""
    if type(activation) is nn.Tanh:
        return np.tanh
    if type(activation) is nn.ReLU:
        return partial(np.maximum, np.float32(0))
    return lambda array, out: tensor.copy_(activation.forward(tensor))


def _layers(module: nn.Module) -> list[nn.Module] | None:
    """The layers of a dense network, one after the other; None if a module may do more than its class says."""
    if has_hooks(module) or "forward" in vars(module):
        return None
    if type(module) is GaussianMLP:
        children: list[nn.Module] = [module.mean, module.scale]
    elif isinstance(module, nn.Sequential) and type(module) in (nn.Sequential, MLP):
        if getattr(module, "_reshape_out", False):
            return None
        children = list(module)
    else:
        plain = (nn.Linear, AddStateIndependentNormalScale, *ACTIVATIONS.values())
        return [module] if type(module) in plain else None
    layers: list[nn.Module] = []
    for child in children:
        found = _layers(child)
        if found is None:
            return None
        layers += found
    return layers


def has_hooks(module: nn.Module) -> bool:
    """Whether calling a module does more than its ``forward``."""
    return bool(module._forward_hooks or module._forward_pre_hooks)
