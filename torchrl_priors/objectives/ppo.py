"""PPO with soft action priors, in one loss module."""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from typing import Any

from tensordict import TensorDictBase
from tensordict.nn import ProbabilisticTensorDictSequential, TensorDictModule, dispatch
from tensordict.utils import NestedKey
from torch import distributions as d
from torchrl.objectives import ClipPPOLoss

from torchrl_priors.keys import read, under_next

from .ae2r import AE2RLoss
from .multi_teacher import MultiTeacherLoss
from .selected import SelectedOutput


class ClipPPOPriorLoss(SelectedOutput, ClipPPOLoss):
    r"""Clipped PPO towards soft action priors: :class:`~torchrl.objectives.ClipPPOLoss` and :class:`AE2RLoss` in one.

    Centa & Preux, "Soft Action Priors: Towards Robust Policy Transfer": :math:`\mathcal L_\pi + \mathcal L_V +
    c_\omega\mathcal L_\omega`, where :math:`\mathcal L_\pi` has the auxiliary loss and the advantages have seen the
    bonus. Its output has the entries of both losses; the sum of those that begin with ``"loss_"`` is what to minimise,
    so it drops into any PPO loop and into :class:`~torchrl.trainers.algorithms.PPOTrainer`. With a prior weight of 0
    the actor and the critic are trained bitwise as by :class:`~torchrl.objectives.ClipPPOLoss`. The student's
    distribution is computed once, for both.

    The advantage and the value target must be estimated from the shaped reward. Where the method has a bonus, that is
    the default of the key ``reward`` here (``"shaped_reward"``, as :class:`~torchrl_priors.PriorBonus` writes it): a
    batch without one raises, instead of training on unshaped rewards unnoticed. Give
    :class:`~torchrl.trainers.algorithms.PPOTrainer` ``reward_key=loss.tensor_keys.reward``.

    Args:
        actor_network (ProbabilisticTensorDictSequential): the student.
        critic_network (TensorDictModule): PPO's critic, which sees the bonus.
        prior_loss (AE2RLoss or MultiTeacherLoss): of one teacher or of several, with the same student, functional or
            not as this loss shall be. It keeps its keys, its coefficients and its discount, which is this loss's too
            (``make_value_estimator(gamma=...)`` changes both): ``loss.prior_loss.set_keys(reward="my_raw_reward")``,
            ``loss.prior_loss.aux_coeff = 0.5``.

    Keyword Args:
        reduction (str, optional): ``"none"``, ``"mean"`` or ``"sum"``, of both losses. Defaults to ``"mean"``.
        **kwargs: any other of :class:`~torchrl.objectives.ClipPPOLoss` (``clip_epsilon``, ``critic_coeff``, ...).

    Raises:
        ValueError: the student of ``prior_loss`` is another one; or so is the critic, with ``td_error="shaped"``.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from tensordict.nn import TensorDictModule
        >>> from torchrl.modules import ProbabilisticActor, ValueOperator
        >>> from torchrl_priors.objectives import AE2RLoss, ClipPPOPriorLoss
        >>> def make_actor():
        ...     net = TensorDictModule(torch.nn.Linear(3, 2), in_keys=["observation"], out_keys=["logits"])
        ...     return ProbabilisticActor(net, in_keys=["logits"], distribution_class=torch.distributions.Categorical)
        >>> actor, teacher = make_actor(), make_actor()
        >>> critic = ValueOperator(torch.nn.Linear(3, 1), in_keys=["observation"])
        >>> loss = ClipPPOPriorLoss(actor, critic, AE2RLoss(actor, teacher, method="kickstart"), entropy_bonus=False)
        >>> data = TensorDict(
        ...     {
        ...         "observation": torch.randn(5, 3),
        ...         "action": torch.zeros(5, dtype=torch.long),
        ...         "action_log_prob": -torch.ones(5),
        ...         "advantage": torch.randn(5, 1),
        ...         "value_target": torch.randn(5, 1),
        ...     },
        ...     [5],
        ... )
        >>> losses = loss(data)
        >>> sorted(key for key in losses.keys() if key.startswith("loss_"))
        ['loss_critic', 'loss_objective', 'loss_prior']
        >>> sum(value for key, value in losses.items() if key.startswith("loss_")).backward()
    """

    @dataclass
    class _AcceptedKeys(ClipPPOLoss._AcceptedKeys):
        """The keys of ClipPPOLoss that ``set_keys`` can rename; those of the prior's loss are its own.

        Attributes:
            reward (NestedKey): the reward that the advantage is estimated from, with the bonus.
        """

        reward: NestedKey = "shaped_reward"

    default_keys = _AcceptedKeys
    tensor_keys: _AcceptedKeys
    prior_loss: AE2RLoss | MultiTeacherLoss
    _in_keys: list[NestedKey] | None
    _student: d.Distribution | None = None  # during a forward pass

    def __init__(
        self,
        actor_network: ProbabilisticTensorDictSequential,
        critic_network: TensorDictModule,
        prior_loss: AE2RLoss | MultiTeacherLoss,
        **kwargs: Any,
    ):
        for loss in prior_loss.teachers:
            _check_same("student", actor_network, loss.actor_network, "actor_network")
            if loss.td_error == "shaped" and loss.critic_network is not None:
                _check_same("critic", critic_network, loss.critic_network, "critic_network with td_error='shaped'")
        functional = prior_loss.teachers[0].functional
        super().__init__(actor_network, critic_network, functional=functional, **kwargs)
        # one set of parameters, so that a move to another device or dtype keeps them one
        for loss in prior_loss.teachers if functional else ():
            loss.actor_network_params = self.actor_network_params
            if loss.td_error == "shaped" and loss.critic_network_params is not None:
                loss.critic_network_params = self.critic_network_params
        self.prior_loss = prior_loss
        if prior_loss.spec.bonus == "none":
            self.set_keys(reward=prior_loss.tensor_keys.reward)

    @property
    def gamma(self) -> Any:
        """The discount."""
        return self.prior_loss.teachers[0].gamma

    def make_value_estimator(self, value_type: Any = None, **hyperparams: Any) -> Any:
        """Make the value estimator as in :class:`~torchrl.objectives.LossModule`; its discount is the prior's too."""
        out = super().make_value_estimator(value_type, **hyperparams)
        gamma = getattr(self._value_estimator, "gamma", None)
        for loss in self.prior_loss.teachers if gamma is not None else ():
            loss.gamma.copy_(gamma)
        return out

    def _forward_value_estimator_keys(self, **kwargs: Any) -> None:
        if "prior_loss" in self._modules:
            if "terminated" in kwargs:
                self.prior_loss.set_keys(terminated=self.tensor_keys.terminated)
            raw = self.prior_loss.tensor_keys.reward
            if "reward" in kwargs and self.tensor_keys.reward == raw and self.prior_loss.spec.bonus != "none":
                warnings.warn(
                    f"The key 'reward' of {type(self).__name__} was set to {raw!r}, that of the raw reward: advantages"
                    " estimated from it do not see the prior's bonus. Set it to the shaped reward"
                    " (reward_key='shaped_reward' in PPOTrainer).",
                    stacklevel=3,
                )
        super()._forward_value_estimator_keys(**kwargs)

    @property
    def in_keys(self) -> list[NestedKey]:
        """Those of ClipPPOLoss, then those of the prior's loss."""
        prior_loss = self._modules.get("prior_loss")
        if self._in_keys is None:
            self._set_in_keys()
        return list(dict.fromkeys([*(self._in_keys or []), *(prior_loss.in_keys if prior_loss is not None else [])]))

    @in_keys.setter
    def in_keys(self, values: list[NestedKey]) -> None:
        self._in_keys = values

    @property
    def out_keys(self) -> list[NestedKey]:
        """Those of ClipPPOLoss, then those of the prior's loss."""
        if self._selected is not None:
            return self._selected
        return [*super().out_keys, *self.prior_loss.out_keys]

    @dispatch
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """The losses of a minibatch, and what is worth logging."""
        if tensordict.get(self.tensor_keys.advantage, None) is None:  # it is estimated on the way
            shaped = self.prior_loss.spec.bonus != "none"
            hint = "run prior_transforms(loss) on the batch" if shaped else "an environment writes it"
            read(tensordict, under_next(self.tensor_keys.reward), f"{hint}, then the value estimator")
        if self.prior_loss.reduction != self.reduction:
            self.prior_loss.reduction = self.reduction
        if self.prior_loss.loss_mask_key != self.loss_mask_key:
            self.prior_loss.loss_mask_key = self.loss_mask_key
        try:
            out = super().forward(tensordict)
            return self.only_selected(out.update(self.prior_loss.losses_of(tensordict, self._student)))
        finally:
            self._student = None

    def _get_cur_log_prob(self, tensordict: TensorDictBase, params: Any = None) -> Any:
        """Keeps the student's distribution for the prior's losses, which need it too."""
        out = super()._get_cur_log_prob(tensordict, params)
        if params is None:  # else it is that of the delayed parameters
            self._student = out[1]
        return out

    def reset_parameters_recursive(self) -> None:
        """Reset the networks that this loss trains; never the prior."""
        for name in ("actor_network", "critic_network"):
            network = getattr(self, name)
            if network is not None:
                self._reset_module_parameters(name, network)
        self.prior_loss.reset_parameters_recursive()


def _check_same(role: str, mine: TensorDictModule, theirs: TensorDictModule, name: str) -> None:
    if {*map(id, mine.parameters())} != {*map(id, theirs.parameters())}:
        raise ValueError(f"The {role} of the prior's loss is another one: give it the same {name}.")
