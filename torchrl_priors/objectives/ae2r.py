"""The losses that a soft action prior adds to a policy-gradient algorithm."""

from __future__ import annotations

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
from tensordict.utils import NestedKey, expand_as_right
from torch import distributions as d
from torch.compiler import is_compiling

from torchrl_priors.keys import check_option, out_key, under_next, warn_of_another_teacher, without_padding
from torchrl_priors.methods import MethodSpec, get_method
from torchrl_priors.priors import Prior

from .networks_loss import NetworksLoss
from .selected import SelectedOutput
from .terms import AuxiliaryTerm, Found, RawCriticTerm, Term, WeightTerm
from .wiring import Wiring, check_teacher

#: The losses, each with its coefficient, and what is logged, in the order of the output.
_LOSSES = {"loss_prior_critic": "critic_coeff", "loss_prior_weight": "weight_coeff", "loss_prior": "aux_coeff"}
_LOGS = ("prior_kl", "prior_cross_entropy", "prior_td_error", "prior_weight", "prior_bonus")


class AE2RLoss(SelectedOutput, NetworksLoss):
    r"""Auxiliary loss and prior-weight loss of (adaptive) entropy regularisation towards a soft action prior.

    Centa & Preux, "Soft Action Priors: Towards Robust Policy Transfer". It stands beside any policy-gradient loss and
    adds, with :math:`\pi` the student, :math:`\pi_0` the prior and :math:`\omega(s)\in[0,1]` the prior weight,

    * ``"loss_prior"``, :math:`c_{aux}\,\mathrm{sg}[\omega(s_t)]\,H^X_{s_t}(\pi\|\pi_0)`, which reaches the actor only;
      being a cross-entropy and no divergence, it pulls towards the prior's best action, not to its entropy (that of
      ``"pull"``, ``"aligned"`` and ``"annealed_kickstart"`` is :math:`H^X_{s_t}(\pi_0\|\pi)`, which pulls towards
      the prior itself);
    * ``"loss_prior_weight"``, :math:`c_\omega\,(y - \omega(s)\,\ell)^2`, which reaches the prior weight only;
    * ``"loss_prior_critic"``, :math:`c_V\,(V(s_t) - \mathrm{sg}[R_t + \gamma(1-\mathrm{term}_t)V(s_{t+1})])^2`, which
      reaches the critic of raw rewards only (``td_error="original"``).

    The prior never changes. Where the weight is 0 the actor is trained exactly as without a prior; where it is 1, AE2R
    is E2R. The bonus in the reward is not the business of this loss but of :class:`~torchrl_priors.PriorBonus`, before
    the advantage is estimated: give both the same ``method`` and ``bonus_coeff``.

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
        prior (Prior): the teacher, or anything with ``in_keys`` and ``get_dist(tensordict)``; it is evaluated
            without gradient.
        prior_weight (TensorDictModule, optional): :math:`\omega`, e.g. :class:`~torchrl_priors.PriorWeight`, writing
            ``[*B, 1]``. Required by the adaptive methods; the others have :math:`\omega = 1` and do not use it.
        critic_network (TensorDictModule, optional): the critic behind :math:`y`, used by the adaptive methods only.
            With ``td_error="original"`` one that nothing else trains; with ``"shaped"`` that of the policy loss, which
            this loss leaves alone. With ``weight_target="advantage"`` it can be left out if the batch has a
            ``raw_advantage``, ``[*B, 1]``.

    Keyword Args:
        method (str or MethodSpec): a key of :data:`~torchrl_priors.methods.METHODS`. ``"none"``, ``"er"`` and
            ``"kl_penalty"`` have no loss here. Defaults to ``"ae2r"``.
        td_error (str): ``"original"`` (a critic that never sees the bonus) or ``"shaped"``. Defaults to ``"original"``.
        weight_target (str, optional): ``"td"``, ``"advantage"``, or ``"none"`` for a weight that this loss only reads.
            Defaults to ``None``: the method's.
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
            :func:`~torchrl_priors.distributions.cross_entropy`. Defaults to ``None``.
        reduction (str, optional): ``"none"``, ``"mean"`` or ``"sum"``. Defaults to ``"mean"``.
        prior_in_batch (bool): read the parameters of the prior's distribution from the batch instead of running the
            prior, where ``PriorLogProb(prior, ..., keep_params=True)`` left them: once a rollout, not once a minibatch.
            It needs a :class:`~torchrl_priors.Prior`. Defaults to ``False``.
        functional (bool): whether the networks are functionalised, as in TorchRL's losses; without it they can't share
            layers with the student. Defaults to ``True``.

    The batch must hold ``prior_log_prob`` or ``("next", "prior_log_prob")``, ``[*B, 1]``, as
    :class:`~torchrl_priors.PriorLogProb` writes them, ``("next", "reward")`` and ``("next", "terminated")``:
    :attr:`in_keys` lists what an instance reads, ``set_keys`` renames it.

    The output also has detached means for logging: ``"prior_cross_entropy"``, ``"prior_kl"``
    (:math:`\mathrm{KL}(\pi\|\pi_0)`), ``"prior_weight"``, ``"prior_td_error"`` (on raw rewards) and, if the batch has
    one, ``"prior_bonus"``. What does not apply is absent, never NaN: :attr:`out_keys` lists what an instance writes.

    Raises:
        ValueError: an unknown option, or one that lacks the network it needs; the student as its own prior.
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
        >>> observation, advice = torch.randn(5, 3), -torch.ones(5, 1)
        >>> following = {"reward": torch.randn(5, 1), "terminated": torch.zeros(5, 1, dtype=torch.bool)}
        >>> following |= {"observation": observation, "prior_log_prob": advice}
        >>> data = TensorDict({"observation": observation, "next": following}, [5])
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
            prior_bonus (NestedKey): the bonus under ``"next"``, if any, for logging.
            raw_advantage (NestedKey): an advantage on raw rewards, if any, for ``weight_target="advantage"``.
        """

        reward: NestedKey = "reward"
        terminated: NestedKey = "terminated"
        value: NestedKey = "state_value"
        prior_weight: NestedKey = "prior_weight"
        prior_log_prob: NestedKey = "prior_log_prob"
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
        bonus_coeff: float = 1.0,
        aux_coeff: float | None = None,
        kl_share: float | None = None,
        weight_coeff: float = 1.0,
        critic_coeff: float = 1.0,
        gamma: float = 0.99,
        num_samples: int | None = None,
        reduction: Literal["none", "mean", "sum"] | None = None,
        prior_in_batch: bool = False,
        functional: bool = True,
    ):
        spec = get_method(method) if isinstance(method, str) else method
        weight_target = spec.weight_target if weight_target is None else weight_target
        check_option("td_error", td_error, ("original", "shaped"))
        check_option("weight_target", weight_target, ("td", "advantage", "none"))
        for name, share in (("gamma", gamma), ("kl_share", kl_share)):
            if share is not None and not 0.0 <= share <= 1.0:
                raise ValueError(f"{name} must be in [0, 1], got {share}.")
        if not hasattr(prior, "get_dist"):
            raise TypeError(f"The prior must be a Prior or a policy, got {type(prior).__name__}.")
        check_teacher(actor_network, prior)
        if prior_in_batch and not isinstance(prior, Prior):
            raise ValueError(
                f"prior_in_batch=True needs a Prior, got {type(prior).__name__}: ActionPrior(policy) makes it one."
            )

        super().__init__(functional=functional)
        self.spec = spec
        self.td_error = td_error
        self.weight_target = weight_target
        self.num_samples = num_samples
        self.reduction = "mean" if reduction is None else reduction

        self.set_network("actor_network", actor_network)
        self.prior = prior
        self.wiring = Wiring(self)
        self.register_load_state_dict_pre_hook(warn_of_another_teacher)
        self.prior_in_batch = prior_in_batch
        if not spec.adaptive:
            prior_weight = critic_network = None
        self.trains_critic = critic_network is not None and td_error == "original"
        student = list(actor_network.parameters())
        networks = (("prior_weight", prior_weight, True), ("critic_network", critic_network, self.trains_critic))
        for name, network, trained in networks:
            shares = network is not None and not set(student).isdisjoint(network.parameters())
            if shares and trained and not functional:
                raise ValueError(
                    f"functional=False, and {name} shares parameters with actor_network: its loss would train the"
                    " student. Use functional=True, which detaches them, or networks of their own."
                )
            self.set_network(name, network, apart_from=student)

        device = next((parameter.device for parameter in self.parameters()), None)
        for name, value in (
            ("bonus_coeff", bonus_coeff),
            ("aux_coeff", spec.aux_coeff if aux_coeff is None else aux_coeff),
            ("weight_coeff", weight_coeff),
            ("critic_coeff", critic_coeff),
            ("gamma", gamma),
            ("kl_share", kl_share),
        ):
            self.register_coeff_buffer(name, value, device=device)
        self.terms: list[Term] = []
        if spec.auxiliary or (spec.adaptive and weight_target == "advantage"):
            self.terms.append(AuxiliaryTerm(self))
        if critic_network is not None:
            self.terms.append(RawCriticTerm(self))
            self.set_keys(value=out_key(critic_network, self.tensor_keys.value))
        if spec.adaptive:
            self.terms.append(WeightTerm(self))
            self.set_keys(prior_weight=out_key(self.prior_weight, self.tensor_keys.prior_weight))

    @property
    def teachers(self) -> list[AE2RLoss]:
        """This loss, which is that of its one teacher."""
        return [self]

    @property
    def in_keys(self) -> list[NestedKey]:
        """What the losses of this instance read from the batch (``prior_bonus`` is read for logging if it is there)."""
        return list(dict.fromkeys(key for term in self.terms for key in term.in_keys))

    @property
    def out_keys(self) -> list[NestedKey]:
        """What this instance writes, losses first (``prior_bonus`` comes on top if the batch has it)."""
        if self._selected is not None:
            return self._selected
        written = {key for term in self.terms for key in term.out_keys}
        return [key for key in (*_LOSSES, *_LOGS) if key in written]

    @dispatch(auto_batch_size=False)  # no guess from the shapes: a single observation has no trailing 1 to tell by
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """The losses of a batch of any batch size, and what is worth logging; the batch is left as it is."""
        return self.only_selected(self.losses_of(tensordict))

    def losses_of(self, tensordict: TensorDictBase, dist: d.Distribution | None = None) -> TensorDictBase:
        """See :meth:`forward`; ``dist`` is the student's distribution, if it is at hand."""
        if not is_compiling():
            self.wiring.look(self, tensordict)
        masks = [tensordict.get(key, None) for key in self._loss_mask_keys()]
        masks = [mask for mask in masks if mask is not None]
        steps = tensordict if masks else None
        if masks and tensordict.ndim:
            valid = torch.ones(tensordict.batch_size, dtype=torch.bool, device=masks[0].device)
            for mask in masks:  # with or without a trailing 1
                valid = valid & expand_as_right(mask.reshape(mask.shape[: valid.ndim]), valid)
            tensordict, dist = without_padding(tensordict, self.in_keys, valid), None
        found: Found = {}
        for term in self.terms:
            term(tensordict, found, dist)
        if "loss_prior" in found and "prior_weight" in found:
            found["loss_prior"] = found["prior_weight"].detach() * found["loss_prior"]
        bonus = tensordict.get(under_next(self.tensor_keys.prior_bonus), None)
        if bonus is not None:
            found["prior_bonus"] = bonus

        out = TensorDict()
        for name, coeff in _LOSSES.items():
            if name in found:
                out.set(name, self._reduce_loss(getattr(self, coeff) * found[name], steps).squeeze(-1))
        for name in _LOGS:
            if name in found:
                out.set(name, self._reduce_loss(found[name].detach(), steps, reduction="mean"))
        self._clear_weakrefs(tensordict, out, "actor_network_params", "prior_weight_params", "critic_network_params")
        return out

    def reset_parameters_recursive(self) -> None:
        """Reset the networks that this loss trains; never the prior, nor a critic that belongs to another loss."""
        self.reset("actor_network", "prior_weight", *(["critic_network"] if self.trains_critic else []))
