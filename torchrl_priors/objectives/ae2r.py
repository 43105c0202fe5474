"""The losses that a soft action prior adds to a policy-gradient algorithm."""

from __future__ import annotations

import contextlib
from dataclasses import dataclass
from typing import ClassVar, Literal

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import (
    ProbabilisticTensorDictSequential,
    TensorDictModule,
    TensorDictModuleBase,
    TensorDictParams,
    dispatch,
)
from tensordict.utils import NestedKey, unravel_key
from torch import Tensor
from torch import distributions as d
from torchrl.objectives import LossModule
from torchrl.objectives.utils import distance_loss

from torchrl_priors.functional import alignment, joint, prior_bonus, td_residual
from torchrl_priors.methods import MethodSpec, get_method
from torchrl_priors.priors import ActionPrior

from .batch import check_option, keep_where, out_key, under_next, weight_regression
from .cross_entropy import cross_entropy_and_kl, cross_entropy_of_advice, kl_divergence

__all__ = ["AE2RLoss"]


class AE2RLoss(LossModule):
    r"""Auxiliary loss and prior-weight loss of (adaptive) entropy regularisation towards a soft action prior.

    Centa & Preux, "Soft Action Priors: Towards Robust Policy Transfer". It stands beside the loss of a policy-gradient
    algorithm (:class:`~torchrl.objectives.ClipPPOLoss`, :class:`~torchrl.objectives.A2CLoss`, ...) and adds, with
    :math:`\pi` the student, :math:`\pi_0` the prior and :math:`\omega(s)\in[0,1]` the prior weight,

    * ``"loss_prior"``, :math:`c_{aux}\,\mathrm{sg}[\omega(s_t)]\,H^X_{s_t}(\pi\|\pi_0)`, which reaches the actor only;
      being a cross-entropy and no divergence, it pulls towards the prior's best action, not to its entropy (that of
      ``"pull"``, ``"aligned"`` and ``"annealed_kickstart"`` is :math:`H^X_{s_t}(\pi_0\|\pi)`, which pulls towards
      the prior itself);
    * ``"loss_prior_weight"``, :math:`c_\omega\,(y - \omega(s)\,\ell)^2`, which reaches the prior weight only;
    * ``"loss_prior_critic"``, :math:`c_V\,(V(s_t) - \mathrm{sg}[R_t + \gamma(1-\mathrm{term}_t)V(s_{t+1})])^2`, which
      reaches the critic of raw rewards only (``td_error="original"``).

    The prior never changes. Where the weight is 0 the actor is trained exactly as without a prior; where it is 1, AE2R
    is E2R. The bonus in the reward is not the business of this loss but of :class:`~torchrl_priors.PriorBonus`, before
    the advantage is estimated: give both the same ``method``, ``bonus_coeff`` and ``centering``.

    What the prior weight regresses on is a choice, ``weight_target``:

    * ``"td"`` (the paper): :math:`y = E_t = V(s_t) - R_t - \gamma(1-\mathrm{term}_t)V(s_{t+1})`, with :math:`R` the raw
      reward, and :math:`\ell` the log-probability in the bonus: :math:`\log\pi_0(a_{t+1}|s_{t+1})` for AE2R (0 where
      the episode terminated at :math:`t`), :math:`\log\pi_0(a_t|s_t)` for AER. :math:`\omega` is that of the same
      state.
    * ``"advantage"`` (beyond the paper): :math:`y` is the advantage on raw rewards of :math:`a_t` at :math:`s_t`, and
      :math:`\ell = \log\pi_0(a_t|s_t) + H^X_{s_t}(\pi\|\pi_0)`.

    .. note:: Adam is invariant to the scale of a loss, so ``weight_coeff`` hardly matters under it: to slow the prior
        weight down, put it in a parameter group with a learning rate of its own.

    Args:
        actor_network (ProbabilisticTensorDictSequential): the student, the very module of the policy loss beside this.
        prior (ActionPrior): the teacher, or anything with ``in_keys`` and ``get_dist(tensordict)``; it is evaluated
            without gradient.
        prior_weight (TensorDictModule, optional): :math:`\omega`, e.g. :class:`~torchrl_priors.PriorWeight`, writing
            ``[*B, 1]``. Required by the adaptive methods; the others have :math:`\omega = 1` and do not use it.
        critic_network (TensorDictModule, optional): the critic behind :math:`y`, used by the adaptive methods only.
            With ``td_error="original"`` one that nothing else trains; with ``"shaped"`` that of the policy loss, which
            this loss leaves alone. With ``weight_target="advantage"`` it can be left out if the batch has a
            ``raw_advantage``, ``[*B, 1]``.

    Keyword Args:
        method (str or MethodSpec): a key of :data:`~torchrl_priors.METHODS`. ``"none"``, ``"er"`` and ``"kl_penalty"``
            have no loss here. Defaults to ``"ae2r"``.
        td_error (str): ``"original"`` (a critic that never sees the bonus) or ``"shaped"``. Defaults to ``"original"``.
        weight_target (str, optional): ``"td"``, ``"advantage"``, or ``"none"`` for a weight that this loss only reads.
            Defaults to ``None``: the method's.
        centering (str): ``"none"``, or ``"prior"`` or ``"policy"`` if the bonus is centred; the centre is read from the
            batch. Defaults to ``"none"``.
        bonus_coeff (float): coefficient of the bonus in the shaped reward. Defaults to 1.0.
        aux_coeff (float, optional): coefficient of ``loss_prior``. Defaults to ``None``: the method's, 0.3 of
            ``"pull"`` and 1.0 of the others.
        kl_share (float, optional): how much of the student's entropy is given back, :math:`\eta` in
            :math:`H^X(\pi\|\pi_0)-\eta H(\pi)`: from 0, the cross-entropy, to 1, the divergence
            :math:`\mathrm{KL}(\pi\|\pi_0)`. A buffer, as the coefficients are; not for methods that average over the
            teacher's actions. Defaults to ``None``: there is no such term.
        weight_coeff (float): coefficient of ``loss_prior_weight``. Defaults to 1.0.
        critic_coeff (float): coefficient of ``loss_prior_critic``. Defaults to 1.0.
        gamma (float): discount. Defaults to 0.99.
        num_samples (int, optional): samples per state where the cross-entropy has no closed form, see
            :func:`~torchrl_priors.cross_entropy`. Defaults to ``None``.
        reduction (str, optional): ``"none"``, ``"mean"`` or ``"sum"``. Defaults to ``"mean"``.
        loss_critic_type (str): ``"l1"``, ``"l2"`` or ``"smooth_l1"``. Defaults to ``"l2"``.
        prior_in_batch (bool): read the parameters of the prior's distribution from the batch instead of running the
            prior, where ``PriorLogProb(prior, ..., keep_params=True)`` left them: once a rollout, not once a minibatch.
            It needs an :class:`~torchrl_priors.ActionPrior`. Defaults to ``False``.
        functional (bool): whether the networks are functionalised, as in TorchRL's losses; without it they can't share
            layers with the student. Defaults to ``True``.

    The batch must hold ``prior_log_prob`` or ``("next", "prior_log_prob")``, ``[*B, 1]``, as
    :class:`~torchrl_priors.PriorLogProb` writes them (``prior_center`` too if centred), ``("next", "reward")`` and
    ``("next", "terminated")``: :attr:`in_keys` lists what an instance reads, ``set_keys`` renames it.

    The output also has detached means for logging: ``"prior_cross_entropy"``, ``"prior_kl"``
    (:math:`\mathrm{KL}(\pi\|\pi_0)`), ``"prior_weight"``, ``"prior_td_error"`` (on raw rewards) and, if the batch has
    one, ``"prior_bonus"``. What does not apply is absent, never NaN: :attr:`out_keys` lists what an instance writes.

    Raises:
        ValueError: an unknown option, or one that lacks the network it needs.
        TypeError: a prior without ``get_dist``.
        KeyError: at call, the batch lacks an entry.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from tensordict.nn import TensorDictModule
        >>> from torchrl.modules import ProbabilisticActor, ValueOperator
        >>> from torchrl_priors.objectives import AE2RLoss
        >>> def actor():
        ...     net = TensorDictModule(torch.nn.Linear(3, 2), in_keys=["observation"], out_keys=["logits"])
        ...     return ProbabilisticActor(net, in_keys=["logits"], distribution_class=torch.distributions.Categorical)
        >>> weight = torch.nn.Sequential(torch.nn.Linear(3, 1), torch.nn.Sigmoid())
        >>> weight = TensorDictModule(weight, in_keys=["observation"], out_keys=["prior_weight"])
        >>> critic = ValueOperator(torch.nn.Linear(3, 1), in_keys=["observation"])
        >>> loss = AE2RLoss(actor(), actor(), weight, critic)
        >>> data = TensorDict(
        ...     {
        ...         "observation": torch.randn(5, 3),
        ...         "prior_log_prob": -torch.ones(5, 1),
        ...         "next": {
        ...             "observation": torch.randn(5, 3),
        ...             "prior_log_prob": -torch.ones(5, 1),
        ...             "reward": torch.randn(5, 1),
        ...             "terminated": torch.zeros(5, 1, dtype=torch.bool),
        ...         },
        ...     },
        ...     [5],
        ... )
        >>> losses = loss(data)
        >>> sorted(key for key in losses.keys() if key.startswith("loss_"))
        ['loss_prior', 'loss_prior_critic', 'loss_prior_weight']
        >>> sum(value for key, value in losses.items() if key.startswith("loss_")).backward()

    """

    @dataclass
    class _AcceptedKeys:
        """The keys that ``set_keys`` can rename, and their defaults.

        Attributes:
            reward (NestedKey): the raw reward, under ``"next"``.
            terminated (NestedKey): the end of an episode, not its truncation, under ``"next"``.
            value (NestedKey): what the critic writes.
            prior_weight (NestedKey): what the prior weight writes.
            prior_log_prob (NestedKey): log pi0(a|s), at the root and under ``"next"``.
            prior_center (NestedKey): what centres the bonus, at the root and under ``"next"``.
            prior_bonus (NestedKey): the bonus under ``"next"``, if any, for logging.
            raw_advantage (NestedKey): an advantage on raw rewards, if any, for ``weight_target="advantage"``.
        """

        reward: NestedKey = "reward"
        terminated: NestedKey = "terminated"
        value: NestedKey = "state_value"
        prior_weight: NestedKey = "prior_weight"
        prior_log_prob: NestedKey = "prior_log_prob"
        prior_center: NestedKey = "prior_center"
        prior_bonus: NestedKey = "prior_bonus"
        raw_advantage: NestedKey = "raw_advantage"

    default_keys = _AcceptedKeys
    tensor_keys: _AcceptedKeys
    _schedulable_buffers: ClassVar[frozenset[str]] = frozenset(
        {"bonus_coeff", "aux_coeff", "kl_share", "weight_coeff", "critic_coeff", "gamma"}
    )

    actor_network: TensorDictModule
    actor_network_params: TensorDictParams | None
    target_actor_network_params: TensorDictParams | None
    prior_weight: TensorDictModule
    prior_weight_params: TensorDictParams | None
    target_prior_weight_params: TensorDictParams | None
    critic_network: TensorDictModule
    critic_network_params: TensorDictParams | None
    target_critic_network_params: TensorDictParams | None

    def __init__(
        self,
        actor_network: ProbabilisticTensorDictSequential,
        prior: TensorDictModuleBase,
        prior_weight: TensorDictModule | None = None,
        critic_network: TensorDictModule | None = None,
        *,
        method: str | MethodSpec = "ae2r",
        td_error: Literal["original", "shaped"] = "original",
        weight_target: Literal["td", "advantage", "none"] | None = None,
        centering: Literal["none", "prior", "policy"] = "none",
        bonus_coeff: float = 1.0,
        aux_coeff: float | None = None,
        kl_share: float | None = None,
        weight_coeff: float = 1.0,
        critic_coeff: float = 1.0,
        gamma: float = 0.99,
        num_samples: int | None = None,
        reduction: Literal["none", "mean", "sum"] | None = None,
        loss_critic_type: Literal["l1", "l2", "smooth_l1"] = "l2",
        prior_in_batch: bool = False,
        functional: bool = True,
    ):
        spec = get_method(method) if isinstance(method, str) else method
        weight_target = spec.weight_target if weight_target is None else weight_target
        check_option("td_error", td_error, ("original", "shaped"))
        check_option("weight_target", weight_target, ("td", "advantage", "none"))
        check_option("centering", centering, ("none", "prior", "policy"))
        check_option("loss_critic_type", loss_critic_type, ("l1", "l2", "smooth_l1"))
        if not hasattr(prior, "get_dist"):
            raise TypeError(f"The prior must be an ActionPrior or a policy, got {type(prior).__name__}.")
        if prior_in_batch and not isinstance(prior, ActionPrior):
            raise ValueError(f"prior_in_batch=True needs an ActionPrior as prior, got {type(prior).__name__}.")
        for name, share in (("gamma", gamma), ("kl_share", kl_share)):
            if share is not None and not 0.0 <= share <= 1.0:
                raise ValueError(f"{name} must be in [0, 1], got {share}.")
        if kl_share is not None and spec.cross_entropy == "teacher":
            raise ValueError(f"kl_share is for a cross-entropy of the student's actions: {method!r} has the teacher's.")
        if spec.adaptive:
            if prior_weight is None:
                raise ValueError(f"The method {method!r} learns a prior weight: pass prior_weight.")
            if weight_target == "td" and critic_network is None:
                whose = "of its own, trained on raw rewards," if td_error == "original" else "(that of the policy loss)"
                raise ValueError(
                    f"td_error={td_error!r} needs a critic {whose} behind the TD error: pass critic_network."
                )
            if weight_target == "td" and spec.bonus == "none":
                raise ValueError("weight_target='td' weighs the bonus, which this method lacks: use 'advantage'.")
            if (
                weight_target == "advantage"
                and td_error == "shaped"
                and spec.bonus != "none"
                and critic_network is not None
            ):
                raise ValueError(
                    "weight_target='advantage' asks for the advantage on raw rewards, but with td_error='shaped' the"
                    " critic has seen the bonus: use td_error='original', or leave the critic out and write a"
                    " 'raw_advantage' in the batch."
                )

        self._functional = functional
        self._in_keys: list[NestedKey] | None = None
        self._out_keys: list[NestedKey] | None = None
        super().__init__()
        self.spec = spec
        self.td_error = td_error
        self.weight_target = weight_target
        self.centering = centering
        self.num_samples = num_samples
        self.reduction = "mean" if reduction is None else reduction
        self.loss_critic_type = loss_critic_type

        self._set_network("actor_network", actor_network)
        self.prior = prior
        self.prior_in_batch = prior_in_batch
        student = list(actor_network.parameters())
        trained = {"prior_weight": prior_weight, "critic_network": critic_network if td_error == "original" else None}
        for name, network in trained.items() if spec.adaptive and not functional else ():
            if network is not None and not set(student).isdisjoint(network.parameters()):
                raise ValueError(
                    f"functional=False, and {name} shares parameters with actor_network: its loss would train the"
                    " student. Use functional=True, which detaches them, or networks of their own."
                )
        self._set_network("prior_weight", prior_weight if spec.adaptive else None, apart_from=student)
        self._set_network("critic_network", critic_network if spec.adaptive else None, apart_from=student)
        self._has_critic = spec.adaptive and critic_network is not None
        self._trains_critic = self._has_critic and td_error == "original"
        self._needs_cross_entropy = spec.auxiliary or (spec.adaptive and weight_target == "advantage")

        device = next((parameter.device for parameter in self.parameters()), None)
        for name, value in (
            ("bonus_coeff", bonus_coeff),
            ("aux_coeff", spec.aux_coeff if aux_coeff is None else aux_coeff),
            ("weight_coeff", weight_coeff),
            ("critic_coeff", critic_coeff),
            ("gamma", gamma),
        ):
            self.register_coeff_buffer(name, value, device=device)
        self._shares_entropy = kl_share is not None
        if kl_share is not None:
            self.register_coeff_buffer("kl_share", kl_share, device=device)
        if spec.adaptive and prior_weight is not None:
            self.set_keys(prior_weight=out_key(prior_weight, self.tensor_keys.prior_weight))
        if self._has_critic and critic_network is not None:
            self.set_keys(value=out_key(critic_network, self.tensor_keys.value))

    def _set_network(self, name: str, network: TensorDictModule | None, apart_from: list[Tensor] | None = None) -> None:
        # one without parameters is used as it is: what it learns, in buffers, must reach it also after a move
        if network is not None and self._functional and any(True for _ in network.parameters()):
            # layers shared with the student are the student's to train: `apart_from` enters detached
            self.convert_to_functional(network, name, compare_against=apart_from)
        else:
            setattr(self, name, network)
            setattr(self, f"{name}_params", None)

    @property
    def functional(self) -> bool:
        """Whether the networks are functionalised."""
        return self._functional

    def _forward_value_estimator_keys(self, **kwargs: object) -> None:
        self._in_keys = None

    @property
    def in_keys(self) -> list[NestedKey]:
        """What the losses of this instance read from the batch (``prior_bonus`` is read for logging if it is there)."""
        if self._in_keys is None:
            keys: list[NestedKey] = []
            names = self.tensor_keys
            if self._needs_cross_entropy:
                keys += self.actor_network.in_keys
                if self.prior_in_batch:
                    keys += self.prior.out_keys
                else:
                    keys += [*self.prior.in_keys, *getattr(self.prior, "draw_keys", ())]
            if self.spec.adaptive:
                shifted = self.weight_target == "td" and self.spec.bonus == "next"
                keys += self.prior_weight.in_keys if self.spec.auxiliary or not shifted else []
                keys += [under_next(key) for key in self.prior_weight.in_keys] if shifted else []
                where = under_next if shifted else unravel_key
                if self.weight_target != "none":
                    keys.append(where(names.prior_log_prob))
                if self.weight_target == "td" and self.centering != "none":
                    keys.append(where(names.prior_center))
                if self.weight_target == "advantage":
                    keys.append(names.raw_advantage)
                if self._has_critic:
                    keys += [*self.critic_network.in_keys, *(under_next(key) for key in self.critic_network.in_keys)]
                    keys.append(under_next(names.reward))
                if self._has_critic or shifted:
                    keys.append(under_next(names.terminated))
            self._in_keys = list(dict.fromkeys(keys))
        return self._in_keys

    @in_keys.setter
    def in_keys(self, values: list[NestedKey]) -> None:
        self._in_keys = values

    @property
    def out_keys(self) -> list[NestedKey]:
        """What this instance writes, losses first (``prior_bonus`` comes on top if the batch has it)."""
        if self._out_keys is None:
            keys: list[NestedKey] = []
            keys += ["loss_prior"] if self.spec.auxiliary else []
            keys += ["loss_prior_weight"] if self.spec.adaptive and self.weight_target != "none" else []
            keys += ["loss_prior_critic"] if self._trains_critic else []
            keys += ["prior_cross_entropy", "prior_kl"] if self._needs_cross_entropy else []
            keys += ["prior_weight"] if self.spec.adaptive else []
            keys += ["prior_td_error"] if self._has_critic else []
            self._out_keys = keys
        return self._out_keys

    @out_keys.setter
    def out_keys(self, values: list[NestedKey]) -> None:
        self._out_keys = values

    @dispatch(auto_batch_size=False)  # no guess from the shapes: a single observation has no trailing 1 to tell by
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """The losses of a batch of any batch size, and what is worth logging; the batch is left as it is."""
        return self._losses(tensordict)

    def _losses(self, tensordict: TensorDictBase, dist: d.Distribution | None = None) -> TensorDictBase:
        """See :meth:`forward`; ``dist`` is the student's, if it is at hand."""
        losses: dict[str, Tensor] = {}
        logs: dict[str, Tensor] = {}
        weight: Tensor | None = None
        entropy: Tensor | None = None
        auxiliary: Tensor | None = None
        if self._needs_cross_entropy:
            entropy, auxiliary, logs["prior_kl"] = self._cross_entropy(tensordict, dist)
            logs["prior_cross_entropy"] = auxiliary
        if self.spec.adaptive:
            delta: Tensor | None = None
            if self._has_critic:
                delta, loss_critic = self._td_error(tensordict)
                logs["prior_td_error"] = delta
                if loss_critic is not None:
                    losses["loss_prior_critic"] = self.critic_coeff * loss_critic
            if self.weight_target == "advantage":
                weight, loss_weight = self._regress_on_advantage(tensordict, delta, entropy)
            elif self.weight_target == "td":
                weight, loss_weight = self._regress_on_td_error(tensordict, delta)
            else:
                weight, loss_weight = self._evaluate("prior_weight", tensordict, self.tensor_keys.prior_weight), None
            logs["prior_weight"] = weight
            if loss_weight is not None:
                losses["loss_prior_weight"] = self.weight_coeff * loss_weight
        if self.spec.auxiliary and auxiliary is not None:
            losses["loss_prior"] = self.aux_coeff * (auxiliary if weight is None else weight.detach() * auxiliary)
        bonus = tensordict.get(under_next(self.tensor_keys.prior_bonus), None)
        if bonus is not None:
            logs["prior_bonus"] = bonus

        masked = any(tensordict.get(key, None) is not None for key in self._loss_mask_keys())
        steps = tensordict if masked else None
        reduced = {name: self._reduce_loss(value, steps).squeeze(-1) for name, value in losses.items()}
        for name, value in logs.items():
            reduced[name] = self._reduce_loss(value.detach(), steps, reduction="mean")
        out = TensorDict(reduced)
        self._clear_weakrefs(tensordict, out, "actor_network_params", "prior_weight_params", "critic_network_params")
        return out

    def _cross_entropy(self, tensordict: TensorDictBase, dist: d.Distribution | None) -> tuple[Tensor, Tensor, Tensor]:
        """H^X(pi || pi0), that of the loss, with a gradient for the actor if it is one, and KL(pi || pi0) without."""
        with torch.no_grad():
            prior_dist = self._prior_dist(tensordict)
        with contextlib.nullcontext() if self.spec.auxiliary else torch.no_grad():
            if dist is None:
                with self._params_of("actor_network"):
                    dist = self.actor_network.get_dist(tensordict.copy())
            entropy, kl = cross_entropy_and_kl(dist, prior_dist, num_samples=self.num_samples)
            teacher = self.spec.cross_entropy == "teacher"
            auxiliary = entropy
            if teacher:
                auxiliary = cross_entropy_of_advice(prior_dist, dist, num_samples=self.num_samples)
            elif self._shares_entropy:
                divergence = kl_divergence(dist, prior_dist, num_samples=self.num_samples)
                auxiliary = torch.lerp(entropy, divergence, self.kl_share)
        ndim = tensordict.ndim or entropy.ndim  # what dispatch makes has no batch size
        return joint(entropy, ndim), joint(auxiliary, ndim), joint(kl, ndim)

    def _prior_dist(self, tensordict: TensorDictBase) -> d.Distribution:
        if not self.prior_in_batch:
            return self.prior.get_dist(tensordict.copy())
        params = [tensordict.get(key, None) for key in self.prior.out_keys]
        if any(value is None for value in params):
            raise KeyError(
                f"prior_in_batch=True, but the batch lacks some of {self.prior.out_keys}, the parameters of the prior's"
                " distribution: run PriorLogProb(prior, ..., keep_params=True) on it before the loss."
            )
        return self.prior.build_dist(dict(zip(self.prior.param_names, params, strict=True)))

    def _td_error(self, tensordict: TensorDictBase) -> tuple[Tensor, Tensor | None]:
        """The TD error on raw rewards, detached, and the elementwise loss of the raw critic if it is trained here."""
        reward, terminated = (
            self._get(tensordict, under_next(key)) for key in (self.tensor_keys.reward, self.tensor_keys.terminated)
        )
        with contextlib.nullcontext() if self._trains_critic else torch.no_grad():
            value = self._evaluate("critic_network", tensordict, self.tensor_keys.value)
        with torch.no_grad():
            next_value = self._evaluate("critic_network", tensordict.get("next"), self.tensor_keys.value)
            target = td_residual(torch.zeros_like(next_value), reward, next_value, terminated, self.gamma)
            delta = target - value
        if not self._trains_critic:
            return delta, None
        return delta, distance_loss(target, value, loss_function=self.loss_critic_type)

    def _regress_on_advantage(
        self, tensordict: TensorDictBase, delta: Tensor | None, entropy: Tensor | None
    ) -> tuple[Tensor, Tensor]:
        """The weight at s_t and its elementwise loss, with the advantage as its target."""
        assert entropy is not None
        target = tensordict.get(self.tensor_keys.raw_advantage, delta)
        if target is None:
            raise KeyError(
                f"weight_target='advantage' found neither {self.tensor_keys.raw_advantage!r} in the batch nor a critic"
                " of raw rewards: write the one or pass critic_network."
            )
        weight = self._evaluate("prior_weight", tensordict, self.tensor_keys.prior_weight)
        signal = alignment(self._get(tensordict, self.tensor_keys.prior_log_prob), entropy.detach())
        return weight, weight_regression(target.detach(), weight, signal.detach())

    def _regress_on_td_error(self, tensordict: TensorDictBase, delta: Tensor | None) -> tuple[Tensor, Tensor]:
        """The weight at s_t (s_{t+1} where that at s_t is of no use), and its elementwise loss at the bonus' state."""
        assert delta is not None
        names = self.tensor_keys
        shifted = self.spec.bonus == "next"
        where, at = (under_next, tensordict.get("next")) if shifted else (unravel_key, tensordict)
        log_prob = self._get(tensordict, where(names.prior_log_prob))
        center = 0.0 if self.centering == "none" else self._get(tensordict, where(names.prior_center))
        signal = prior_bonus(self.bonus_coeff, log_prob, center)
        if shifted:  # what follows an end may be no observation (NaN where environments reset themselves)
            at = keep_where(~self._get(tensordict, under_next(names.terminated)), at.select(*self.prior_weight.in_keys))
        weight = self._evaluate("prior_weight", at, names.prior_weight)
        if shifted:
            signal = torch.where(self._get(tensordict, under_next(names.terminated)), torch.zeros_like(signal), signal)
        loss = weight_regression(-delta, weight, signal.detach())
        if shifted and self.spec.auxiliary:
            with torch.no_grad():
                weight = self._evaluate("prior_weight", tensordict, names.prior_weight)
        return weight, loss

    def _evaluate(self, name: str, tensordict: TensorDictBase, out_key: NestedKey) -> Tensor:
        network = getattr(self, name)
        with self._params_of(name):
            value = network(tensordict.select(*network.in_keys, strict=False)).get(out_key, None)
        if value is None:
            raise KeyError(f"The {name} writes {network.out_keys}, but no {out_key!r}: set_keys says where to find it.")
        return value

    def _params_of(self, name: str) -> contextlib.AbstractContextManager:
        if getattr(self, f"{name}_params") is None:
            return contextlib.nullcontext()
        return getattr(self, f"{name}_params").to_module(getattr(self, name), preserve_module_state=False)

    def _get(self, tensordict: TensorDictBase, key: NestedKey) -> Tensor:
        value = tensordict.get(key, None)
        if value is None:
            raise KeyError(
                f"The batch has no {key!r}: run PriorLogProb on it before the loss, or rename it by set_keys."
            )
        return value

    def reset_parameters_recursive(self) -> None:
        """Reset the networks that this loss trains; never the prior, nor a critic that belongs to another loss."""
        for name in ("actor_network", "prior_weight", "critic_network" if self._trains_critic else None):
            network = None if name is None else getattr(self, name)
            if network is not None and any(True for _ in network.parameters()):
                self._reset_module_parameters(name, network)
