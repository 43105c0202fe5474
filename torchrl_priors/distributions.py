"""What is known of pairs of distributions: cross-entropies, divergences, closed forms, and whether supports match."""

from __future__ import annotations

from typing import Any, TypeGuard

import torch
from tensordict.nn import CompositeDistribution
from tensordict.nn.distributions import OneHotCategorical as TensorDictOneHotCategorical
from torch import Tensor
from torch import distributions as d
from torch.compiler import assume_constant_result, is_compiling
from torch.distributions.kl import _KL_MEMOIZE, _dispatch_kl
from torchrl.modules import MaskedOneHotCategorical, OneHotCategorical, OneHotOrdinal
from torchrl.modules.distributions.utils import has_analytic_entropy, has_analytic_kl, rsample_and_log_prob

from torchrl_priors.functional import categorical_cross_entropy, gaussian_cross_entropy

__all__ = [
    "CATEGORICAL",
    "TORCHRL_ONE_HOT",
    "BoxUniform",
    "action_shape",
    "bounds_of",
    "covers",
    "cross_entropy",
    "cross_entropy_and_kl",
    "cross_entropy_of_advice",
    "kl_divergence",
    "outside",
    "without_independent",
]

#: Distributions over discrete actions, given by their indices or one-hot.
CATEGORICAL = (d.Categorical, d.OneHotCategorical)
#: Those of TorchRL over one-hot actions, which are categorical ones to torch.
TORCHRL_ONE_HOT = (OneHotCategorical, MaskedOneHotCategorical, OneHotOrdinal, TensorDictOneHotCategorical)


class BoxUniform(d.Independent):
    """Uniform over a box; an action outside, which the environment clips, is scored as the bound it is clipped to."""

    def __init__(self, low: Tensor, high: Tensor, event_dims: int) -> None:
        super().__init__(d.Uniform(low, high, validate_args=False), event_dims)

    @property
    def log_density(self) -> Tensor:
        """Minus the log of the box's volume, ``[*B]``."""
        density, dims = -(self.base_dist.high - self.base_dist.low).log(), self.reinterpreted_batch_ndims
        return density.flatten(-dims).sum(-1) if dims else density

    def log_prob(self, value: Tensor) -> Tensor:
        """The same for every action."""
        shape = value.shape[: value.ndim - len(self.event_shape)]
        return self.log_density.to(value.dtype).expand(torch.broadcast_shapes(shape, self.batch_shape))


def action_shape(dist: d.Distribution) -> torch.Size:
    """The shape of an action, batch included. TorchRL's one-hot distributions don't say so in their ``event_shape``."""
    if isinstance(dist, TORCHRL_ONE_HOT) and not dist.event_shape:
        return dist.batch_shape + dist.logits.shape[-1:]
    return dist.batch_shape + dist.event_shape


def without_independent(dist: d.Distribution) -> d.Distribution:
    """The distribution of each dimension of an action, where they are independent."""
    while isinstance(dist, d.Independent):
        dist = dist.base_dist
    return dist


