"""The interface of soft action priors: frozen advisors that give a distribution over actions in every state."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import Any

import torch
from tensordict import NestedKey, TensorDict, TensorDictBase
from tensordict.nn import ProbabilisticTensorDictModule, TensorDictModuleBase, dispatch
from tensordict.utils import unravel_key
from torch import Tensor
from torch import distributions as d
from torch.compiler import is_compiling

from torchrl_priors.distributions import CATEGORICAL, TORCHRL_ONE_HOT, BoxUniform, action_shape, bounds_of, outside


class Prior(TensorDictModuleBase, ABC):
    r"""A soft action prior :math:`\pi_0(a|s)`: a distribution over actions in every state, as advice to a student.

    Presented in Centa & Preux, "Soft Action Priors: Towards Robust Policy Transfer". A prior does not learn: its
    parameters require no gradient, and it stays in evaluation mode, also after :meth:`train`. It writes the parameters
    of its distribution under its namespace, nothing else. :class:`ActionPrior` makes one of a policy.

    A class of your own has :meth:`get_params`, without a gradient, and :meth:`build_dist`.

    Args:
        in_keys (sequence of NestedKey): what it reads.
        param_names (sequence of str): the parameters of its distribution.
        distribution_class (type): of the distribution that :meth:`build_dist` gives.

    Keyword Args:
        namespace (str or tuple of str): parameters are written under ``(namespace, name)``, e.g. ``("prior", "loc")``.
            Defaults to ``"prior"``.

    Examples:
        >>> class Right(Prior):
        ...     def __init__(self):
        ...         super().__init__(["observation"], ["logits"], d.Categorical)
        ...
        ...     @torch.no_grad()
        ...     def get_params(self, tensordict):
        ...         return {"logits": torch.tensor([0.0, 2.0]).expand(*tensordict.batch_size, 2)}
        ...
        ...     def build_dist(self, params):
        ...         return d.Categorical(**params)
        >>> batch = TensorDict(observation=torch.zeros(5, 3), action=torch.ones(5, dtype=torch.long), batch_size=[5])
        >>> Right().log_prob(batch).shape, Right().out_keys
        (torch.Size([5]), [('prior', 'logits')])
    """

    def __init__(
        self,
        in_keys: Sequence[NestedKey],
        param_names: Sequence[str],
        distribution_class: Any,
        *,
        namespace: NestedKey = "prior",
    ) -> None:
        super().__init__()
        self.namespace = unravel_key(namespace)
        self.param_names = list(param_names)
        self.distribution_class = distribution_class
        self.action_key: NestedKey = "action"
        self.in_keys = list(in_keys)
        self.out_keys = [unravel_key((self.namespace, name)) for name in self.param_names]
        self.train(False)

    @abstractmethod
    def get_params(self, tensordict: TensorDictBase) -> dict[str, Tensor]:
        """The parameters of the distribution by name, without gradient. See :meth:`get_dist`."""

    @abstractmethod
    def build_dist(self, params: dict[str, Tensor]) -> d.Distribution:
        """The distribution with the parameters of :meth:`get_params`."""

    @property
    def draw_keys(self) -> list[NestedKey]:
        """What the prior drew at random and left in the batch for others to reuse (see :class:`RandomDegradation`)."""
        return []

    def draw(self, tensordict: TensorDictBase) -> None:
        """Draws what the prior draws at random into :attr:`draw_keys`, unless it is there already."""

    def set_keys(self, **keys: NestedKey) -> None:
        """Sets the keys that :meth:`log_prob` reads, and :meth:`policy` writes.

        Keyword Args:
            action (NestedKey): the action. Defaults to ``"action"``.

        Raises:
            ValueError: an unknown keyword.
        """
        if unknown := keys.keys() - {"action"}:
            raise ValueError(f"{type(self).__name__} has no key named {', '.join(sorted(unknown))}: it reads 'action'.")
        if "action" in keys:
            self.action_key = unravel_key(keys["action"])

    def train(self, mode: bool = True) -> Prior:
        """Keeps evaluation mode, whatever ``mode``: a prior does not learn."""
        return super().train(False)

    def get_dist(self, tensordict: TensorDictBase) -> d.Distribution:
        """The distribution over actions at the states of ``tensordict``, which stays as it is.

        Args:
            tensordict (TensorDictBase): holds ``in_keys``, batch ``[*B]``.
        """
        return self.build_dist(self.get_params(tensordict))

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
        differs = f"The action space of the prior differs from the student's: {self.action_key!r}"
        expected = action_shape(dist)
        if action.shape != expected:
            hint = ""
            if isinstance(dist, CATEGORICAL) and abs(action.ndim - len(expected)) == 1:
                hint = (
                    " One of the two is one-hot, and the other an index: see one_hot=True of load_sb3_prior, or"
                    " distribution_class=OneHotCategorical of a teacher of your own."
                )
            raise ValueError(
                f"{differs} is of shape {tuple(action.shape)}, and the prior's {type(dist).__name__} is over actions of"
                f" shape {tuple(expected)} (batch {tuple(tensordict.batch_size)}).{hint}"
            )
        if not is_compiling():
            self._check_values(action, dist, differs)
        if not action.numel() and action.is_floating_point():  # torch can't sum over the dimensions of no action
            return action.new_empty(tensordict.batch_size)
        log_prob = dist.log_prob(action)
        return log_prob.flatten(tensordict.ndim).sum(-1) if log_prob.ndim > tensordict.ndim else log_prob

    def _check_values(self, action: Tensor, dist: Any, differs: str) -> None:
        if action.isnan().any():
            raise ValueError(f"The student's action under {self.action_key!r} has NaN entries.")
        if isinstance(dist, d.Categorical) and not isinstance(dist, TORCHRL_ONE_HOT):
            num_actions = dist.logits.shape[-1]
            if ((action < 0) | (action >= num_actions)).any():
                raise ValueError(
                    f"{differs} has indices in [{int(action.min())}, {int(action.max())}], and the prior advises on"
                    f" {num_actions} actions."
                )
            return
        bounds = None if isinstance(dist, BoxUniform) else bounds_of(dist)
        if bounds is not None and outside(action, action, bounds):
            raise ValueError(
                f"{differs} has values in [{float(action.min()):.4g}, {float(action.max()):.4g}], and the prior's"
                f" {type(dist).__name__} has no finite opinion on some of them. Give both the same bounds, or make the"
                " prior a Gaussian, as std=... does in load_sb3_prior."
            )

    def adversary(self) -> Prior:
        r"""The negated advice: :math:`-\mu` for distributions with a ``loc``, negated ``logits`` for discrete ones.

        The adversary of an adversary is the prior again. It shares the prior and the namespace.

        Raises:
            NotImplementedError: the distribution has no parameter that could be negated.
        """
        return NegatedPrior(self)

    def policy(self) -> TensorDictModuleBase:
        """The prior as a policy that acts, e.g. ``env.rollout(1000, prior.policy())``.

        It writes the action, sampled or the mode, by TorchRL's ``set_exploration_type``; by default
        the mode, as TorchRL's actors do.

        Examples:
            >>> from torchrl_priors.priors import BoltzmannPrior
            >>> prior = BoltzmannPrior(torch.tensor([[0.0, 9.0], [9.0, 0.0]]))
            >>> prior.policy()(TensorDict(state=torch.tensor([0, 1]), batch_size=[2]))["action"]
            tensor([1, 0])
        """
        return _Policy(self)

    @dispatch(auto_batch_size=False)
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Writes the parameters of the distribution under the namespace, in ``out_keys``."""
        params = self.get_params(tensordict)
        for key, name in zip(self.out_keys, self.param_names, strict=True):
            tensordict.set(key, params[name])
        return tensordict


