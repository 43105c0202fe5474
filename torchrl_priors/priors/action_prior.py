"""Soft action priors: frozen advisors that give a distribution over actions in every state."""

from __future__ import annotations

from collections.abc import Sequence
from copy import deepcopy

import torch
from tensordict import NestedKey, TensorDict, TensorDictBase
from tensordict.nn import (
    CompositeDistribution,
    ProbabilisticTensorDictModule,
    ProbabilisticTensorDictSequential,
    TensorDictModuleBase,
    dispatch,
)
from tensordict.nn.distributions import Delta as _TensorDictDelta
from tensordict.nn.distributions import OneHotCategorical as _TensorDictOneHotCategorical
from tensordict.utils import unravel_key
from torch import Tensor
from torch import distributions as d
from torchrl.modules import Delta, MaskedOneHotCategorical, OneHotCategorical, OneHotOrdinal

__all__ = ["ActionPrior"]


class ActionPrior(TensorDictModuleBase):
    r"""A soft action prior :math:`\pi_0(a|s)`: any stochastic policy, frozen, as advice to a student.

    Presented in Centa & Preux, "Soft Action Priors: Towards Robust Policy Transfer". The policy is copied, its
    parameters require no gradient, and it stays in evaluation mode, also after :meth:`train`: whatever happens to the
    student or to the network that was passed, the advice of a state never changes.

    The prior reads what its policy reads (raw observations: a policy trained on normalised ones should bring its own
    frozen normaliser as first module), and writes the parameters of its distribution under its namespace, nothing else.

    Args:
        module (ProbabilisticTensorDictModule, ProbabilisticTensorDictSequential or ActionPrior): the policy, e.g. a
            :class:`~torchrl.modules.ProbabilisticActor`, over discrete or continuous actions. A prior is shared.

    Keyword Args:
        namespace (str or tuple of str): parameters are written under ``(namespace, name)``, e.g. ``("prior", "loc")``.
            Defaults to ``"prior"``.

    Raises:
        TypeError: ``module`` gives no distribution (a greedy value-based actor can be a :class:`BoltzmannPrior`).
        ValueError: the distribution is a point mass, which has no log-probability to advise with.
        NotImplementedError: the distribution is a composite of several actions.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
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
        super().__init__()
        self.param_names: list[str]
        if isinstance(module, ActionPrior):
            self.param_names = module.param_names
        else:
            last = _distribution_module(module)
            self.param_names = [key[-1] if isinstance(key, tuple) else key for key in last.dist_keys]
            module = deepcopy(module)
        self.module = module.requires_grad_(False)
        self.namespace = unravel_key(namespace)
        self.action_key: NestedKey = module.action_key if isinstance(module, ActionPrior) else "action"
        self.in_keys = list(module.in_keys)
        self.out_keys = [self._key(name) for name in self.param_names]
        self.train(False)

    def _key(self, name: str) -> NestedKey:
        return unravel_key((self.namespace, name))

    @property
    def draw_keys(self) -> list[NestedKey]:
        """What the prior drew at random and left in the batch for others to reuse (see :class:`RandomDegradation`)."""
        return self.module.draw_keys if isinstance(self.module, ActionPrior) else []

    def set_keys(self, **keys: NestedKey) -> None:
        """Sets the keys that :meth:`log_prob` reads.

        Keyword Args:
            action (NestedKey): the student's action. Defaults to ``"action"``.

        Raises:
            ValueError: an unknown keyword.
        """
        if unknown := keys.keys() - {"action"}:
            raise ValueError(f"{type(self).__name__} has no key named {', '.join(sorted(unknown))}: it reads 'action'.")
        if "action" in keys:
            self.action_key = unravel_key(keys["action"])

    def train(self, mode: bool = True) -> ActionPrior:
        """Keeps evaluation mode, whatever ``mode``: a prior does not learn."""
        return super().train(False)

    @torch.no_grad()
    def get_params(self, tensordict: TensorDictBase) -> dict[str, Tensor]:
        """The parameters of the distribution by name, without gradient. See :meth:`get_dist`."""
        module = self.module
        if isinstance(module, ActionPrior):
            return module.get_params(tensordict)
        # The policy writes into a tensordict of its own, so that no key of the student is touched.
        private = _select(tensordict, module.in_keys)
        if isinstance(module, ProbabilisticTensorDictSequential):
            private = module.get_dist_params(private)
        return dict(
            zip(self.param_names, (private.get(key) for key in _distribution_module(module).in_keys), strict=True)
        )

    def build_dist(self, params: dict[str, Tensor]) -> d.Distribution:
        """The distribution with the parameters of :meth:`get_params`."""
        if isinstance(self.module, ActionPrior):
            return self.module.build_dist(params)
        last = _distribution_module(self.module)
        values = TensorDict(dict(zip(last.in_keys, (params[name] for name in self.param_names), strict=True)))
        return last.get_dist(values)

    def get_dist(self, tensordict: TensorDictBase) -> d.Distribution:
        """The distribution over actions at the states of ``tensordict``, which stays as it is.

        Args:
            tensordict (TensorDictBase): holds ``in_keys``, batch ``[*B]``.
        """
        return self.build_dist(self.get_params(tensordict))

    def draw(self, tensordict: TensorDictBase) -> None:
        """Draws what the prior draws at random into :attr:`draw_keys`, unless it is there already."""
        if isinstance(self.module, ActionPrior):
            self.module.draw(tensordict)

    def log_prob(self, tensordict: TensorDictBase, *, dist: d.Distribution | None = None) -> Tensor:
        r"""Log-probability of the action that was taken, :math:`\log\pi_0(a_t|s_t)`.

        Args:
            tensordict (TensorDictBase): holds ``in_keys`` and the action, batch ``[*B]``.

        Keyword Args:
            dist (torch.distributions.Distribution, optional): from :meth:`get_dist`, to save its computation.

        Returns:
            Tensor: nats, ``[*B]``: the joint log-probability where the action has several independent dimensions.

        Raises:
            KeyError: an entry is missing.
            ValueError: the action is not one of the prior's action space.
        """
        action = tensordict.get(self.action_key, None)
        if action is None:
            raise KeyError(
                f"The prior scores actions under {self.action_key!r}, which is missing: set_keys(action=...)."
            )
        dist = self.get_dist(tensordict) if dist is None else dist
        expected = _action_shape(dist)
        if action.shape != expected:
            raise ValueError(
                f"The action space of the prior differs from the student's: {self.action_key!r} is of shape"
                f" {tuple(action.shape)}, and the prior's {type(dist).__name__} is over actions of shape"
                f" {tuple(expected)} (batch {tuple(tensordict.batch_size)})."
            )
        if isinstance(dist, d.Categorical) and not isinstance(dist, _ONE_HOT) and not torch.compiler.is_compiling():
            num_actions = dist.logits.shape[-1]
            if ((action < 0) | (action >= num_actions)).any():
                raise ValueError(
                    f"The action space of the prior differs from the student's: {self.action_key!r} has indices in"
                    f" [{int(action.min())}, {int(action.max())}], and the prior advises on {num_actions} actions."
                )
        log_prob = dist.log_prob(action)
        return log_prob.flatten(tensordict.ndim).sum(-1) if log_prob.ndim > tensordict.ndim else log_prob

    def adversary(self) -> ActionPrior:
        r"""The negated advice: :math:`-\mu` for distributions with a ``loc``, negated ``logits`` for discrete ones.

        The adversary of an adversary is the prior again. It shares the frozen policy and the namespace.

        Raises:
            NotImplementedError: the distribution has no parameter that could be negated.
        """
        return NegatedPrior(self)

    @dispatch(auto_batch_size=False)
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Writes the parameters of the distribution under the namespace, in ``out_keys``."""
        for key, value in zip(self.out_keys, self.get_params(tensordict).values(), strict=True):
            tensordict.set(key, value)
        return tensordict