def cross_entropy(dist: d.Distribution, prior_dist: d.Distribution, *, num_samples: int | None = None) -> Tensor:
    r"""Cross-entropy of a policy relative to a prior, :math:`H^X(\pi\|\pi_0) = -\mathbb E_{a\sim\pi}\log\pi_0(a)`.

    It is the auxiliary loss of E2R and AE2R (Centa & Preux, "Soft Action Priors: Towards Robust Policy Transfer"), and
    minus the expected reward bonus of a step whose action is not known yet. It is differentiable with respect to the
    parameters of both distributions.

    * Closed form between categorical families (torch's and TorchRL's, indices or one-hot, masked or not), between
      diagonal Gaussians, from a mixture of them to one, to a :class:`~torchrl_priors.UniformPrior`, and for every pair
      with a registered :math:`\mathrm{KL}(\pi\|\pi_0)` and an analytic entropy, since
      :math:`H^X = \mathrm{KL} + H(\pi)`. ``num_samples`` is not used then.
    * Monte-Carlo over reparameterised samples elsewhere (e.g. :class:`~torchrl.modules.TanhNormal`). Where the KL is
      known and only the entropy is not, only the entropy is sampled: the gradient that pulls towards the prior is then
      exact, and no sample near the bounds of a squashed action needs to be inverted.
    * A discrete distribution is never sampled, for the gradient would be lost: it has a closed form or it raises.

    Args:
        dist (torch.distributions.Distribution): the student's distribution, of batch shape ``[*B]``.
        prior_dist (torch.distributions.Distribution): the prior's distribution over the same actions, of a batch shape
            that broadcasts with ``[*B]``.

    Keyword Args:
        num_samples (int, optional): number of samples where there is no closed form. Defaults to ``None``: 1.

    Returns:
        Tensor: nats, ``[*B]``.

    Raises:
        ValueError: the two distributions are over actions of different shapes or kinds, the student takes actions
            outside of the prior's bounds, or ``num_samples`` < 1.
        NotImplementedError: there is no closed form, and the student can't be sampled with a gradient.

    Examples:
        >>> import torch
        >>> from torch.distributions import Categorical
        >>> student = Categorical(probs=torch.tensor([0.5, 0.5]))
        >>> teacher = Categorical(probs=torch.tensor([0.25, 0.75]))
        >>> round(cross_entropy(student, teacher).item(), 4)  # -(log 1/4 + log 3/4) / 2
        0.837
    """
    return _cross_entropy(dist, prior_dist, num_samples)


def kl_divergence(dist: d.Distribution, prior_dist: d.Distribution, *, num_samples: int | None = None) -> Tensor:
    r"""Divergence of a policy from a prior, :math:`\mathrm{KL}(\pi\|\pi_0) = H^X(\pi\|\pi_0) - H(\pi)`, nats, ``[*B]``.

    Takes and raises what :func:`cross_entropy` does. It is meant for logging: unlike the cross-entropy, it is 0 where
    the student is the prior, whatever the prior's entropy.

    Examples:
        >>> import torch
        >>> from torch.distributions import Categorical
        >>> kl_divergence(Categorical(torch.ones(2)), Categorical(torch.ones(2))).item()
        0.0
    """
    _check(dist, prior_dist, num_samples)
    return _divergence(dist, prior_dist, _closed_form(dist, prior_dist), num_samples)


def cross_entropy_of_advice(
    prior_dist: d.Distribution, dist: d.Distribution, *, num_samples: int | None = None
) -> Tensor:
    r"""The other direction, :math:`H^X(\pi_0\|\pi)`; actions that the student can't take (masked) cost nothing."""
    if isinstance(dist, CATEGORICAL) and isinstance(prior_dist, CATEGORICAL):
        _check(dist, prior_dist, num_samples)
        log_probs = dist.logits.masked_fill(dist.logits.isneginf(), 0.0)
        return categorical_cross_entropy(prior_dist.logits, log_probs)
    return _cross_entropy(prior_dist, dist, num_samples, whose=("prior", "student"))


def cross_entropy_and_kl(
    dist: d.Distribution, prior_dist: d.Distribution, *, num_samples: int | None = None
) -> tuple[Tensor, Tensor]:
    """Both of the above, the divergence without a gradient, for the price of one where there is a closed form."""
    _check(dist, prior_dist, num_samples)
    exact = _closed_form(dist, prior_dist)
    value = _estimate(dist, prior_dist, num_samples) if exact is None else exact
    with torch.no_grad():
        return value, _divergence(dist, prior_dist, exact, num_samples).detach()


def _cross_entropy(dist: d.Distribution, prior_dist: d.Distribution, num_samples: int | None, **roles: Any) -> Tensor:
    _check(dist, prior_dist, num_samples, **roles)
    exact = _closed_form(dist, prior_dist)
    return _estimate(dist, prior_dist, num_samples) if exact is None else exact


