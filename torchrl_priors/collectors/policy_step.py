"""One call of a policy per step of a vector of environments, without the overhead of tensordicts where possible."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import numpy as np
import torch
from tensordict import NestedKey, TensorDict, TensorDictBase
from tensordict.nn import (
    ProbabilisticTensorDictModule,
    ProbabilisticTensorDictSequential,
    TensorDictModule,
    TensorDictModuleBase,
    TensorDictSequential,
)
from torch import Tensor, nn
from torchrl.envs.utils import ExplorationType, set_exploration_type
from torchrl.modules import IndependentNormal, SafeModule, SafeProbabilisticModule

from torchrl_priors.collectors.dense_policy import DenseGaussian, has_hooks

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
    the policy itself would give, with other random numbers. Of a small dense network on the CPU, with the same standard
    deviation in every state, not even the modules are called: NumPy computes what they would.
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
        self._noise: Iterator[Any] = iter(())
        self._deterministic = False
        self._dense: DenseGaussian | None = None
        self._outputs: dict[NestedKey, Tensor] = {}  # of a dense network: the same in all steps of a session

    @contextmanager
    def session(self, generator: torch.Generator, deterministic: bool) -> Iterator[None]:
        """See :class:`PolicyStep`."""
        self._generator, self._noise, self._deterministic = generator, iter(()), deterministic
        self._dense = self._find_dense() if generator.device.type == "cpu" else None  # hooks may come and go
        self._outputs = {}
        with torch.no_grad():
            yield

    def _find_dense(self) -> DenseGaussian | None:
        (module, in_keys, out_keys), *more = self._body
        if more or len(in_keys) != 1 or out_keys != (self._loc, self._scale):
            return None
        return DenseGaussian.of(module)

    def __call__(self, inputs: dict[NestedKey, Tensor]) -> dict[NestedKey, Tensor]:
        """See :class:`PolicyStep`."""
        if self._dense is not None:
            observation = inputs[self.policy.in_keys[0]]
            if self._outputs or self._dense.prepare(observation):
                return self._call_dense(self._dense, observation)
            self._dense = None
        values = dict(inputs)
        for module, in_keys, out_keys in self._body:
            out = module(*[values[key] for key in in_keys])
            if isinstance(out, Tensor):
                out = (out,)
            values.update(zip(out_keys, out, strict=True))
        loc, scale = values[self._loc], values[self._scale]
        if self._deterministic:
            values[self.action_key] = loc
        else:
            noise = next(self._noise, None)
            if noise is None:
                self._noise = iter(self._draw(loc).unbind(0))
                noise = next(self._noise)
            values[self.action_key] = loc + noise * scale
        for key in inputs:
            del values[key]
        return values

    def _call_dense(self, dense: DenseGaussian, observation: Tensor) -> dict[NestedKey, Tensor]:
        dense(observation)
        if not self._outputs:
            action = dense.loc if self._deterministic else torch.empty_like(dense.loc)
            self._outputs = {self._loc: dense.loc, self._scale: dense.scale, self.action_key: action}
            self._action, self._mean = action.numpy(), dense.loc.numpy()
        if not self._deterministic:
            noise = next(self._noise, None)
            if noise is None:
                self._noise = iter((self._draw(dense.loc) * dense.scale).numpy())
                noise = next(self._noise)
            np.add(self._mean, noise, out=self._action)
        return self._outputs

    def _draw(self, like: Tensor) -> Tensor:
        """The noise of the next steps."""
        return torch.randn((_CHUNK, *like.shape), generator=self._generator, dtype=like.dtype, device=like.device)

    def complete(self, batch: TensorDictBase) -> None:
        """Adds the log-probability, if the policy returns it."""
        if self._head.return_log_prob:
            with torch.no_grad():
                distribution = self._head.get_dist(batch)
                batch.set(self._head.log_prob_key, distribution.log_prob(batch.get(self.action_key)))


def policy_step(policy: TensorDictModuleBase, action_key: NestedKey, input_keys: Sequence[NestedKey]) -> PolicyStep:
    """The fastest way to run a policy that reads some of ``input_keys``, and gives what calling it gives."""
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
    if not isinstance(policy, ProbabilisticTensorDictSequential) or has_hooks(policy):
        return None
    *body, head = _flat(policy)
    if type(head) not in (ProbabilisticTensorDictModule, SafeProbabilisticModule) or has_hooks(head):
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
        and not has_hooks(module)
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