class PriorWrapper(Prior):
    """A prior that changes another one's advice: the base of adversaries and degradations.

    Args:
        prior (Prior): it is shared, and so are its namespace and keys.
    """

    def __init__(self, prior: Prior) -> None:
        super().__init__(prior.in_keys, prior.param_names, prior.distribution_class, namespace=prior.namespace)
        self.action_key = prior.action_key
        self.module = prior

    @property
    def draw_keys(self) -> list[NestedKey]:
        """What the other prior drew at random and left in the batch."""
        return self.module.draw_keys

    def draw(self, tensordict: TensorDictBase) -> None:
        """Draws what the other prior draws at random, unless it is there already."""
        self.module.draw(tensordict)

    def build_dist(self, params: dict[str, Tensor]) -> d.Distribution:
        """A distribution of the other prior's kind."""
        return self.module.build_dist(params)


class NegatedPrior(PriorWrapper):
    """The negated advice of a prior; see :meth:`Prior.adversary`."""

    def __init__(self, prior: Prior) -> None:
        super().__init__(prior)
        if not _NEGATED & set(self.param_names):
            raise NotImplementedError(
                f"A distribution with parameters {', '.join(self.param_names)} has no adversary: expected one of"
                f" {', '.join(sorted(_NEGATED))}. Pass an adversary of your own where one is needed."
            )

    def get_params(self, tensordict: TensorDictBase) -> dict[str, Tensor]:
        """The negated parameters of the distribution by name."""
        return self.negate(self.module.get_params(tensordict))

    @staticmethod
    def negate(params: dict[str, Tensor]) -> dict[str, Tensor]:
        """Negates what says where the distribution points to, and keeps the rest, e.g. the ``scale``."""
        return {name: _negate(name, value) for name, value in params.items()}

    def adversary(self) -> Prior:
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


class _Policy(TensorDictModuleBase):
    """See :meth:`Prior.policy`."""

    def __init__(self, prior: Prior) -> None:
        super().__init__()
        self.in_keys, self.out_keys = list(prior.in_keys), [prior.action_key]
        self.prior = prior
        self.sampler = ProbabilisticTensorDictModule(prior.param_names, ["action"], distribution_class=self._build_dist)

    def _build_dist(self, **params: Tensor) -> d.Distribution:
        return self.prior.build_dist(params)

    @dispatch(auto_batch_size=False)
    @torch.no_grad()
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Writes the action."""
        params = self.prior.get_params(tensordict.copy())  # a draw belongs to a step, and not to the next one
        return tensordict.set(self.out_keys[0], self.sampler(TensorDict(params, tensordict.batch_size))["action"])