def _closed_form(dist: d.Distribution, prior_dist: d.Distribution) -> Tensor | None:
    """The exact cross-entropy of the pair, or ``None``."""
    if isinstance(dist, CATEGORICAL) and isinstance(prior_dist, CATEGORICAL):
        return categorical_cross_entropy(dist.logits, prior_dist.logits)
    if isinstance(prior_dist, BoxUniform):
        return -prior_dist.log_density.expand(torch.broadcast_shapes(dist.batch_shape, prior_dist.batch_shape))
    if isinstance(dist, d.Independent) and isinstance(prior_dist, d.Independent):
        ndims = dist.reinterpreted_batch_ndims
        if ndims == prior_dist.reinterpreted_batch_ndims:
            base, prior_base = dist.base_dist, prior_dist.base_dist
            if _is_gaussian(dist) and _is_gaussian(prior_dist):
                return gaussian_cross_entropy(base.loc, base.scale, prior_base.loc, prior_base.scale)
            terms = _closed_form(base, prior_base)
            return terms if terms is None or ndims == 0 else terms.flatten(-ndims).sum(-1)
    if _is_mixture(dist) and _is_gaussian(prior_dist):  # an expectation is linear in the mixture
        component: Any = dist.component_distribution
        base, prior_base = component.base_dist, prior_dist.base_dist
        loc, scale = prior_base.loc.unsqueeze(-2), prior_base.scale.unsqueeze(-2)
        return (dist.mixture_distribution.probs * gaussian_cross_entropy(base.loc, base.scale, loc, scale)).sum(-1)
    if isinstance(dist, d.Normal) and isinstance(prior_dist, d.Normal):
        params = (dist.loc, dist.scale, prior_dist.loc, prior_dist.scale)
        return gaussian_cross_entropy(*(value.unsqueeze(-1) for value in params))
    if has_analytic_kl(dist, prior_dist) and has_analytic_entropy(dist):
        return _kl(dist, prior_dist) + dist.entropy()
    return None


def _kl(dist: Any, prior_dist: Any) -> Tensor:
    """The registered divergence. Which it is can't be traced, so that compiled code looks it up beforehand."""
    if is_compiling():
        pair = dist, prior_dist
        _look_up(type(dist), type(prior_dist))
        while hasattr(pair[0], "base_dist") and hasattr(pair[1], "base_dist"):
            pair = pair[0].base_dist, pair[1].base_dist
            _look_up(type(pair[0]), type(pair[1]))
    return d.kl_divergence(dist, prior_dist)


@assume_constant_result
def _look_up(kind: type, prior_kind: type) -> bool:
    _KL_MEMOIZE[kind, prior_kind] = _dispatch_kl(kind, prior_kind)
    return True


def _sample(dist: d.Distribution, num_samples: int | None) -> tuple[Tensor, Tensor]:
    return rsample_and_log_prob(dist, torch.Size([1 if num_samples is None else num_samples]))


def _estimate(dist: d.Distribution, prior_dist: d.Distribution, num_samples: int | None) -> Tensor:
    """The cross-entropy from samples of the student."""
    if not dist.has_rsample:
        raise NotImplementedError(
            f"The cross-entropy of {type(dist).__name__} relative to {type(prior_dist).__name__} has no closed form,"
            f" and {type(dist).__name__} has no reparameterised samples to estimate it from: give both networks"
            " distributions of one family (categorical, Gaussian, ...)."
        )
    action, log_prob = _sample(dist, num_samples)
    if has_analytic_kl(dist, prior_dist):
        return _kl(dist, prior_dist) - log_prob.mean(0)
    return -prior_dist.log_prob(action).mean(0)


def _divergence(
    dist: d.Distribution, prior_dist: d.Distribution, exact: Tensor | None, num_samples: int | None
) -> Tensor:
    """The divergence from the exact cross-entropy where there is one, else from samples."""
    if exact is not None and has_analytic_entropy(dist):
        return exact - dist.entropy()
    if has_analytic_kl(dist, prior_dist):
        return _kl(dist, prior_dist)
    if dist.has_rsample or torch.is_grad_enabled():
        action, log_prob = _sample(dist, num_samples)
    else:
        action = dist.sample(torch.Size([1 if num_samples is None else num_samples]))
        log_prob = dist.log_prob(action)
    return (log_prob - prior_dist.log_prob(action)).mean(0)


