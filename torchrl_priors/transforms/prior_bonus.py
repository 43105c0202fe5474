"""The reward bonus of a weighted prior."""

from __future__ import annotations

from typing import Any, Literal

import torch
from tensordict import NestedKey, TensorDictBase
from tensordict.utils import unravel_key
from torch import Tensor

from torchrl_priors.functional import prior_bonus
from torchrl_priors.keys import check_option, next_step, read, under_next
from torchrl_priors.methods import get_method
from torchrl_priors.prior_weight import PriorWeight
from torchrl_priors.transforms.batch_transform import BatchTransform


class PriorBonus(BatchTransform):
    r"""Writes the bonus :math:`B_t = \omega(s)\log\pi_0(a|s)` and the shaped reward :math:`R_t + c B_t`.

    The second stage of reward shaping by a soft action prior (Centa & Preux, "Soft Action Priors: Towards Robust Policy
    Transfer"), after :class:`PriorLogProb` and before the advantage, as often as the weight should be evaluated anew.
    State and action are those of step t + 1 for E2R and AE2R, of step t for ER and AER. It has no gradient, and the
    reward itself is never touched: let the value estimator read ``"shaped_reward"``.

    Args:
        prior_weight (PriorWeight, optional): :math:`\omega`; it is no submodule of the transform, for it belongs to the
            loss that trains it. Defaults to ``None``: 1.

    Keyword Args:
        shift ("next", "current" or "none"): the step whose advice is rewarded; ``"none"`` is no bonus, for the methods
            that have an auxiliary loss only. Defaults to ``"next"``.
        relative (bool): subtracts the student's log-probability, :math:`B_t = \omega(s)(\log\pi_0(a|s)-\log\pi(a|s))`:
            the penalty of KL-regularised RL, in the mean :math:`-\mathrm{KL}(\pi\|\pi_0)`. Of ``shift="current"`` only.
            Defaults to ``False``.
        bonus_coeff (float): :math:`c`, kept as a buffer. Defaults to 1.
        reward_key (NestedKey): ``[*B, T, 1]``, read under ``"next"``. Defaults to ``"reward"``.
        terminated_key (NestedKey): bool, ``[*B, T, 1]``, read under ``"next"``. Defaults to ``"terminated"``.
        log_prob_key (NestedKey): what :class:`PriorLogProb` wrote, ``[*B, T, 1]``. Defaults to ``"prior_log_prob"``.
        student_log_prob_key (NestedKey): :math:`\log\pi(a|s)` of the policy that collected the batch, ``[*B, T]`` or
            ``[*B, T, 1]``, read if ``relative``. Defaults to ``"action_log_prob"``.
        out_keys (list of NestedKey, optional): the bonus (without :math:`c`) and the shaped reward, ``[*B, T, 1]``.
            Defaults to ``[("next", "prior_bonus"), ("next", "shaped_reward")]``.

    Raises:
        ValueError: an unknown setting; rewards of another shape than the bonus; an environment as a container.
        KeyError: an entry is missing in the batch.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl_priors.prior_weight import PriorWeight
        >>> batch = TensorDict(
        ...     next=TensorDict(
        ...         reward=torch.ones(2, 1),
        ...         terminated=torch.tensor([[False], [True]]),
        ...         prior_log_prob=torch.tensor([[-2.0], [0.0]]),
        ...     ),
        ...     batch_size=[2],
        ... )
        >>> batch = PriorBonus(PriorWeight.constant(0.25))(batch)
        >>> batch["next", "shaped_reward"].squeeze(-1)
        tensor([0.5000, 1.0000])
    """

    bonus_coeff: Tensor

    def __init__(
        self,
        prior_weight: PriorWeight | None = None,
        *,
        shift: Literal["none", "current", "next"] = "next",
        relative: bool = False,
        bonus_coeff: float = 1.0,
        reward_key: NestedKey = "reward",
        terminated_key: NestedKey = "terminated",
        log_prob_key: NestedKey = "prior_log_prob",
        student_log_prob_key: NestedKey = "action_log_prob",
        out_keys: list[NestedKey] | None = None,
    ) -> None:
        check_option("shift", shift, ("none", "current", "next"))
        if relative and shift != "current":
            raise ValueError(f"relative=True needs shift='current', got {shift!r}.")
        if prior_weight is not None and not hasattr(prior_weight, "out_keys"):
            raise TypeError(
                f"The weight must be a PriorWeight, got {type(prior_weight).__name__}: try PriorWeight(net)."
            )
        out_keys = [("next", "prior_bonus"), ("next", "shaped_reward")] if out_keys is None else out_keys
        if len(out_keys) != 2:
            raise ValueError(f"Expected a key for the bonus and one for the shaped reward, got {out_keys}.")
        self.reward_key = under_next(reward_key)
        self.terminated_key = under_next(terminated_key)
        super().__init__(in_keys=[self.reward_key], out_keys=out_keys)
        if self.reward_key in self.out_keys:
            raise ValueError(f"The reward {self.reward_key!r} must not be overwritten: use another of out_keys.")
        self.__dict__["prior_weight"] = prior_weight
        self.shift = shift
        self.relative = relative
        self.log_prob_key = under_next(log_prob_key) if shift == "next" else unravel_key(log_prob_key)
        self.student_log_prob_key = unravel_key(student_log_prob_key)
        self.register_buffer("bonus_coeff", torch.tensor(float(bonus_coeff)))

    @classmethod
    def from_method(cls, method: str, prior_weight: PriorWeight | None = None, **kwargs: Any) -> PriorBonus:
        """The bonus of a method by name, see :data:`~torchrl_priors.methods.METHODS`.

        Args:
            method (str): e.g. ``"ae2r"``.
            prior_weight (PriorWeight, optional): needed by the adaptive methods, not used by the others.
            **kwargs: further keyword arguments of the class.

        Raises:
            ValueError: an unknown method, or an adaptive one without a weight.

        Examples:
            >>> PriorBonus.from_method("er").shift
            'current'
        """
        spec = get_method(method)
        if spec.adaptive and prior_weight is None:
            raise ValueError(f"The method {method!r} has a learned weight: pass prior_weight.")
        return cls(prior_weight if spec.adaptive else None, shift=spec.bonus, relative=spec.relative, **kwargs)

    @torch.no_grad()
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Writes the bonus and the shaped reward into the batch and returns it."""
        reward = read(tensordict, self.reward_key, "PriorBonus adds to it")
        bonus = torch.zeros_like(reward) if self.shift == "none" else self._bonus(tensordict)
        if bonus.shape != reward.shape:
            raise ValueError(
                f"The bonus is of shape {tuple(bonus.shape)}, but {self.reward_key!r} of {tuple(reward.shape)}."
            )
        tensordict.set(self.out_keys[0], bonus)
        return tensordict.set(self.out_keys[1], reward + self.bonus_coeff * bonus)

    def _bonus(self, tensordict: TensorDictBase) -> Tensor:
        log_prob = read(tensordict, self.log_prob_key, "run PriorLogProb on it before PriorBonus")
        if self.relative:
            hint = "the policy must return its log-probabilities"
            log_prob = log_prob - read(tensordict, self.student_log_prob_key, hint).reshape(log_prob.shape)
        terminated = None
        if self.shift == "next":
            terminated = read(tensordict, self.terminated_key, "there is no bonus after an end")
            if terminated.shape != log_prob.shape:
                raise ValueError(
                    f"Expected {self.terminated_key!r} of the shape of {self.log_prob_key!r}, {tuple(log_prob.shape)},"
                    f" got {tuple(terminated.shape)}."
                )
        weight = torch.ones_like(log_prob)
        module: PriorWeight | None = self.__dict__["prior_weight"]
        if module is not None:
            keys = module.in_keys
            at = tensordict.select(*keys) if terminated is None else next_step(tensordict, keys, terminated)
            # a weight of its own tensordict: the one of a loss is evaluated anew, with a gradient
            weight = module(at).get(module.out_keys[0])
        bonus = prior_bonus(weight, log_prob)
        return bonus if terminated is None else torch.where(terminated, torch.zeros_like(bonus), bonus)
