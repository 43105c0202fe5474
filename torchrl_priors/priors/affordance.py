"""What can be done in a state, as a prior."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from tensordict import NestedKey
from tensordict.nn import TensorDictModule, TensorDictModuleBase
from torch import Tensor, nn
from torch import distributions as d

from torchrl_priors.priors.action_prior import ActionPrior, policy_of
from torchrl_priors.priors.spread import check_epsilon, smoothed_logits
from torchrl_priors.state_table import by_state


class AffordancePrior(ActionPrior):
    r"""Affordances: which discrete actions make sense in a state, or how much, as a distribution over them.

    :math:`\pi_0(a|s) = (1-\epsilon)\,w_a(s)/\sum_b w_b(s) + \epsilon/A`. A masked action (weight 0) has probability
    :math:`\epsilon/A`, not 0: its log-probability is finite, and a wrong mask discourages instead of forbidding. Where
    all weights are 0, all actions are equally probable.

    Args:
        weights (Tensor, nn.Module, TensorDictModule or Callable): a bool mask or non-negative weights of the actions:

            * a table ``[S, A]`` or ``[*W, S, A]``, indexed by the integer states under ``in_keys``;
            * a network or function of tensors, from the entries ``in_keys`` to ``[*B, A]``;
            * a TensorDict module that writes them as its first key (e.g. one that reads an ``"action_mask"``).
        epsilon (float): probability that is spread over all actions, in (0, 1]. Defaults to 0.05.

    Keyword Args:
        in_keys (sequence of NestedKey, optional): defaults to ``["state"]`` for a table, else to ``["observation"]``.
        distribution_class (type): over ``logits``. Defaults to :class:`~torch.distributions.Categorical` (indices).
        namespace (str or tuple of str): as in :class:`Prior`.

    Raises:
        ValueError: ``epsilon`` is out of range, or a weight is negative or not finite.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> prior = AffordancePrior(torch.tensor([[True, True, False, False]]), epsilon=0.2)
        >>> prior.get_dist(TensorDict(state=torch.tensor([0]), batch_size=[1])).probs
        tensor([[0.4500, 0.4500, 0.0500, 0.0500]])
        >>> mask = AffordancePrior(lambda mask: mask, in_keys=["action_mask"])
        >>> mask.in_keys
        ['action_mask']
    """

    def __init__(
        self,
        weights: Tensor | nn.Module | TensorDictModuleBase | Callable[..., Tensor],
        epsilon: float = 0.05,
        *,
        in_keys: Sequence[NestedKey] | None = None,
        distribution_class: type[d.Distribution] = d.Categorical,
        namespace: NestedKey = "prior",
    ) -> None:
        smoothing = _Smoothing(check_epsilon(epsilon))
        if isinstance(weights, Tensor):
            smoothing(weights)
        source = by_state(weights, in_keys, "weights")
        smooth = TensorDictModule(smoothing, in_keys=[source.out_keys[0]], out_keys=["logits"])
        super().__init__(
            policy_of(source, smooth, names=["logits"], distribution_class=distribution_class), namespace=namespace
        )
        self.epsilon = float(epsilon)


class _Smoothing(nn.Module):
    def __init__(self, epsilon: float) -> None:
        super().__init__()
        self.epsilon = epsilon

    def forward(self, weights: Tensor) -> Tensor:
        return smoothed_logits(weights, self.epsilon)