def _is_gaussian(dist: d.Distribution) -> TypeGuard[d.Independent]:
    return isinstance(dist, d.Independent) and (
        dist.reinterpreted_batch_ndims == 1 and isinstance(dist.base_dist, d.Normal)
    )


def _is_mixture(dist: d.Distribution) -> TypeGuard[d.MixtureSameFamily]:
    return isinstance(dist, d.MixtureSameFamily) and _is_gaussian(dist.component_distribution)


def bounds_of(dist: Any) -> tuple[Any, Any] | None:
    """Where the support of a distribution begins and ends, numbers or tensors; ``None`` for a discrete one."""
    while not hasattr(dist, "low") and isinstance(dist, (d.Independent, d.MixtureSameFamily)):
        dist = dist.base_dist if isinstance(dist, d.Independent) else dist.component_distribution
    if hasattr(dist, "low"):  # what TorchRL's bounded distributions call their support is none
        return dist.low, dist.high
    try:
        support = dist.support
    except (NotImplementedError, TypeError):  # a distribution that does not say
        return -torch.inf, torch.inf
    while hasattr(support, "base_constraint"):
        support = support.base_constraint
    if support.is_discrete:
        return None
    return getattr(support, "lower_bound", -torch.inf), getattr(support, "upper_bound", torch.inf)


def _check(
    dist: d.Distribution,
    prior_dist: d.Distribution,
    num_samples: int | None,
    whose: tuple[str, str] = ("student", "prior"),
) -> None:
    """Refuses distributions over different actions, and one without a finite opinion on the other's actions."""
    if num_samples is not None and num_samples < 1:
        raise ValueError(f"num_samples must be at least 1, got {num_samples}.")
    pair = f"the {whose[0]}'s {type(dist).__name__} and the {whose[1]}'s {type(prior_dist).__name__}"
    if isinstance(dist, CompositeDistribution) or isinstance(prior_dist, CompositeDistribution):
        raise NotImplementedError(f"Distributions over several actions at once are not supported, got {pair}.")
    if isinstance(dist, CATEGORICAL) and isinstance(prior_dist, CATEGORICAL):
        shape, prior_shape = dist.logits.shape[-1:], prior_dist.logits.shape[-1:]
    else:
        shape, prior_shape = dist.event_shape, prior_dist.event_shape
    if shape != prior_shape:
        raise ValueError(
            f"Expected distributions over the same actions, got {pair}, over {tuple(shape)} and {tuple(prior_shape)}."
        )
    if is_compiling():  # bounds are data
        return
    bounds, prior_bounds = bounds_of(dist), bounds_of(prior_dist)
    if (bounds is None) != (prior_bounds is None):
        raise ValueError(f"Expected distributions over the same actions, got {pair}: only one of them is discrete.")
    if bounds is not None and prior_bounds is not None and not covers(prior_dist, dist):
        ours, theirs = (
            f"[{torch.as_tensor(x).min():.4g}, {torch.as_tensor(y).max():.4g}]" for x, y in (bounds, prior_bounds)
        )
        raise ValueError(
            f"Of {pair}, the second has no finite opinion on all actions of the first: they are in {ours}, its own in"
            f" {theirs}. Give both the same bounds: squash the {whose[0]} (TanhNormal), or make the {whose[1]} a"
            f" Gaussian{', as std=... does in load_sb3_prior' if whose[1] == 'prior' else ''}."
        )


def covers(prior_dist: d.Distribution, dist: d.Distribution) -> bool:
    """Whether a prior has a finite opinion on all that a student may do, as to bounds; compiled code can't tell."""
    if is_compiling() or isinstance(prior_dist, BoxUniform):
        return True
    bounds, prior_bounds = bounds_of(dist), bounds_of(prior_dist)
    return bounds is None or prior_bounds is None or not outside(*bounds, prior_bounds)


def outside(low: Any, high: Any, bounds: tuple[Any, Any]) -> bool:
    """Whether actions, or an interval of them, are not within bounds, up to rounding; numbers or tensors."""
    lowest, highest = bounds
    below, above = low < lowest - 1e-5 * (1 + abs(lowest)), high > highest + 1e-5 * (1 + abs(highest))
    return bool(torch.as_tensor(below | above).any())
