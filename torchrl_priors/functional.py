"""The maths of soft action priors, as pure functions of tensors.

Every transform and loss of the library computes with the functions below, and with nothing else, so that there is one
place to check against the paper (Centa & Preux, "Soft Action Priors: Towards Robust Policy Transfer"). All functions
work elementwise on tensors of any (broadcastable) shape unless a dimension is named, are differentiable, and are safe
to trace with :func:`torch.compile`.

Notation: pi is the student, pi0 the prior (teacher), w(s) in [0, 1] the prior weight, B the reward bonus, R the reward.
"""

from __future__ import annotations

import torch
from torch import Tensor

__all__ = [
    "alignment",
    "categorical_cross_entropy",
    "gaussian_cross_entropy",
    "has_next_action",
    "joint",
    "prior_bonus",
    "prior_weight_loss",
    "shift_to_next",
    "td_residual",
]


def categorical_cross_entropy(log_probs: Tensor, prior_log_probs: Tensor) -> Tensor:
    r"""Cross-entropy of two categorical distributions, :math:`H^X(\pi\|\pi_0) = -\sum_a \pi(a)\log\pi_0(a)`.

    Args:
        log_probs (Tensor): normalised log-probabilities of the student, ``[*B, A]``.
        prior_log_probs (Tensor): normalised log-probabilities of the prior, ``[*B, A]``.

    Returns:
        Tensor: nats, ``[*B]``.

    Examples:
        >>> uniform = torch.full((4,), 0.25).log()
        >>> round(categorical_cross_entropy(uniform, uniform).item(), 4)  # log 4
        1.3863
    """
    # What the student never does costs nothing, even where the prior rules it out too: 0 log 0 = 0.
    return -(log_probs.exp() * prior_log_probs.masked_fill(log_probs == -torch.inf, 0.0)).sum(-1)


def gaussian_cross_entropy(loc: Tensor, scale: Tensor, prior_loc: Tensor, prior_scale: Tensor) -> Tensor:
    r"""Cross-entropy of two diagonal Gaussians, a sum over the dimensions of the action.

    .. math::
        H^X = \sum_i \frac{\sigma_i^2 + (\mu_i-\mu_{0i})^2}{2\sigma_{0i}^2} + \log\sigma_{0i} + \tfrac12\log 2\pi

    Args:
        loc, scale (Tensor): mean and standard deviation of the student, ``[*B, A]``.
        prior_loc, prior_scale (Tensor): mean and standard deviation of the prior, ``[*B, A]``.

    Returns:
        Tensor: nats (relative to the unit of the action), ``[*B]``.

    Examples:
        >>> one, zero = torch.ones(1), torch.zeros(1)
        >>> round(gaussian_cross_entropy(zero, one, zero, one).item(), 4)  # (1 + log 2 pi) / 2
        1.4189
    """
    half_log_2pi = 0.9189385332046727
    quadratic = (scale.square() + (loc - prior_loc).square()) / (2 * prior_scale.square())
    return (quadratic + prior_scale.log() + half_log_2pi).sum(-1)


def has_next_action(done: Tensor, traj_ids: Tensor | None = None, *, time_dim: int) -> Tensor:
    """Where step ``t + 1`` of the batch continues the trajectory of step ``t``.

    It does not at the last step of the batch, after a step that is done, nor where the trajectory ids differ: a
    collector that joins the frames of several workers leaves seams whose ``done`` is ``False``.

    Args:
        done (Tensor): bool, the end of a trajectory (terminated or truncated), with a time dimension.
        traj_ids (Tensor, optional): integer trajectory ids of the same shape.

    Keyword Args:
        time_dim (int): the dimension of ``done`` along which time runs.

    Returns:
        Tensor: bool, of the shape of ``done``.

    Examples:
        >>> done = torch.tensor([False, True, False, False])
        >>> has_next_action(done, torch.tensor([0, 0, 1, 2]), time_dim=0)
        tensor([ True, False, False, False])
    """
    length = done.shape[time_dim]
    last = torch.zeros_like(done.narrow(time_dim, 0, 1))
    same = ~done.narrow(time_dim, 0, length - 1)
    if traj_ids is not None:
        same = same & (traj_ids.narrow(time_dim, 0, length - 1) == traj_ids.narrow(time_dim, 1, length - 1))
    return torch.cat([same, last], time_dim)


def joint(value: Tensor, ndim: int) -> Tensor:
    r"""The value of a step from those of its independent actions, :math:`\log\pi_0(a|s) = \sum_i\log\pi_0(a_i|s)`.

    Args:
        value (Tensor): log-probabilities, entropies or cross-entropies, ``[*B]`` or ``[*B, *A]``.
        ndim (int): number of dimensions of ``*B``.

    Returns:
        Tensor: ``[*B, 1]``.

    Examples:
        >>> joint(torch.tensor([[1.0, 2.0], [3.0, 4.0]]), 1)
        tensor([[3.],
                [7.]])
    """
    return value.flatten(ndim).sum(-1, keepdim=True) if value.ndim > ndim else value.unsqueeze(-1)


