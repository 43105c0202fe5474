"""A scripted controller as a prior."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import torch
from tensordict import NestedKey
from torch import Tensor, nn
from torch import distributions as d

from torchrl_priors.priors.module import ModulePrior
from torchrl_priors.priors.spread import as_std, check_epsilon, smoothed_logits


class CallablePrior(ModulePrior):
    r"""A Gymnasium-style controller, ``action = policy(observation)`` on NumPy arrays, with a spread around its action.

    For scripted controllers, hard-coded bots, and models of other libraries. It must be a function of the observation
    alone: rollouts are scored in any order. It is called where it is, and not copied: an object whose method it is may
    have files or a simulator open, and must not change. ``model.predict`` of Stable-Baselines3 is taken as it is: it is
    asked for the deterministic action, and the action is taken from the pair that it returns.

    Continuous actions get a Gaussian, :math:`\pi_0(\cdot|s)=\mathcal N(\text{policy}(s), \sigma^2)`, discrete ones
    :math:`\pi_0(a|s) = (1-\epsilon)\,[a=\text{policy}(s)] + \epsilon/A`: log-probabilities are finite.

    Args:
        policy (Callable): from the arrays under ``in_keys`` to an action, an array ``[act_dim]`` or an integer; or to
            a pair of it and ``None``. If it has an argument ``deterministic``, it is called with ``True``.

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
        TypeError: ``policy`` can't be called; at call, it returns a state beside its action: it has a memory.
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
        controller = _Controller(policy, batched, num_actions, check_epsilon(epsilon))
        super().__init__(
            controller,
            "mean" if num_actions is None else "logits",
            std=None if std is None else as_std(std),
            in_keys=in_keys,
            distribution_class=distribution_class,
            namespace=namespace,
        )


class _Shared:
    """A controller that copies of a prior have in common; it gives an action, alone or in a pair with ``None``."""

    def __init__(self, policy: Callable[..., Any]) -> None:
        self.policy = policy
        self.options = {"deterministic": True} if _has_argument(policy, "deterministic") else {}

    def __deepcopy__(self, memo: dict[int, Any]) -> _Shared:
        return self

    def __call__(self, *arrays: np.ndarray[Any, Any]) -> np.ndarray[Any, Any]:
        found = self.policy(*arrays, **self.options)
        if isinstance(found, tuple) and len(found) == 2:
            action, state = found
            if isinstance(action, np.ndarray) and isinstance(state, tuple):
                raise TypeError(
                    "The controller returned a state beside its action: it has a memory, and a prior's advice is a"
                    " function of the observation alone."
                )
            found = action if state is None else found
        return np.asarray(found)


def _has_argument(function: Callable[..., Any], name: str) -> bool:
    try:
        return name in inspect.signature(function).parameters
    except (TypeError, ValueError):  # it is not written in Python
        return False


class _Controller(nn.Module):
    """A policy of arrays as a network of tensors, ``[N, ...]``: its actions, or the logits of discrete ones."""

    def __init__(self, policy: Callable[..., Any], batched: bool, num_actions: int | None, epsilon: float) -> None:
        super().__init__()
        if not callable(policy):
            raise TypeError(f"A CallablePrior needs a function of an observation, got {type(policy).__name__}.")
        if num_actions is not None and num_actions < 1:
            raise ValueError(f"num_actions must be at least 1, got {num_actions}.")
        self.policy, self.batched, self.num_actions, self.epsilon = _Shared(policy), batched, num_actions, epsilon

    def forward(self, *observations: Tensor) -> Tensor:
        if len(observations[0]) == 0:  # what has no action has the shape of one still
            return self.forward(*(value.new_zeros(1, *value.shape[1:]) for value in observations))[:0]
        arrays = [value.detach().cpu().numpy().copy() for value in observations]
        if self.batched:
            found = self.policy(*arrays)
        else:
            found = np.stack([self.policy(*single) for single in zip(*arrays, strict=True)])
        number = len(arrays[0])
        if found.shape[:1] != (number,):
            raise ValueError(f"A batched controller gave actions of shape {found.shape} for {number} observations.")
        action = torch.as_tensor(found, device=observations[0].device)
        return self._mean(action) if self.num_actions is None else self._logits(action, self.num_actions)

    def _mean(self, action: Tensor) -> Tensor:
        if action.ndim != 2:
            shape = tuple(action.shape[1:])
            raise ValueError(f"Expected continuous actions of shape [act_dim] from the controller, got {shape}.")
        if not action.isfinite().all():
            raise ValueError("The controller gave an action that is not finite.")
        return action.to(torch.get_default_dtype())

    def _logits(self, action: Tensor, number: int) -> Tensor:
        if action.is_floating_point() or action.ndim != 1:
            raise ValueError(
                f"Expected an integer for each observation from the controller, got {action.dtype} of shape"
                f" {tuple(action.shape[1:])}."
            )
        if ((action < 0) | (action >= number)).any():
            raise ValueError(
                f"The controller gave actions in [{int(action.min())}, {int(action.max())}], and num_actions is"
                f" {number}."
            )
        return smoothed_logits(nn.functional.one_hot(action.long(), number), self.epsilon)
