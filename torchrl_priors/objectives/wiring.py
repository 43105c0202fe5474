"""What the first batches show about how a loss, its transforms and the advantage are put together."""

from __future__ import annotations

import warnings
from typing import TYPE_CHECKING, Any

import torch
from tensordict import TensorDictBase
from torch import Tensor, nn

from torchrl_priors.keys import under_next

if TYPE_CHECKING:
    from torchrl_priors.objectives.ae2r import AE2RLoss


class Wiring:
    """Warns, once for each, of a bonus of another method, and of an advantage that has not seen the bonus.

    It looks at batches until they tell, and never again.
    """

    def __init__(self, loss: AE2RLoss) -> None:
        self.bonus_told = False
        self.advantage_told = loss.spec.bonus == "none"

    def look(self, loss: AE2RLoss, batch: TensorDictBase) -> None:
        """Looks at a batch, if it has a bonus."""
        if self.bonus_told and self.advantage_told:
            return
        bonus = batch.get(under_next(loss.tensor_keys.prior_bonus), None)
        if bonus is None or not (bonus != 0).any():
            return
        if not self.bonus_told:
            self.bonus_told = True
            if is_of_another_method(loss, batch, bonus):
                warnings.warn(
                    f"The batch has a bonus that is not that of {loss.spec.label or loss.spec}: make the transforms of"
                    " the loss, prior_transforms(loss), or give PriorBonus.from_method and the loss the same method.",
                    stacklevel=4,
                )
        if not self.advantage_told:
            self._look_at_advantage(loss, batch, bonus)

    def _look_at_advantage(self, loss: AE2RLoss, batch: TensorDictBase, bonus: Tensor) -> None:
        """At the end of a trajectory the target of every estimator is the reward and the value after it."""
        names = loss.tensor_keys
        keys: Any = ["value_target", *(under_next(k) for k in (names.reward, "done", names.terminated, "state_value"))]
        target, reward, done, terminated, value = (batch.get(key, None) for key in keys)
        if any(entry is None or entry.shape != bonus.shape for entry in (target, reward, done, terminated, value)):
            return
        raw = reward + loss.gamma * torch.where(terminated, torch.zeros_like(value), value)
        tells = done & ~torch.isclose(raw + loss.bonus_coeff * bonus, raw, rtol=1e-3, atol=1e-4)
        if not tells.any():
            return
        self.advantage_told = True
        if torch.allclose(raw[tells], target[tells], rtol=1e-4, atol=1e-5):
            warnings.warn(
                f"The value target was estimated from the raw reward {under_next(names.reward)!r}: the advantage does"
                " not see the prior's bonus. Call set_keys(reward='shaped_reward') of the value estimator.",
                stacklevel=5,
            )


def is_of_another_method(loss: AE2RLoss, batch: TensorDictBase, bonus: Tensor) -> bool:
    """Whether the bonus of a batch can't be that of a method."""
    names = loss.tensor_keys
    if loss.spec.bonus == "none":
        return True
    key = under_next(names.prior_log_prob) if loss.spec.bonus == "next" else names.prior_log_prob
    log_prob = batch.get(key, None)
    if loss.spec.relative or log_prob is None or log_prob.shape != bonus.shape:
        return False  # it does not tell
    full = torch.isclose(bonus, log_prob, rtol=1e-4, atol=1e-5)
    if not loss.spec.adaptive:
        return not bool(full.all())
    if full.all():  # right for a weight of 1 only; this one was not trained since, or not by so much
        with torch.no_grad():
            weight = loss.evaluate("prior_weight", batch, names.prior_weight)
        return bool((weight < 0.99).all())
    within = full | ((bonus * log_prob >= 0) & (bonus.abs() <= log_prob.abs()))
    return not bool(within.all())


def check_teacher(actor: nn.Module, prior: Any) -> None:
    """Refuses the student as its own teacher, and warns of a copy of it."""
    own = list(actor.parameters())
    others = list(prior.parameters()) if isinstance(prior, nn.Module) else []
    if not own or len(own) != len(others):
        return
    if set(own) == set(others):
        raise ValueError(
            "The prior is the student itself, and agrees with whatever it does. Pass another policy, or"
            " ActionPrior(actor), which is the student as it is now."
        )
    if all(mine.shape == other.shape and torch.equal(mine, other) for mine, other in zip(own, others, strict=True)):
        warnings.warn(
            "The prior is a copy of the student: right for a reference policy, but no teacher knows more than it.",
            stacklevel=3,
        )
