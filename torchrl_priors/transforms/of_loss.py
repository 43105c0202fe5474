"""The transforms that belong to a loss."""

from __future__ import annotations

from typing import Any

from tensordict.utils import unravel_key
from torchrl.envs import Compose
from torchrl.objectives import LossModule

from torchrl_priors.keys import under_next
from torchrl_priors.transforms.prior_bonus import PriorBonus
from torchrl_priors.transforms.prior_log_prob import PriorLogProb


def prior_transforms(loss: LossModule, **kwargs: Any) -> Compose:
    r"""What a loss needs in its batch: :class:`PriorLogProb` and :class:`PriorBonus` for each of its teachers.

    They have the loss's networks, method, coefficients and keys, so that nothing is said twice. With several teachers
    the shaped reward is :math:`R_t + c\sum_k \omega_k(s)\log\pi_k(a|s)`; the entries of each are under its namespace,
    e.g. ``("expert", "prior_log_prob")`` and ``("next", "expert", "prior_bonus")``.

    Args:
        loss (AE2RLoss, MultiTeacherLoss or ClipPPOPriorLoss): as it is now; later changes of its coefficients or keys
            are not seen: where a schedule changes its ``bonus_coeff``, give that of the transform a scheduler too.
        **kwargs: further keyword arguments of :class:`PriorLogProb`.

    Returns:
        Compose: it writes the reward with all bonuses under the key ``reward`` of a :class:`ClipPPOPriorLoss` whose
        method has a bonus, else under ``("next", "shaped_reward")``.

    Raises:
        TypeError: a loss of another kind.

    Examples:
        >>> from torchrl_priors import MultiTeacherLoss, UniformPrior
        >>> actor = UniformPrior(2).module  # any policy
        >>> teachers = [UniformPrior(2, namespace="expert"), UniformPrior(2, namespace="novice")]
        >>> transforms = prior_transforms(MultiTeacherLoss(actor, teachers, method="e2r", bonus_coeff=0.5), time_dim=0)
        >>> [type(transform).__name__ for transform in transforms]
        ['PriorLogProb', 'PriorBonus', 'PriorLogProb', 'PriorBonus']
        >>> transforms[-1].out_keys
        [('next', 'novice', 'prior_bonus'), ('next', 'shaped_reward')]
    """
    prior_loss: Any = getattr(loss, "prior_loss", loss)
    if not hasattr(prior_loss, "teachers"):
        raise TypeError(f"Expected an AE2RLoss, a MultiTeacherLoss or a ClipPPOPriorLoss, got {type(loss).__name__}.")
    of_policy: Any = loss.tensor_keys if prior_loss is not loss else None
    reward = prior_loss.tensor_keys.reward
    has_bonus = any(part.spec.bonus != "none" for part in prior_loss.teachers)
    shaped_reward = of_policy.reward if of_policy is not None and has_bonus else "shaped_reward"
    if shaped_reward == reward:  # PPO was told to leave the bonus aside, and was warned
        shaped_reward = "shaped_reward"
    student = {} if of_policy is None else {"student_log_prob_key": of_policy.sample_log_prob}
    options = {} if of_policy is None else {"done_key": of_policy.done}
    transforms: list[Any] = []
    for part in prior_loss.teachers:
        keys = part.tensor_keys
        last = part is prior_loss.teachers[-1]
        shaped = shaped_reward if last else unravel_key((part.prior.namespace, "shaped_reward"))
        settings = {
            "keep_params": part.prior_in_batch,
            "num_samples": part.num_samples,
            "terminated_key": keys.terminated,
            "out_keys": [keys.prior_log_prob],
            **options,
        }
        transforms += [
            PriorLogProb(part.prior, part.actor_network, **{**settings, **kwargs}),
            PriorBonus(
                part.prior_weight if part.spec.adaptive else None,
                shift=part.spec.bonus,
                relative=part.spec.relative,
                bonus_coeff=part.bonus_coeff.item(),
                reward_key=reward,
                terminated_key=keys.terminated,
                log_prob_key=keys.prior_log_prob,
                out_keys=[under_next(keys.prior_bonus), under_next(shaped)],
                **student,
            ),
        ]
        reward = shaped
    return Compose(*transforms)
