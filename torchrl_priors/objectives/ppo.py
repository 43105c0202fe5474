"""PPO with a soft action prior, in one loss module."""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from typing import Any, Literal

from tensordict import TensorDictBase
from tensordict.nn import ProbabilisticTensorDictSequential, TensorDictModule, TensorDictModuleBase, dispatch
from tensordict.utils import NestedKey
from torch import distributions as d
from torchrl.objectives import ClipPPOLoss

from torchrl_priors.methods import MethodSpec

from .ae2r import AE2RLoss
from .batch import out_key

__all__ = ["ClipPPOPriorLoss"]


class ClipPPOPriorLoss(ClipPPOLoss):
    r"""Clipped PPO towards a soft action prior: :class:`~torchrl.objectives.ClipPPOLoss` and :class:`AE2RLoss` in one.

    Centa & Preux, "Soft Action Priors: Towards Robust Policy Transfer": :math:`\mathcal L_\pi + \mathcal L_V +
    c_\omega\mathcal L_\omega`, where :math:`\mathcal L_\pi` has the auxiliary loss and the advantages have seen the
    bonus. Its output has the entries of both losses; the sum of those that begin with ``"loss_"`` is what to minimise,
    so it drops into any PPO loop and into :class:`~torchrl.trainers.algorithms.PPOTrainer`. With a prior weight of 0
    the actor and the critic are trained bitwise as by :class:`~torchrl.objectives.ClipPPOLoss`.

    The advantage and the value target must be estimated from the shaped reward. Where the method has a bonus, that is
    the default of the key ``reward`` here (``"shaped_reward"``, as :class:`~torchrl_priors.PriorBonus` writes it): a
    batch without one raises, instead of training on unshaped rewards unnoticed. Give
    :class:`~torchrl.trainers.algorithms.PPOTrainer` ``reward_key="shaped_reward"``. The raw reward of the prior
    weight's loss is another key, ``raw_reward``.

    Args:
        actor_network (ProbabilisticTensorDictSequential): the student.
        critic_network (TensorDictModule): PPO's critic, which sees the bonus.
        prior (ActionPrior): the teacher.
        prior_weight (TensorDictModule, optional): :math:`\omega`; required by the adaptive methods.
        prior_critic_network (TensorDictModule, optional): the critic of raw rewards behind the prior weight; required
            by the adaptive methods with ``td_error="original"``. With ``"shaped"``, ``critic_network`` is in its place.

    Keyword Args:
        method, td_error, weight_target, centering, bonus_coeff, aux_coeff, kl_share, weight_coeff, num_samples,
            prior_in_batch: as for :class:`AE2RLoss`. To schedule a coefficient, assign it on ``prior_loss``:
            ``loss.prior_loss.aux_coeff = 0.5``.
        prior_critic_coeff (float): coefficient of ``loss_prior_critic``. Defaults to 1.0.
        gamma (float): discount, of the prior weight's loss and of the value estimator
            (``make_value_estimator(gamma=...)`` changes both). Defaults to 0.99.
        reduction (str, optional): ``"none"``, ``"mean"`` or ``"sum"``. Defaults to ``"mean"``.
        functional (bool): as for :class:`~torchrl.objectives.ClipPPOLoss`. Defaults to ``True``.
        **kwargs: any other of :class:`~torchrl.objectives.ClipPPOLoss` (``clip_epsilon``, ``critic_coeff``, ...).

    Raises:
        ValueError: as :class:`AE2RLoss`.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from tensordict.nn import TensorDictModule
        >>> from torchrl.modules import ProbabilisticActor, ValueOperator
        >>> from torchrl_priors.objectives import ClipPPOPriorLoss
        >>> def actor():
        ...     net = TensorDictModule(torch.nn.Linear(3, 2), in_keys=["observation"], out_keys=["logits"])
        ...     return ProbabilisticActor(net, in_keys=["logits"], distribution_class=torch.distributions.Categorical)
        >>> critic = ValueOperator(torch.nn.Linear(3, 1), in_keys=["observation"])
        >>> loss = ClipPPOPriorLoss(actor(), critic, actor(), method="kickstart", entropy_bonus=False)
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
        """The keys that ``set_keys`` can rename: those of ClipPPOLoss, and of AE2RLoss.

        Attributes:
            reward (NestedKey): the reward that the advantage is estimated from, with the bonus.
            raw_reward (NestedKey): the reward without it.
            raw_value (NestedKey): what the critic of raw rewards writes.
            prior_weight, prior_log_prob, prior_center, prior_bonus, raw_advantage (NestedKey): as for AE2RLoss.
        """

        reward: NestedKey = "shaped_reward"
        raw_reward: NestedKey = "reward"
        raw_value: NestedKey = "state_value"
        prior_weight: NestedKey = "prior_weight"
        prior_log_prob: NestedKey = "prior_log_prob"
        prior_center: NestedKey = "prior_center"
        prior_bonus: NestedKey = "prior_bonus"
        raw_advantage: NestedKey = "raw_advantage"

    default_keys = _AcceptedKeys
    tensor_keys: _AcceptedKeys
    prior_loss: AE2RLoss
    _in_keys: list[NestedKey] | None
    _out_keys: list[NestedKey] | None
    _student: d.Distribution | None = None  # during a forward pass

    def __init__(
        self,
        actor_network: ProbabilisticTensorDictSequential,
        critic_network: TensorDictModule,
        prior: TensorDictModuleBase,
        prior_weight: TensorDictModule | None = None,
        prior_critic_network: TensorDictModule | None = None,
        *,
        method: str | MethodSpec = "ae2r",
        td_error: Literal["original", "shaped"] = "original",
        weight_target: Literal["td", "advantage", "none"] | None = None,
        centering: Literal["none", "prior", "policy"] = "none",
        bonus_coeff: float = 1.0,
        aux_coeff: float | None = None,
        kl_share: float | None = None,
        weight_coeff: float = 1.0,
        prior_critic_coeff: float = 1.0,
        gamma: float = 0.99,
        num_samples: int | None = None,
        prior_in_batch: bool = False,
        reduction: Literal["none", "mean", "sum"] | None = None,
        functional: bool = True,
        **kwargs: Any,
    ):
        super().__init__(actor_network, critic_network, reduction=reduction, functional=functional, **kwargs)
        prior_loss = AE2RLoss(
            actor_network,
            prior,
            prior_weight,
            critic_network if td_error == "shaped" else prior_critic_network,
            method=method,
            td_error=td_error,
            weight_target=weight_target,
            centering=centering,
            bonus_coeff=bonus_coeff,
            aux_coeff=aux_coeff,
            kl_share=kl_share,
            weight_coeff=weight_coeff,
            critic_coeff=prior_critic_coeff,
            gamma=gamma,
            num_samples=num_samples,
            prior_in_batch=prior_in_batch,
            reduction=reduction,
            functional=functional,
        )
        if functional:  # one set of parameters, so that a move to another device or dtype keeps them one
            prior_loss.actor_network_params = self.actor_network_params
            if td_error == "shaped" and prior_loss.critic_network_params is not None:
                prior_loss.critic_network_params = self.critic_network_params
        self.prior_loss = prior_loss
        keys: dict[str, NestedKey] = {"prior_weight": prior_loss.tensor_keys.prior_weight}
        if prior_critic_network is not None:
            keys["raw_value"] = out_key(prior_critic_network, self.tensor_keys.raw_value)
        if prior_loss.spec.bonus == "none":
            keys["reward"] = "reward"
        self.set_keys(**keys)

    @property
    def gamma(self) -> Any:
        """The discount."""
        return self.prior_loss.gamma

    def make_value_estimator(self, value_type: Any = None, **hyperparams: Any) -> Any:
        """Make the value estimator as in :class:`~torchrl.objectives.LossModule`; its discount is the prior's too."""
        out = super().make_value_estimator(value_type, **hyperparams)
        gamma = getattr(self._value_estimator, "gamma", None)
        if gamma is not None:
            self.prior_loss.gamma.copy_(gamma)
        return out

    def _forward_value_estimator_keys(self, **kwargs: Any) -> None:
        if "prior_loss" in self._modules:
            names = self.tensor_keys
            shaped = self.prior_loss.td_error == "shaped"
            self.prior_loss.set_keys(
                reward=names.raw_reward,
                terminated=names.terminated,
                value=names.value if shaped else names.raw_value,
                prior_weight=names.prior_weight,
                prior_log_prob=names.prior_log_prob,
                prior_center=names.prior_center,
                prior_bonus=names.prior_bonus,
                raw_advantage=names.raw_advantage,
            )
            if "reward" in kwargs and names.reward == names.raw_reward and self.prior_loss.spec.bonus != "none":
                warnings.warn(
                    f"The key 'reward' of {type(self).__name__} was set to {names.reward!r}, that of the raw reward:"
                    " advantages estimated from it do not see the prior's bonus. Set it to the shaped reward"
                    " (reward_key='shaped_reward' in PPOTrainer).",
                    stacklevel=3,
                )
        super()._forward_value_estimator_keys(**kwargs)

    def _set_in_keys(self) -> None:
        super()._set_in_keys()
        if "prior_loss" in self._modules:
            self._in_keys = list(dict.fromkeys([*(self._in_keys or []), *self.prior_loss.in_keys]))

    @property
    def out_keys(self) -> list[NestedKey]:
        """Those of ClipPPOLoss, then those of AE2RLoss."""
        if self._out_keys is None:
            self._out_keys = [*super().out_keys, *self.prior_loss.out_keys]
        return self._out_keys

    @out_keys.setter
    def out_keys(self, values: list[NestedKey]) -> None:
        self._out_keys = values

    @dispatch
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """The losses of a minibatch, and what is worth logging."""
        if self.prior_loss.reduction != self.reduction:
            self.prior_loss.reduction = self.reduction
        if self.prior_loss.loss_mask_key != self.loss_mask_key:
            self.prior_loss.loss_mask_key = self.loss_mask_key
        try:
            out = super().forward(tensordict)
            return out.update(self.prior_loss._losses(tensordict, self._student))
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
