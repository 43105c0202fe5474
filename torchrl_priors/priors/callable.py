"""A scripted controller as a prior."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import torch
from tensordict import NestedKey, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor
from torch import distributions as d
from torchrl.modules import IndependentNormal

from torchrl_priors.priors.action_prior import ActionPrior, policy_of
from torchrl_priors.priors.spread import as_std, check_epsilon, smoothed_logits

__all__ = ["CallablePrior"]


class CallablePrior(ActionPrior):
    r"""A Gymnasium-style controller, ``action = policy(observation)`` on NumPy arrays, with a spread around its action.

    For scripted controllers and hard-coded bots. It must be a function of the observation alone: rollouts are scored in
    any order. Continuous actions get a Gaussian, :math:`\pi_0(\cdot|s)=\mathcal N(\text{policy}(s), \sigma^2)`,
    discrete ones :math:`\pi_0(a|s) = (1-\epsilon)\,[a=\text{policy}(s)] + \epsilon/A`: log-probabilities are finite.

    Args:
        policy (Callable): from the arrays under ``in_keys`` to an action, an array ``[act_dim]`` or an integer.

    Keyword Args:
        std (float or sequence of float, optional): of a continuous action, in its unit, a number or one per dimension.
        num_actions (int, optional): of a discrete action space. Pass either this or ``std``.
        epsilon (float): of a discrete action, in (0, 1]. Defaults to 0.1.
        batched (bool): whether ``policy`` takes ``[N, *obs]`` and gives ``[N, act_dim]`` or ``[N]``. Defaults to
            ``False``: it is called for one observation after the other.
        in_keys (sequence of NestedKey, optional): defaults to ``["observation"]``. Several are several arguments.
        distribution_class (type, optional): defaults to :class:`~torchrl.modules.IndependentNormal` or
            :class:`~torch.distributions.Categorical` (indices).
        namespace (str or tuple of str): as in :class:`Prior`.

    Raises:
        ValueError: neither ``std`` nor ``num_actions``, or both, or out of range; at call, the policy's action has
            another shape, is not finite, or is no action index.

    Examples:
        >>> from tensordict import TensorDict
        >>> def push_back(observation):
        ...     return int(observation[0] < 0)
        >>> prior = CallablePrior(push_back, num_actions=2, epsilon=0.1)
        >>> batch = TensorDict(observation=torch.tensor([[-1.0, 0.0], [1.0, 0.0]]), batch_size=[2])
        >>> prior.get_dist(batch).probs
        tensor([[0.0500, 0.9500],
                [0.9500, 0.0500]])
        >>> CallablePrior(lambda x: 1 - x, std=0.1, batched=True).get_dist(batch).mean
        tensor([[2., 1.],
                [0., 1.]])
    """

    def __init__(
        self,
        policy: Callable[..., Any],
        *,
        std: float | Sequence[float] | None = None,
        num_actions: int | None = None,
        epsilon: float = 0.1,
        batched: bool = False,
        in_keys: Sequence[NestedKey] | None = None,
        distribution_class: type[d.Distribution] | None = None,
        namespace: NestedKey = "prior",
    ) -> None:
        if (std is None) == (num_actions is None):
            raise ValueError("Pass std for a controller with continuous actions, or num_actions for discrete ones.")
        keys: list[NestedKey] = ["observation"] if in_keys is None else list(in_keys)
        controller: _Controller
        if std is not None:
            controller = _Continuous(policy, keys, batched, std)
        else:
            controller = _Discrete(policy, keys, batched, num_actions or 0, check_epsilon(epsilon))
        if distribution_class is None:
            distribution_class = d.Categorical if std is None else IndependentNormal
        super().__init__(
            policy_of(controller, names=controller.out_keys, distribution_class=distribution_class),
            namespace=namespace,
        )


class _Controller(TensorDictModuleBase):
    """Calls a policy on the observations of a batch."""

    def __init__(self, policy: Callable[..., Any], in_keys: list[NestedKey], batched: bool) -> None:
        super().__init__()
        if not callable(policy):
            raise TypeError(f"A CallablePrior needs a function of an observation, got {type(policy).__name__}.")
        self.policy = policy
        self.batched = batched
        self.in_keys = in_keys

    def actions(self, tensordict: TensorDictBase) -> Tensor:
        """The policy's actions ``[*B, ...]``, on the device of the observations."""
        batch = tensordict.batch_size
        tensors = [tensordict.get(key) for key in self.in_keys]
        arrays = [value.detach().cpu().reshape(-1, *value.shape[len(batch) :]).numpy().copy() for value in tensors]
        if self.batched:
            actions = np.asarray(self.policy(*arrays))
        else:
            actions = np.stack([np.asarray(self.policy(*single)) for single in zip(*arrays, strict=True)])
        if actions.shape[:1] != (batch.numel(),):
            raise ValueError(
                f"A batched controller gave actions of shape {actions.shape} for {batch.numel()} observations."
            )
        return torch.as_tensor(actions, device=tensors[0].device).reshape(*batch, *actions.shape[1:])


class _Continuous(_Controller):
    std: Tensor

    def __init__(
        self, policy: Callable[..., Any], in_keys: list[NestedKey], batched: bool, std: float | Sequence[float]
    ) -> None:
        super().__init__(policy, in_keys, batched)
        self.out_keys = ["loc", "scale"]
        self.register_buffer("std", as_std(std))

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        loc = self.actions(tensordict).to(self.std)
        if loc.ndim != tensordict.ndim + 1 or (self.std.ndim and self.std.shape != loc.shape[-1:]):
            raise ValueError(
                "Expected continuous actions of shape [act_dim] from the controller, and std a number or [act_dim],"
                f" got {tuple(loc.shape[tensordict.ndim :])} and {tuple(self.std.shape)}."
            )
        if not loc.isfinite().all():
            raise ValueError("The controller gave an action that is not finite.")
        return tensordict.set("loc", loc).set("scale", self.std.expand_as(loc))


class _Discrete(_Controller):
    def __init__(
        self, policy: Callable[..., Any], in_keys: list[NestedKey], batched: bool, num_actions: int, epsilon: float
    ) -> None:
        super().__init__(policy, in_keys, batched)
        if num_actions < 1:
            raise ValueError(f"num_actions must be at least 1, got {num_actions}.")
        self.out_keys = ["logits"]
        self.num_actions = num_actions
        self.epsilon = epsilon

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        action = self.actions(tensordict)
        if action.is_floating_point() or action.shape != tensordict.batch_size:
            raise ValueError(
                f"Expected an integer for each observation from the controller, got {action.dtype} of shape"
                f" {tuple(action.shape[tensordict.ndim :])}."
            )
        if ((action < 0) | (action >= self.num_actions)).any():
            raise ValueError(
                f"The controller gave actions in [{int(action.min())}, {int(action.max())}], and num_actions is"
                f" {self.num_actions}."
            )
        chosen = torch.nn.functional.one_hot(action.long(), self.num_actions)
        return tensordict.set("logits", smoothed_logits(chosen, self.epsilon))