def shift_to_next(
    value: Tensor, boundary_value: Tensor | float, has_next: Tensor, terminated: Tensor, *, time_dim: int
) -> Tensor:
    r"""The one-step shift of E2R: the value of step ``t + 1`` where there is one, else what stands in for it.

    * where the episode terminated at ``t``: 0 (there is no next state to advise on);
    * where ``has_next``: ``value`` of step ``t + 1``;
    * elsewhere (truncation, end of the rollout, seam between workers): ``boundary_value``, usually the expectation
      :math:`-H^X_{s_{t+1}}(\pi\|\pi_0)`.

    Args:
        value (Tensor): per step, e.g. log pi0(a_t | s_t).
        boundary_value (Tensor or float): what to take where no next action was sampled; broadcasts to ``value``.
        has_next (Tensor): bool, from :func:`has_next_action`.
        terminated (Tensor): bool.

    Keyword Args:
        time_dim (int): the dimension along which time runs.

    Returns:
        Tensor: of the shape of ``value``.

    Examples:
        >>> no, yes = False, True
        >>> shift_to_next(
        ...     torch.tensor([-1.0, -2.0, -3.0]),
        ...     -9.0,
        ...     torch.tensor([yes, no, no]),
        ...     torch.tensor([no, yes, no]),
        ...     time_dim=0,
        ... )
        tensor([-2.,  0., -9.])
    """
    following = torch.cat(
        [value.narrow(time_dim, 1, value.shape[time_dim] - 1), value.narrow(time_dim, 0, 1)], time_dim
    )
    shifted = torch.where(has_next, following, boundary_value)
    return torch.where(terminated, torch.zeros_like(value), shifted)


def prior_bonus(weight: Tensor, log_prob: Tensor) -> Tensor:
    r"""Reward bonus of a weighted prior, :math:`B = \omega(s)\,\log\pi_0(a|s)`.

    ER and AER take state and action at ``t``, E2R and AE2R at ``t + 1`` (see :func:`shift_to_next`); for the methods
    without a learned weight :math:`\omega = 1`.

    Examples:
        >>> prior_bonus(torch.tensor(0.5), torch.tensor(-2.0))
        tensor(-1.)
    """
    return weight * log_prob


def alignment(log_prob: Tensor, cross_entropy: Tensor) -> Tensor:
    r"""How far the prior prefers the action to the student's average one, :math:`\log\pi_0(a|s) + H^X_s(\pi\|\pi_0)`.

    Its mean over actions of the student is 0. It is what ``weight_target="advantage"`` regresses the advantage on.

    Examples:
        >>> alignment(torch.tensor(-1.0), torch.tensor(1.5))
        tensor(0.5000)
    """
    return log_prob + cross_entropy


def td_residual(
    value: Tensor,
    reward: Tensor,
    next_value: Tensor,
    terminated: Tensor,
    gamma: Tensor | float,
    bonus: Tensor | float = 0.0,
) -> Tensor:
    r"""One-step TD error, :math:`\delta_t = R_t + B_t + \gamma(1-\mathrm{term}_t)V(s_{t+1}) - V(s_t)`.

    It is minus the residual of the critic's loss (the paper's Eq. for :math:`\mathcal L_V`), and with ``bonus=0`` it is
    :math:`-E_t` in the prior weight's loss.

    Examples:
        >>> one, no = torch.tensor(1.0), torch.tensor(False)
        >>> td_residual(one, 2 * one, 10 * one, no, 0.5)
        tensor(6.)
    """
    return reward + bonus + gamma * torch.where(terminated, torch.zeros_like(next_value), next_value) - value


def prior_weight_loss(target: Tensor, weight: Tensor, signal: Tensor) -> Tensor:
    r"""Squared error of the prior weight, :math:`\mathcal L_\omega = (y - \omega(s)\,\ell)^2`, elementwise.

    With ``weight_target="td"`` (the paper's Eq. for :math:`\mathcal L_\omega`)
    :math:`y = E_t = V(s_t)-R_t-\gamma V(s_{t+1})`, which is minus :func:`td_residual` without a bonus, and
    :math:`\ell` is the log-probability in the bonus. With ``weight_target="advantage"`` :math:`y` is the advantage on
    raw rewards and :math:`\ell` the :func:`alignment`.
    The gradient reaches ``weight`` only: pass ``target`` and ``signal`` detached.

    Examples:
        >>> prior_weight_loss(torch.tensor(-1.0), torch.tensor(0.5), torch.tensor(-4.0))
        tensor(1.)
    """
    return (target - weight * signal).square()
