"""Learning from several teachers, with a weight for each."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from tensordict import NestedKey, TensorDict, TensorDictBase
from tensordict.nn import ProbabilisticTensorDictSequential, TensorDictModule, dispatch
from tensordict.utils import unravel_key
from torch import distributions as d
from torchrl.objectives import LossModule

from torchrl_priors.methods import MethodSpec, get_method
from torchrl_priors.prior_weight import PriorWeight
from torchrl_priors.priors import Prior

from .ae2r import AE2RLoss
from .selected import SelectedOutput


class MultiTeacherLoss(SelectedOutput, LossModule):
    r"""An :class:`AE2RLoss` for each of several teachers, with one prior weight :math:`\omega_k(s)` per teacher.

    .. math::
        \sum_k c_{aux}\,\mathrm{sg}[\omega_k(s_t)]\,H^X_{s_t}(\pi\|\pi_k) + c_\omega\,(y - \omega_k(s)\,\ell_k)^2

    It extends the loss of Centa & Preux, "Soft Action Priors: Towards Robust Policy Transfer", which has one teacher.
    Each weight regresses on its own, as if its teacher were alone: what one teacher is trusted does not depend on the
    company it keeps, and two equal teachers count twice. Scale ``aux_coeff`` and ``bonus_coeff`` by 1/K for a mean.
    One critic of raw rewards serves all weights, and is trained once.

    Args:
        actor_network (ProbabilisticTensorDictSequential): the student.
        priors (sequence of Prior): the teachers, each with a ``namespace`` of its own, its name.
        prior_weights (sequence of PriorWeight, optional): one for each; ``None`` for methods without.
        critic_network (TensorDictModule, optional): as in :class:`AE2RLoss`.

    Keyword Args:
        method (str or MethodSpec): as in :class:`AE2RLoss`. Defaults to ``"ae2r"``.
        **kwargs: further keyword arguments of :class:`AE2RLoss`, the same for all teachers.

    The batch must hold what :func:`~torchrl_priors.prior_transforms` write for it. ``set_keys`` renames ``reward``,
    ``terminated``, ``value`` and ``raw_advantage`` for all teachers. The output is that of :class:`AE2RLoss`, its names
    followed by the teacher's: ``"loss_prior_expert"``, ``"loss_prior_weight_expert"``, ``"prior_weight_expert"``, ...;
    and, once, ``"loss_prior_critic"`` and ``"prior_td_error"``. Coefficients are those of the :class:`AE2RLoss` of each
    teacher, in ``losses``: ``loss.losses[0].aux_coeff = 0.5``. :class:`ClipPPOPriorLoss` takes it as it takes one loss.

    Raises:
        ValueError: two teachers share a namespace, there is not one weight for each, or as in :class:`AE2RLoss`.

    Examples:
        >>> from torchrl.modules import ProbabilisticActor
        >>> from torchrl_priors import UniformPrior
        >>> net = TensorDictModule(torch.nn.Linear(3, 4), in_keys=["observation"], out_keys=["logits"])
        >>> actor = ProbabilisticActor(net, in_keys=["logits"], distribution_class=torch.distributions.Categorical)
        >>> teachers = [UniformPrior(4, namespace="expert"), UniformPrior(4, namespace="novice")]
        >>> loss = MultiTeacherLoss(actor, teachers, method="kickstart")
        >>> sorted(loss(TensorDict(observation=torch.zeros(5, 3), batch_size=[5])).keys())
        ['loss_prior_expert', 'loss_prior_novice', 'prior_cross_entropy_expert', 'prior_cross_entropy_novice',
         'prior_kl_expert', 'prior_kl_novice']
    """

    _AcceptedKeys = AE2RLoss._AcceptedKeys
    default_keys = _AcceptedKeys
    _shared = ("loss_prior_critic", "prior_td_error")
    _renamed = ("reward", "terminated", "value", "raw_advantage")

    def __init__(
        self,
        actor_network: ProbabilisticTensorDictSequential,
        priors: Sequence[Prior],
        prior_weights: Sequence[PriorWeight] | None = None,
        critic_network: TensorDictModule | None = None,
        *,
        method: str | MethodSpec = "ae2r",
        **kwargs: Any,
    ) -> None:
        spec = get_method(method) if isinstance(method, str) else method
        weights = _weight_of_each(priors, prior_weights, adaptive=spec.adaptive)
        super().__init__()
        self.spec = spec
        losses: list[AE2RLoss] = []
        for prior, weight in zip(priors, weights, strict=True):
            loss = AE2RLoss(actor_network, prior, weight, critic_network, method=spec, **kwargs)
            keys = ("prior_log_prob", "prior_bonus")
            loss.set_keys(**{key: unravel_key((prior.namespace, key)) for key in keys})
            if losses:
                loss.trains_critic = False  # one critic serves all weights, and the first loss trains it
                # one set of parameters, so that a move to another device or dtype keeps them one
                loss.actor_network_params = losses[0].actor_network_params
                loss.critic_network_params = losses[0].critic_network_params
            losses.append(loss)
        self.losses = torch.nn.ModuleList(losses)
        self.reduction = losses[0].reduction

    @property
    def teachers(self) -> list[AE2RLoss]:
        """The loss of each teacher."""
        return list(self.losses)  # type: ignore[arg-type]

    def set_keys(self, **kwargs: Any) -> None:
        """Renames an entry for all teachers.

        Raises:
            ValueError: another key than ``reward``, ``terminated``, ``value`` and ``raw_advantage``.
        """
        if unknown := kwargs.keys() - set(self._renamed):
            raise ValueError(
                f"MultiTeacherLoss has no key named {', '.join(sorted(unknown))} for all teachers: expected"
                f" {', '.join(self._renamed)}."
            )
        super().set_keys(**kwargs)
        for loss in self.teachers:
            loss.set_keys(**kwargs)

    def _forward_value_estimator_keys(self, **kwargs: object) -> None:
        pass

    @property
    def in_keys(self) -> list[NestedKey]:
        """What the losses read from the batch."""
        return list(dict.fromkeys(key for loss in self.teachers for key in loss.in_keys))

    @property
    def out_keys(self) -> list[NestedKey]:
        """What this instance writes."""
        if self._selected is not None:
            return self._selected
        return list(dict.fromkeys(self._name(key, loss) for loss in self.teachers for key in loss.out_keys))

    def _name(self, key: str, loss: AE2RLoss) -> str:
        return key if key in self._shared else f"{key}_{_flat(loss.prior.namespace)}"

    @dispatch(auto_batch_size=False)
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """The losses of a batch, and what is worth logging; the batch is left as it is."""
        return self.only_selected(self.losses_of(tensordict))

    def losses_of(self, tensordict: TensorDictBase, dist: d.Distribution | None = None) -> TensorDictBase:
        """See :meth:`forward`; ``dist`` is the student's distribution, if it is at hand."""
        out: dict[str, Any] = {}
        for loss in self.teachers:
            loss.loss_mask_key, loss.reduction = self.loss_mask_key, self.reduction
            for key, value in loss.losses_of(tensordict, dist).items():
                out.setdefault(self._name(key, loss), value)
        return TensorDict(out)

    def reset_parameters_recursive(self) -> None:
        """Reset the networks that these losses train; never a prior."""
        for loss in self.teachers:
            loss.reset_parameters_recursive()


def _flat(namespace: NestedKey) -> str:
    return "_".join(namespace) if isinstance(namespace, tuple) else namespace


def _weight_of_each(
    priors: Sequence[Prior], prior_weights: Sequence[PriorWeight] | None, *, adaptive: bool
) -> list[PriorWeight | None]:
    """The weight of each teacher, ``None`` for methods without; refuses teachers that would share entries."""
    names = [prior.namespace for prior in priors]
    if not names or len(set(map(_flat, names))) < len(names):
        raise ValueError(f"Each of several teachers needs a namespace of its own, got {names}.")
    if not adaptive:
        return [None] * len(names)
    weights = [] if prior_weights is None else list(prior_weights)
    if len(weights) != len(names) or len({id(weight) for weight in weights}) < len(weights):
        raise ValueError(f"Each of the {len(names)} teachers needs a prior weight of its own, got {len(weights)}.")
    return list(weights)