class NegatedPrior(ActionPrior):
    """The negated advice of a prior; see :meth:`ActionPrior.adversary`."""

    def __init__(self, prior: ActionPrior) -> None:
        super().__init__(prior, namespace=prior.namespace)
        if not _NEGATED & set(self.param_names):
            raise NotImplementedError(
                f"A distribution with parameters {', '.join(self.param_names)} has no adversary: expected one of"
                f" {', '.join(sorted(_NEGATED))}. Pass an adversary of your own where one is needed."
            )

    def get_params(self, tensordict: TensorDictBase) -> dict[str, Tensor]:
        """The negated parameters of the distribution by name."""
        return self.negate(super().get_params(tensordict))

    @staticmethod
    def negate(params: dict[str, Tensor]) -> dict[str, Tensor]:
        """Negates what says where the distribution points to, and keeps the rest, e.g. the ``scale``."""
        return {name: _negate(name, value) for name, value in params.items()}

    def adversary(self) -> ActionPrior:
        """The prior whose advice is negated here."""
        return self.module


_NEGATED = {"loc", "logits", "probs"}


def _negate(name: str, value: Tensor) -> Tensor:
    if name == "loc":
        return -value
    if name == "logits":
        return torch.where(value.isneginf(), value, -value)  # what can't be done can't be done
    if name == "probs":
        inverse = torch.where(value == 0, 0, 1 / value)
        return inverse / inverse.sum(-1, keepdim=True)
    return value


def _select(tensordict: TensorDictBase, keys: Sequence[NestedKey]) -> TensorDictBase:
    """A tensordict with these entries only, and the same tensors."""
    missing = [key for key in keys if tensordict.get(key, None) is None]
    if missing:
        raise KeyError(f"The prior reads {list(keys)}, of which {missing} are not in the tensordict.")
    return tensordict.select(*keys)


_ONE_HOT = (OneHotCategorical, MaskedOneHotCategorical, OneHotOrdinal, _TensorDictOneHotCategorical)


def _action_shape(dist: d.Distribution) -> torch.Size:
    """The shape of an action, batch included. TorchRL's one-hot distributions don't say so in their ``event_shape``."""
    if isinstance(dist, _ONE_HOT) and not dist.event_shape:
        return dist.batch_shape + dist.logits.shape[-1:]
    return dist.batch_shape + dist.event_shape


def _distribution_module(module: TensorDictModuleBase) -> ProbabilisticTensorDictModule:
    """The last module of a policy, which builds its distribution."""
    if not isinstance(module, (ProbabilisticTensorDictModule, ProbabilisticTensorDictSequential)):
        raise TypeError(
            f"A prior needs a policy with a distribution (ProbabilisticTensorDictModule, ProbabilisticActor, ...), got"
            f" {type(module).__name__}. A greedy actor over action values can advise as a BoltzmannPrior."
        )
    last = [child for child in module.modules() if isinstance(child, ProbabilisticTensorDictModule)][-1]
    kind = last.distribution_class
    if getattr(module, "return_composite", False) or kind is CompositeDistribution:
        raise NotImplementedError("Priors over several actions at once (CompositeDistribution) are not supported.")
    if isinstance(kind, type) and issubclass(kind, (Delta, _TensorDictDelta)):
        raise ValueError(
            f"A {kind.__name__} policy is deterministic: its log-probability can't advise. Give it a distribution,"
            " e.g. a Normal around its action."
        )
    return last
