"""A softmax over action values, as a prior."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from tensordict import NestedKey
from tensordict.nn import TensorDictModule, TensorDictModuleBase
from torch import Tensor, nn
from torch import distributions as d

from torchrl_priors.priors.action_prior import ActionPrior, policy_of
from torchrl_priors.state_table import by_state


class BoltzmannPrior(ActionPrior):
    r"""A softmax over action values, :math:`\pi_0(a|s) \propto \exp(Q(s,a)/\tau)`.

    The teacher of the paper's gridworlds (Centa & Preux, "Soft Action Priors"), with :math:`\tau=1`; its
    ``adversary()`` is :math:`\propto \exp(-Q(s,a)/\tau)`. A value of :math:`-\infty` says that an action is not
    available, for the adversary too.

    Args:
        q (Tensor, nn.Module or TensorDictModule): a table of action values, ``[S, A]`` or ``[*W, S, A]`` for a batch of
            worlds ``[*W]`` with a table each; or a network that gives action values ``[*B, A]``; or a TensorDict module
            that writes them (e.g. a :class:`~torchrl.modules.QValueActor`).
        temperature (float): :math:`\tau > 0`, in the unit of the returns. Defaults to 1.

    Keyword Args:
        in_keys (sequence of NestedKey, optional): what ``q`` reads. Defaults to ``["state"]`` (integers ``[*W, ...]``)
            for a table, to ``["observation"]`` for a network; a TensorDict module has its own.
        action_value_key (NestedKey, optional): where a TensorDict module writes the values. Defaults to
            ``"action_value"``, or to its only key.
        distribution_class (type): over ``logits``. Defaults to :class:`~torch.distributions.Categorical` (actions are
            indices ``[*B]``); pass :class:`~torchrl.modules.OneHotCategorical` for one-hot actions ``[*B, A]``.
        namespace (str or tuple of str): as in :class:`Prior`.

    Raises:
        ValueError: ``temperature`` is not positive and finite, or Q is NaN, +inf, or -inf for all actions of a state.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> prior = BoltzmannPrior(torch.tensor([[0.0, 0.0], [1.0, 3.0]]), temperature=2.0)
        >>> batch = TensorDict(state=torch.tensor([0, 1]), action=torch.tensor([0, 1]), batch_size=[2])
        >>> prior.log_prob(batch).exp()
        tensor([0.5000, 0.7311])
        >>> prior.adversary().log_prob(batch).exp()
        tensor([0.5000, 0.2689])
    """

    def __init__(
        self,
        q: Tensor | nn.Module | TensorDictModuleBase,
        temperature: float = 1.0,
        *,
        in_keys: Sequence[NestedKey] | None = None,
        action_value_key: NestedKey | None = None,
        distribution_class: type[d.Distribution] = d.Categorical,
        namespace: NestedKey = "prior",
    ) -> None:
        if not 0 < float(temperature) < float("inf"):
            raise ValueError(f"The temperature of a Boltzmann prior must be positive and finite, got {temperature}.")
        if isinstance(q, Tensor):
            _check_action_values(q)
        values = by_state(q, in_keys, "action_value")
        if action_value_key is None:
            action_value_key = "action_value" if len(values.out_keys) != 1 else values.out_keys[0]
        if action_value_key not in values.out_keys:
            raise ValueError(
                f"{type(q).__name__} writes {values.out_keys}, action values were expected at {action_value_key!r}."
            )
        softmax = TensorDictModule(_Softmax(temperature), in_keys=[action_value_key], out_keys=["logits"])
        super().__init__(
            policy_of(values, softmax, names=["logits"], distribution_class=distribution_class), namespace=namespace
        )


class _Softmax(nn.Module):
    """Logits of a softmax over action values, from ``[*B, A]`` to ``[*B, A]``."""

    temperature: Tensor

    def __init__(self, temperature: float) -> None:
        super().__init__()
        self.register_buffer("temperature", torch.tensor(float(temperature)))

    def forward(self, action_value: Tensor) -> Tensor:
        if not torch.compiler.is_compiling():
            _check_action_values(action_value)
        return action_value / self.temperature


def _check_action_values(q: Tensor) -> None:
    if q.isnan().any() or q.isposinf().any() or q.isneginf().all(-1).any():
        raise ValueError(
            f"Action values of a Boltzmann prior must be numbers (-inf: not available), but of {tuple(q.shape)} values"
            f" {int(q.isnan().sum())} are NaN, {int(q.isposinf().sum())} are +inf, and in"
            f" {int(q.isneginf().all(-1).sum())} states no action is available."
        )
