"""One call of a policy per step of a vector of environments, without the overhead of tensordicts where possible."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager

import torch
from tensordict import NestedKey, TensorDict, TensorDictBase
from tensordict.nn import (
    AddStateIndependentNormalScale,
    ProbabilisticTensorDictModule,
    ProbabilisticTensorDictSequential,
    TensorDictModule,
    TensorDictModuleBase,
    TensorDictSequential,
)
from torch import Tensor, nn
from torchrl.envs.utils import ExplorationType, set_exploration_type
from torchrl.modules import MLP, IndependentNormal, SafeModule, SafeProbabilisticModule

from torchrl_priors.networks import ACTIVATIONS, GaussianMLP

__all__ = ["GaussianStep", "ModuleStep", "PolicyStep", "policy_step"]

_CHUNK = 256  # steps whose noise is drawn at once


class PolicyStep(ABC):
    """Runs a policy step by step, with random numbers of its own.

    Within :meth:`session`, each call maps the observations of one step to what the policy writes, the action among it.
    :meth:`complete` adds to a whole batch what need not be computed step by step.
    """

    def __init__(self, policy: TensorDictModuleBase, action_key: NestedKey) -> None:
        self.policy = policy
        self.action_key = action_key

    @contextmanager
    @abstractmethod
    def session(self, generator: torch.Generator, deterministic: bool) -> Iterator[None]:
        """Draws from ``generator``, and leaves it behind where the last draw ended."""
        yield

    @abstractmethod
    def __call__(self, inputs: dict[NestedKey, Tensor]) -> dict[NestedKey, Tensor]:
        """What the policy writes for the observations of one step, by key, each ``[N, ...]``.

        The next call of a session may write the same tensors again; then it returns the same dict.
        """

    @abstractmethod
    def complete(self, batch: TensorDictBase) -> None:
        """Adds the remaining entries of the policy to a batch ``[N, T]``."""


class ModuleStep(PolicyStep):
    """Any policy: a tensordict a step. PyTorch's global random state is exchanged for the generator's meanwhile."""

    @contextmanager
    def session(self, generator: torch.Generator, deterministic: bool) -> Iterator[None]:
        """See :class:`PolicyStep`."""
        mode = ExplorationType.DETERMINISTIC if deterministic else ExplorationType.RANDOM
        cuda = generator.device.type == "cuda"
        devices = [generator.device.index or 0] if cuda else []
        with torch.random.fork_rng(devices=devices), torch.no_grad(), set_exploration_type(mode):
            if cuda:
                torch.cuda.set_rng_state(generator.get_state(), generator.device)
            else:
                torch.set_rng_state(generator.get_state())
            yield
            generator.set_state(torch.cuda.get_rng_state(generator.device) if cuda else torch.get_rng_state())

    def __call__(self, inputs: dict[NestedKey, Tensor]) -> dict[NestedKey, Tensor]:
        """See :class:`PolicyStep`."""
        first = next(iter(inputs.values()))
        # a copy: the policy may keep what it is given, and the buffers of the observations are written again
        tensordict = TensorDict({key: value.clone() for key, value in inputs.items()}, first.shape[:1], first.device)
        tensordict = self.policy(tensordict)
        return {key: tensordict.get(key) for key in self.policy.out_keys if key not in inputs}

    def complete(self, batch: TensorDictBase) -> None:
        """Nothing is left to do."""


class GaussianStep(PolicyStep):
    """A diagonal Gaussian policy made of plain modules: they are called directly, on tensors.

    The noise is drawn for many steps at once, and the log-probabilities are computed for a whole batch: both give what
    the policy itself would give, with other random numbers. Of a dense network, with the same standard deviation in
    every state, on the CPU, not even the modules are called.
    """

    def __init__(
        self,
        policy: ProbabilisticTensorDictSequential,
        action_key: NestedKey,
        body: Sequence[TensorDictModule],
        head: ProbabilisticTensorDictModule,
    ) -> None:
        super().__init__(policy, action_key)
        self._body = [(module.module, tuple(module.in_keys), tuple(module.out_keys)) for module in body]
        self._head = head
        self._loc, self._scale = (key for key in head.in_keys)
        self._generator: torch.Generator | None = None
        self._noise: Iterator[Tensor] = iter(())
        self._deterministic = False
        self._dense: _DenseGaussian | None = None
        self._outputs: dict[NestedKey, Tensor] = {}  # of a session, written again in each step

    @contextmanager
    def session(self, generator: torch.Generator, deterministic: bool) -> Iterator[None]:
        """See :class:`PolicyStep`."""
        self._generator, self._noise, self._deterministic = generator, iter(()), deterministic
        self._dense = self._find_dense() if generator.device.type == "cpu" else None  # parameters and hooks may change
        self._outputs = {}
        with torch.no_grad():
            yield

    def _find_dense(self) -> _DenseGaussian | None:
        (module, in_keys, out_keys), *more = self._body
        if more or len(in_keys) != 1 or out_keys != (self._loc, self._scale):
            return None
        return _DenseGaussian.of(module)

    def __call__(self, inputs: dict[NestedKey, Tensor]) -> dict[NestedKey, Tensor]:
        """See :class:`PolicyStep`."""
        if self._dense is not None and (observation := inputs[self.policy.in_keys[0]]).ndim == 2:
            return self._call_dense(self._dense, observation)
        values = dict(inputs)
        for module, in_keys, out_keys in self._body:
            out = module(*[values[key] for key in in_keys])
            if isinstance(out, Tensor):
                out = (out,)
            values.update(zip(out_keys, out, strict=True))
        loc, scale = values[self._loc], values[self._scale]
        values[self.action_key] = loc if self._deterministic else loc + self._next_noise(loc) * scale
        for key in inputs:
            del values[key]
        return values

    def _call_dense(self, dense: _DenseGaussian, observation: Tensor) -> dict[NestedKey, Tensor]:
        loc, scale = dense(observation)
        if not self._outputs:
            action = loc if self._deterministic else torch.empty_like(loc)
            self._outputs = {self._loc: loc, self._scale: scale, self.action_key: action}
        if not self._deterministic:
            torch.add(loc, self._next_noise(loc, scale), out=self._outputs[self.action_key])
        return self._outputs

    def _next_noise(self, like: Tensor, scale: Tensor | None = None) -> Tensor:
        """Standard normal numbers of the next step, times a scale that is that of all steps."""
        noise = next(self._noise, None)
        if noise is None:
            draws = torch.randn((_CHUNK, *like.shape), generator=self._generator, dtype=like.dtype, device=like.device)
            self._noise = iter((draws if scale is None else draws * scale).unbind(0))
            noise = next(self._noise)
        return noise

    def complete(self, batch: TensorDictBase) -> None:
        """Adds the log-probability, if the policy returns it."""
        if self._head.return_log_prob:
            with torch.no_grad():
                distribution = self._head.get_dist(batch)
                batch.set(self._head.log_prob_key, distribution.log_prob(batch.get(self.action_key)))


class _DenseGaussian:
    """The operations of a dense network and of a state-independent scale, on memory that stays.

    Args:
        linears (list of Linear): the layers.
        activations (list of Module, optional): what follows each of them, if anything does.
        scale (AddStateIndependentNormalScale): the last layer.
    """

    def __init__(
        self,
        linears: list[nn.Linear],
        activations: list[nn.Module | None],
        scale: AddStateIndependentNormalScale,
    ) -> None:
        self._steps: list[tuple[Tensor, Tensor, Tensor, Callable[[Tensor], Tensor] | None]] = []
        for linear, activation in zip(linears, activations, strict=True):
            weight = linear.weight.detach()
            bias = weight.new_zeros(linear.out_features) if linear.bias is None else linear.bias.detach()
            function = None if activation is None else _IN_PLACE.get(type(activation), activation.forward)
            self._steps.append((bias, weight.t(), weight.new_empty(0), function))  # an empty tensor grows, once
        self._scale_layer = scale
        self._scale: Tensor | None = None

    @classmethod
    def of(cls, module: nn.Module) -> _DenseGaussian | None:
        """That of a module; None if there is more to it."""
        layers = _layers(module)
        if layers is None or not layers or not isinstance(scale := layers.pop(), AddStateIndependentNormalScale):
            return None
        linears: list[nn.Linear] = []
        activations: list[nn.Module | None] = []
        for layer in layers:
            if isinstance(layer, nn.Linear):
                linears.append(layer)
                activations.append(None)
            elif type(layer) in ACTIVATIONS.values() and activations and activations[-1] is None:
                activations[-1] = layer
            else:
                return None
        return cls(linears, activations, scale) if linears else None

    def __call__(self, x: Tensor) -> tuple[Tensor, Tensor]:
        """Mean and standard deviation at ``x``, ``[N, features]``; the same tensors in each call."""
        for bias, weight, out, activation in self._steps:
            x = torch.addmm(bias, x, weight, out=out)
            if activation is not None:
                x = activation(x)
        if self._scale is None:
            _, scale = self._scale_layer(x)
            self._scale = scale.contiguous()
        return x, self._scale


_IN_PLACE: dict[type[nn.Module], Callable[[Tensor], Tensor]] = {nn.Tanh: torch.tanh_, nn.ReLU: torch.relu_}


def _layers(module: nn.Module) -> list[nn.Module] | None:
    """The layers of a dense network, one after the other; None if a module may do more than its class says."""
    if _has_hooks(module) or "forward" in vars(module):
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


def policy_step(policy: TensorDictModuleBase, action_key: NestedKey, input_keys: Sequence[NestedKey]) -> PolicyStep:
    """The fastest way to run a policy that gives what calling it gives.

    Args:
        policy (TensorDictModuleBase): reads some of ``input_keys``, writes ``action_key``.
        action_key (NestedKey): the key of the action.
        input_keys (sequence of NestedKey): what there is to read.

    Raises:
        ValueError: if the policy reads another key, or does not write the action.
    """
    missing = [key for key in policy.in_keys if key not in input_keys]
    if missing:
        hint = "" if len(input_keys) > 1 else " Give a normalizer if the policy reads normalised observations."
        raise ValueError(f"The policy reads {missing}, but there is only {list(input_keys)}.{hint}")
    if action_key not in policy.out_keys:
        raise ValueError(f"The policy writes {list(policy.out_keys)}, which is without the action, {action_key!r}.")
    parts = _gaussian_parts(policy)
    if parts is None or parts[1].out_keys[0] != action_key:
        return ModuleStep(policy, action_key)
    return GaussianStep(policy, action_key, *parts)


def _gaussian_parts(
    policy: TensorDictModuleBase,
) -> tuple[list[TensorDictModule], ProbabilisticTensorDictModule] | None:
    """The modules of a Gaussian policy that may be called without tensordicts; None if there is more to it."""
    if not isinstance(policy, ProbabilisticTensorDictSequential) or _has_hooks(policy):
        return None
    *body, head = _flat(policy)
    if type(head) not in (ProbabilisticTensorDictModule, SafeProbabilisticModule) or _has_hooks(head):
        return None
    plain_head = (
        head.distribution_class is IndependentNormal
        and not head.distribution_kwargs
        and list(head.dist_keys) == ["loc", "scale"]
        and head.num_samples is None
        and head._generator is None
        and head._generator_key is None
    )
    plain_body = all(
        type(module) in (TensorDictModule, SafeModule)
        and not _has_hooks(module)
        and isinstance(module.module, nn.Module)
        and module.method is None
        and not module.method_kwargs
        and module._kwargs is None
        for module in body
    )
    return (body, head) if plain_head and plain_body else None


def _flat(module: TensorDictModuleBase) -> list[TensorDictModuleBase]:
    if not isinstance(module, TensorDictSequential):
        return [module]
    return [part for child in module.module for part in _flat(child)]


def _has_hooks(module: nn.Module) -> bool:
    return bool(module._forward_hooks or module._forward_pre_hooks)
