"""A policy as a prior."""

from __future__ import annotations

from contextlib import nullcontext
from copy import deepcopy
from functools import partial
from typing import Any

import torch
from tensordict import NestedKey, TensorDict, TensorDictBase
from tensordict.nn import (
    CompositeDistribution,
    ProbabilisticTensorDictModule,
    ProbabilisticTensorDictSequential,
    TensorDictModuleBase,
)
from tensordict.nn.distributions import Delta as TensorDictDelta
from torch import Tensor
from torch import distributions as d
from torch.compiler import is_compiling
from torchrl.modules import Delta, TanhDelta

from torchrl_priors.distributions import without_independent
from torchrl_priors.keys import parameter_fault
from torchrl_priors.priors.memory import refuse_hidden_states, without_memory
from torchrl_priors.priors.prior import Prior


class ActionPrior(Prior):
    """Any stochastic policy as a :class:`Prior`.

    The policy is copied and frozen: whatever happens to the student or to the network that was passed, the advice of a
    state never changes. The prior reads what its policy reads (raw observations: a policy trained on normalised ones
    should bring its own frozen normaliser as first module).

    Args:
        module (ProbabilisticTensorDictModule or ProbabilisticTensorDictSequential): the policy, e.g. a
            :class:`~torchrl.modules.ProbabilisticActor`, over discrete or continuous actions.

    Keyword Args:
        namespace (str or tuple of str): as in :class:`Prior`.

    Raises:
        TypeError: ``module`` is a prior, or gives no distribution (a greedy actor over action values can be a
            :class:`BoltzmannPrior`).
        ValueError: the distribution is a point mass, which has no log-probability to advise with.
        NotImplementedError: the distribution is a composite of several actions, or the policy has a memory: it reads a
            hidden state, or, at the first call, it changed a buffer or what TorchScript assigns to itself.

    Examples:
        >>> from tensordict.nn import TensorDictModule
        >>> from torchrl.modules import OneHotCategorical, ProbabilisticActor
        >>> net = TensorDictModule(torch.nn.Linear(3, 4), in_keys=["observation"], out_keys=["logits"])
        >>> teacher = ProbabilisticActor(net, in_keys=["logits"], distribution_class=OneHotCategorical)
        >>> prior = ActionPrior(teacher)
        >>> prior.in_keys, prior.out_keys
        (['observation'], [('prior', 'logits')])
        >>> batch = TensorDict(observation=torch.zeros(5, 3), action=torch.eye(4)[[0, 1, 2, 3, 0]], batch_size=[5])
        >>> prior.log_prob(batch).shape
        torch.Size([5])
        >>> prior(batch)["prior", "logits"].shape
        torch.Size([5, 4])
    """

    def __init__(self, module: TensorDictModuleBase, *, namespace: NestedKey = "prior") -> None:
        if isinstance(module, Prior):
            raise TypeError(f"An ActionPrior is made of a policy, and a {type(module).__name__} is a prior already.")
        last = _distribution_module(module)
        refuse_hidden_states(module)
        names = [key[-1] if isinstance(key, tuple) else key for key in last.dist_keys]
        super().__init__(module.in_keys, names, last.distribution_class, namespace=namespace)
        with torch.no_grad():  # TorchScript copies parameters by an operation that has a gradient
            self.module = deepcopy(module)
        self.module.requires_grad_(False).eval()
        self._has_run = False

    @torch.no_grad()
    def get_params(self, tensordict: TensorDictBase) -> dict[str, Tensor]:
        """The parameters of the policy's distribution by name."""
        missing = [key for key in self.in_keys if tensordict.get(key, None) is None]
        if missing:
            raise KeyError(f"The prior reads {self.in_keys}, of which {missing} are not in the tensordict.")
        # The policy writes into a tensordict of its own, so that no key of the student is touched.
        private = tensordict.select(*self.in_keys)
        if isinstance(self.module, ProbabilisticTensorDictSequential):
            first = not self._has_run and not is_compiling()
            with without_memory(self.module) if first else nullcontext():
                try:
                    private = self.module.get_dist_params(private)
                except RuntimeError as error:
                    self._explain(tensordict, error)
                    raise
            self._has_run = self._has_run or first
        keys = _distribution_module(self.module).in_keys
        params = dict(zip(self.param_names, (private.get(key) for key in keys), strict=True))
        if not is_compiling() and (fault := parameter_fault(params)):
            raise ValueError(f"The parameters of the {type(self).__name__} give no distribution: {fault}.")
        return params

    def _explain(self, tensordict: TensorDictBase, error: RuntimeError) -> None:
        """Says it where a teacher can't read what it was given, as observations are of another precision."""
        own = {p.dtype for p in self.module.parameters() if p.is_floating_point()}
        given = {key: tensordict.get(key).dtype for key in self.in_keys}
        other = {key: dtype for key, dtype in given.items() if dtype.is_floating_point and dtype not in own}
        if own and other:
            raise TypeError(
                f"The teacher computes in {', '.join(map(str, own))}, and got {other}: convert the observations, e.g."
                " with the transform DoubleToFloat, or the teacher, prior.to(torch.float64)."
            ) from error

    def build_dist(self, params: dict[str, Tensor]) -> d.Distribution:
        """The policy's distribution with these parameters."""
        last = _distribution_module(self.module)
        values = TensorDict(dict(zip(last.in_keys, (params[name] for name in self.param_names), strict=True)))
        try:
            dist = last.get_dist(values)
        except ValueError as error:
            raise ValueError(f"The parameters of the {type(self).__name__} give no distribution: {error}") from error
        _check_kind(type(without_independent(dist)))  # the class may be known now only, e.g. a function's
        return dist


def policy_of(
    *modules: TensorDictModuleBase, names: list[str], distribution_class: Any, **distribution_kwargs: Any
) -> ProbabilisticTensorDictSequential:
    """A policy from modules that write the parameters ``names`` of its distribution."""
    return ProbabilisticTensorDictSequential(
        *modules,
        ProbabilisticTensorDictModule(
            in_keys=names,
            out_keys=["action"],
            distribution_class=distribution_class,
            distribution_kwargs=distribution_kwargs,
        ),
    )


def _distribution_module(module: TensorDictModuleBase) -> ProbabilisticTensorDictModule:
    """The last module of a policy, which builds its distribution."""
    if not isinstance(module, (ProbabilisticTensorDictModule, ProbabilisticTensorDictSequential)):
        raise TypeError(
            f"A prior needs a policy with a distribution (ProbabilisticTensorDictModule, ProbabilisticActor, ...), got"
            f" {type(module).__name__}. A greedy actor over action values can advise as a BoltzmannPrior."
        )
    last = [child for child in module.modules() if isinstance(child, ProbabilisticTensorDictModule)][-1]
    kind = last.distribution_class
    while isinstance(kind, partial):
        kind = kind.func
    if getattr(module, "return_composite", False):
        kind = CompositeDistribution
    if isinstance(kind, type):
        _check_kind(kind)
    return last


def _check_kind(kind: type) -> None:
    """Refuses a class of distributions that can't advise."""
    if issubclass(kind, CompositeDistribution):
        raise NotImplementedError("Priors over several actions at once (CompositeDistribution) are not supported.")
    if issubclass(kind, (Delta, TanhDelta, TensorDictDelta)):
        raise ValueError(
            f"A {kind.__name__} policy is deterministic: its log-probability can't advise. Give it a distribution,"
            " e.g. a Normal around its action."
        )
