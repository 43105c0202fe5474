"""All actions are equally probable: a prior for controls."""

from __future__ import annotations

from typing import Any

import torch
from tensordict import NestedKey
from torch import Tensor
from torch import distributions as d
from torchrl.data import Bounded, Categorical, OneHot, TensorSpec
from torchrl.modules import OneHotCategorical

from torchrl_priors.distributions import BoxUniform
from torchrl_priors.priors.action_prior import ActionPrior, policy_of
from torchrl_priors.priors.prior import Prior
from torchrl_priors.state_table import Constant


class UniformPrior(ActionPrior):
    r"""The prior that knows nothing: all actions are equally probable.

    Its log-probability is constant, and so is the cross-entropy to it: useful as a control, and as the adversary of a
    degradation. Actions outside of their bounds, which an environment clips, are scored as the bounds are.

    Args:
        actions (TensorSpec or int): the action spec (without batch dimensions of an environment): discrete
            (:class:`~torchrl.data.Categorical`, :class:`~torchrl.data.OneHot`) or :class:`~torchrl.data.Bounded` and
            continuous; or a number of discrete actions, given by their indices.

    Keyword Args:
        namespace (str or tuple of str): as in :class:`Prior`.

    Raises:
        ValueError: a number of actions below 1, or a spec without a uniform distribution (unbounded).
        TypeError: a spec of another kind.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl.data import Bounded
        >>> batch = TensorDict(action=torch.zeros(5, 2), batch_size=[5])
        >>> UniformPrior(Bounded(-1.0, 1.0, shape=(2,))).log_prob(batch)[0]  # -2 log 2
        tensor(-1.3863)
        >>> UniformPrior(4).get_dist(batch).probs[0]
        tensor([0.2500, 0.2500, 0.2500, 0.2500])
    """

    def __init__(self, actions: TensorSpec | int, *, namespace: NestedKey = "prior") -> None:
        params, distribution_class, kwargs = _uniform(actions)
        policy = policy_of(Constant(params), names=list(params), distribution_class=distribution_class, **kwargs)
        super().__init__(policy, namespace=namespace)

    def adversary(self) -> Prior:
        """The prior itself: no advice has no opposite."""
        return self


def _uniform(actions: TensorSpec | int) -> tuple[dict[str, Tensor], Any, dict[str, Any]]:
    """Parameters (by name), class and further arguments of a uniform distribution over ``actions``."""
    if isinstance(actions, int):
        if actions < 1:
            raise ValueError(f"A uniform prior needs at least one action, got {actions}.")
        return {"logits": torch.zeros(actions)}, d.Categorical, {}
    if isinstance(actions, OneHot) and actions.ndim == 1:
        return {"logits": torch.zeros(actions.shape[-1], device=actions.device)}, OneHotCategorical, {}
    if type(actions) is Categorical and actions.ndim == 0:
        return {"logits": torch.zeros(actions.n, device=actions.device)}, d.Categorical, {}
    if isinstance(actions, Bounded) and actions.dtype.is_floating_point:
        low, high = actions.space.low, actions.space.high
        if not (low.isfinite().all() and high.isfinite().all()):
            raise ValueError(f"There is no uniform distribution over unbounded actions: {actions}.")
        return {"low": low.clone(), "high": high.clone()}, BoxUniform, {"event_dims": low.ndim}
    raise TypeError(
        f"Expected a number of actions or a spec of kind Categorical, OneHot or (continuous) Bounded, without the batch"
        f" dimensions of an environment (env.action_spec_unbatched), got {actions}."
    )
