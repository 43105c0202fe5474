"""A loss whose networks may be functional, shared with another loss, or absent."""

from __future__ import annotations

import contextlib

from tensordict import NestedKey, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor
from torchrl.objectives import LossModule


class NetworksLoss(LossModule):
    """Keeps networks by name, each with its parameters under ``name_params``, as TorchRL's losses do.

    Keyword Args:
        functional (bool): whether the networks are functionalised.
    """

    def __init__(self, *, functional: bool) -> None:
        self._functional = functional
        super().__init__()

    @property
    def functional(self) -> bool:
        """Whether the networks are functionalised."""
        return self._functional

    def set_network(
        self, name: str, network: TensorDictModuleBase | None, apart_from: list[Tensor] | None = None
    ) -> None:
        """Keeps a network, or none. Of ``apart_from`` it reads the values, without a gradient, if functionalised."""
        # one without parameters is used as it is: what it learns, in buffers, must reach it also after a move
        if network is not None and self._functional and any(True for _ in network.parameters()):
            self.convert_to_functional(network, name, compare_against=apart_from)
        else:
            setattr(self, name, network)
            setattr(self, f"{name}_params", None)

    def _forward_value_estimator_keys(self, **kwargs: object) -> None:
        pass  # there is no value estimator

    def params_of(self, name: str) -> contextlib.AbstractContextManager:
        """A context in which a network has the parameters of this loss."""
        params = getattr(self, f"{name}_params")
        if params is None:
            return contextlib.nullcontext()
        return params.to_module(getattr(self, name), preserve_module_state=False)

    def evaluate(self, name: str, tensordict: TensorDictBase, key: NestedKey) -> Tensor:
        """What a network writes under a key, at the states of ``tensordict``, which stays as it is."""
        network = getattr(self, name)
        with self.params_of(name):
            value = network(tensordict.select(*network.in_keys, strict=False)).get(key, None)
        if value is None:
            raise KeyError(f"The {name} writes {network.out_keys}, but no {key!r}: set_keys says where to find it.")
        return value

    def reset(self, *names: str) -> None:
        """Draws the parameters of these networks anew, where they are there and have any."""
        for name in names:
            network = getattr(self, name)
            if network is not None and any(True for _ in network.parameters()):
                self._reset_module_parameters(name, network)
