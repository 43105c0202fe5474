"""Rewards of several teachers at once."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from tensordict import NestedKey
from tensordict.nn import TensorDictModuleBase
from tensordict.utils import unravel_key
from torchrl.envs import Compose

from torchrl_priors.methods import get_method
from torchrl_priors.objectives.batch import under_next
from torchrl_priors.objectives.multi_teacher import check_namespaces
from torchrl_priors.prior_weight import PriorWeight
from torchrl_priors.priors import ActionPrior
from torchrl_priors.transforms.prior_bonus import PriorBonus
from torchrl_priors.transforms.prior_log_prob import PriorLogProb

__all__ = ["multi_teacher_transforms"]


def multi_teacher_transforms(
    priors: Sequence[ActionPrior],
    prior_weights: Sequence[PriorWeight] | None,
    actor: TensorDictModuleBase | None = None,
    *,
    method: str = "ae2r",
    bonus_coeff: float = 1.0,
    centering: str = "none",
    reward_key: NestedKey = "reward",
    **kwargs: Any,
) -> Compose:
    r"""The transforms of several teachers: the shaped reward is :math:`R_t + c\sum_k \omega_k(s)\log\pi_k(a|s)`.

    A :class:`PriorLogProb` and a :class:`PriorBonus` for each teacher, whose entries are under the teacher's namespace,
    e.g. ``("expert", "prior_log_prob")`` and ``("next", "expert", "prior_bonus")``. The reward with all bonuses is
    ``("next", "shaped_reward")``. :class:`~torchrl_priors.MultiTeacherLoss` reads these entries.

    Args:
        priors (sequence of ActionPrior): the teachers, each with a ``namespace`` of its own, its name.
        prior_weights (sequence of PriorWeight, optional): :math:`\omega_k`, one for each; ``None`` for methods without.
        actor (ProbabilisticTensorDictSequential, optional): the student, as in :class:`PriorLogProb`.

    Keyword Args:
        method (str): as in :meth:`PriorBonus.from_method`. Defaults to ``"ae2r"``.
        bonus_coeff (float): :math:`c`, of each bonus. Defaults to 1.
        centering (str): as in :class:`PriorBonus`. Defaults to ``"none"``.
        reward_key (NestedKey): as in :class:`PriorBonus`. Defaults to ``"reward"``.
        **kwargs: further keyword arguments of :class:`PriorLogProb`, e.g. ``keep_params=True``.

    Raises:
        ValueError: two teachers share a namespace, or there is not one weight for each.

    Examples:
        >>> from torchrl_priors import UniformPrior
        >>> teachers = [UniformPrior(4, namespace="expert"), UniformPrior(4, namespace="novice")]
        >>> weights = [PriorWeight.constant(0.9), PriorWeight.constant(0.1)]
        >>> transforms = multi_teacher_transforms(teachers, weights, boundary="zero")
        >>> [type(transform).__name__ for transform in transforms]
        ['PriorLogProb', 'PriorBonus', 'PriorLogProb', 'PriorBonus']
    """
    weights = check_namespaces(priors, prior_weights, adaptive=get_method(method).adaptive)
    transforms: list[Any] = []
    reward = reward_key
    for number, (prior, weight) in enumerate(zip(priors, weights, strict=True)):
        log_prob, center, bonus, shaped = (
            unravel_key((prior.namespace, name))
            for name in ("prior_log_prob", "prior_center", "prior_bonus", "shaped_reward")
        )
        out_keys = [log_prob] if centering == "none" else [log_prob, center]
        shaped = "shaped_reward" if number == len(priors) - 1 else shaped
        transforms += [
            PriorLogProb(prior, actor, centering=centering, out_keys=out_keys, **kwargs),  # type: ignore[arg-type]
            PriorBonus.from_method(
                method,
                weight,
                bonus_coeff=bonus_coeff,
                centering=centering,
                reward_key=reward,
                log_prob_key=log_prob,
                center_key=center,
                out_keys=[under_next(bonus), under_next(shaped)],
            ),
        ]
        reward = shaped
    return Compose(*transforms)
