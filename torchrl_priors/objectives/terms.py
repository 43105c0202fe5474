"""The three terms of :class:`AE2RLoss`: what each reads, what it writes, and its values at every step of a batch."""

from __future__ import annotations

import contextlib
from abc import ABC, abstractmethod
from typing import TYPE_CHECKING

import torch
from tensordict import NestedKey, TensorDictBase
from torch import Tensor
from torch import distributions as d
from torchrl.objectives.utils import distance_loss

from torchrl_priors.distributions import covers, cross_entropy_and_kl, cross_entropy_of_advice, kl_divergence
from torchrl_priors.functional import alignment, joint, prior_bonus, prior_weight_loss, td_residual
from torchrl_priors.keys import check_advice, next_step, read, under_next

if TYPE_CHECKING:
    from torchrl_priors.objectives.ae2r import AE2RLoss

#: What the terms found so far at each step, ``[*B, 1]``, by name: a later term reads what an earlier one wrote.
Found = dict[str, Tensor]
#: The student's H^X(pi || pi0), where the auxiliary loss may be another one.
STUDENT_CROSS_ENTROPY = "student_cross_entropy"
HINT = "run PriorLogProb on it before the loss, or rename it by set_keys"
OF_ENVIRONMENT = "an environment writes it, or rename it by set_keys"


class Term(ABC):
    """A term of a loss, which owns the networks and the names of the keys.

    Raises:
        ValueError: settings of the loss that don't go together, or a network that is missing.
    """

    def __init__(self, loss: AE2RLoss) -> None:
        self.loss = loss

    @property
    @abstractmethod
    def in_keys(self) -> list[NestedKey]:
        """What it reads from the batch."""

    @property
    @abstractmethod
    def out_keys(self) -> list[str]:
        """What it writes."""

    @abstractmethod
    def __call__(self, tensordict: TensorDictBase, found: Found, dist: d.Distribution | None) -> None:
        """Adds its values at each step; ``dist`` is the student's, if it is at hand."""


class AuxiliaryTerm(Term):
    r"""The cross-entropy of student and prior, :math:`H^X_{s_t}(\pi\|\pi_0)` or :math:`H^X_{s_t}(\pi_0\|\pi)`.

    Without an auxiliary loss it is still what the prior weight is regressed with on the advantage.
    """

    def __init__(self, loss: AE2RLoss) -> None:
        super().__init__(loss)
        self.aligned = loss.spec.adaptive and loss.weight_target == "advantage"
        if loss.kl_share is not None and loss.spec.cross_entropy == "teacher":
            raise ValueError("kl_share is for a cross-entropy of the student's actions: this method has the teacher's.")

    @property
    def in_keys(self) -> list[NestedKey]:
        """What the student and the prior read, or the parameters that the prior left in the batch."""
        loss, prior = self.loss, self.loss.prior
        if loss.prior_in_batch:
            return [*loss.actor_network.in_keys, *prior.out_keys]
        return [*loss.actor_network.in_keys, *prior.in_keys, *getattr(prior, "draw_keys", ())]

    @property
    def out_keys(self) -> list[str]:
        """The loss, if it is one, and what to log."""
        return [*(["loss_prior"] if self.loss.spec.auxiliary else []), "prior_kl", "prior_cross_entropy"]

    def __call__(self, tensordict: TensorDictBase, found: Found, dist: d.Distribution | None) -> None:
        """With a gradient for the actor if it is a loss."""
        loss, samples = self.loss, self.loss.num_samples
        with torch.no_grad():
            prior_dist = self._prior_dist(tensordict)
        with contextlib.nullcontext() if loss.spec.auxiliary else torch.no_grad():
            if dist is None:
                dist = self._student_dist(tensordict)
            of_advice = loss.spec.cross_entropy == "teacher"
            if of_advice and not self.aligned and not covers(prior_dist, dist):
                pull = cross_entropy_of_advice(prior_dist, dist, num_samples=samples)
                entropy = kl = torch.full_like(pull.detach(), torch.inf)  # they are only logged
            else:
                entropy, kl = cross_entropy_and_kl(dist, prior_dist, num_samples=samples)
                pull = entropy
                if of_advice:
                    pull = cross_entropy_of_advice(prior_dist, dist, num_samples=samples)
                elif loss.kl_share is not None:
                    divergence = kl_divergence(dist, prior_dist, num_samples=samples)
                    pull = torch.lerp(entropy, divergence, loss.kl_share)
        used = pull + entropy if self.aligned else pull
        # a teacher that rules actions out may be pulled to, at an infinite divergence, but none is at NaN
        check_advice(torch.where(kl.isnan(), kl, used.detach()), prior_dist, dist)
        ndim = tensordict.ndim or entropy.ndim  # what dispatch makes has no batch size
        found["prior_kl"], found[STUDENT_CROSS_ENTROPY] = joint(kl, ndim), joint(entropy, ndim)
        found["prior_cross_entropy"] = joint(pull, ndim)
        if loss.spec.auxiliary:
            found["loss_prior"] = found["prior_cross_entropy"]

    def _student_dist(self, tensordict: TensorDictBase) -> d.Distribution:
        try:
            with self.loss.params_of("actor_network"):
                return self.loss.actor_network.get_dist(tensordict.copy())
        except ValueError as error:
            raise ValueError(f"The student's distribution can not be built: {error}") from error

    def _prior_dist(self, tensordict: TensorDictBase) -> d.Distribution:
        prior = self.loss.prior
        if not self.loss.prior_in_batch:
            return prior.get_dist(tensordict.copy())
        hint = "with prior_in_batch=True, run PriorLogProb(prior, ..., keep_params=True) on it before the loss"
        params = [read(tensordict, key, hint) for key in prior.out_keys]
        return prior.build_dist(dict(zip(prior.param_names, params, strict=True)))


class RawCriticTerm(Term):
    r"""The TD error on raw rewards, :math:`R_t+\gamma(1-\mathrm{term}_t)V(s_{t+1})-V(s_t)`; a loss if trained here."""

    @property
    def in_keys(self) -> list[NestedKey]:
        """What the critic reads, here and at the next step, and what it is regressed on."""
        keys, names = self.loss.critic_network.in_keys, self.loss.tensor_keys
        return [*keys, *(under_next(key) for key in (*keys, names.reward, names.terminated))]

    @property
    def out_keys(self) -> list[str]:
        """The loss, if it is trained here, and the TD error."""
        return [*(["loss_prior_critic"] if self.loss.trains_critic else []), "prior_td_error"]

    def __call__(self, tensordict: TensorDictBase, found: Found, dist: d.Distribution | None) -> None:
        """The TD error has no gradient."""
        loss, names = self.loss, self.loss.tensor_keys
        reward, terminated = (
            read(tensordict, under_next(key), OF_ENVIRONMENT) for key in (names.reward, names.terminated)
        )
        with contextlib.nullcontext() if loss.trains_critic else torch.no_grad():
            value = loss.evaluate("critic_network", tensordict, names.value)
        if not value.shape == reward.shape == terminated.shape:
            raise ValueError(
                f"The value of the critic_network, the reward {under_next(names.reward)!r} and"
                f" {under_next(names.terminated)!r} must have one shape [*B, 1] (a value for each agent has no TD error"
                f" here), got {tuple(value.shape)}, {tuple(reward.shape)} and {tuple(terminated.shape)}."
            )
        with torch.no_grad():
            following = next_step(tensordict, loss.critic_network.in_keys, terminated)
            next_value = loss.evaluate("critic_network", following, names.value)
            target = td_residual(torch.zeros_like(next_value), reward, next_value, terminated, loss.gamma)
            found["prior_td_error"] = target - value
        if loss.trains_critic:
            found["loss_prior_critic"] = distance_loss(target, value, loss_function="l2")


class WeightTerm(Term):
    r"""The regression of the prior weight, :math:`(y - \omega(s)\,\ell)^2`, by ``weight_target``."""

    def __init__(self, loss: AE2RLoss) -> None:
        super().__init__(loss)
        target, shaped = loss.weight_target, loss.td_error == "shaped"
        if loss.prior_weight is None:
            raise ValueError("This method learns a prior weight: pass prior_weight.")
        if target == "td" and loss.critic_network is None:
            whose = "(that of the policy loss)" if shaped else "of its own, trained on raw rewards,"
            raise ValueError(
                f"td_error={loss.td_error!r} needs a critic {whose} behind the TD error: pass critic_network."
            )
        if target == "td" and loss.spec.bonus == "none":
            raise ValueError("weight_target='td' weighs the bonus, which this method lacks: use 'advantage'.")
        if target == "advantage" and shaped and loss.spec.bonus != "none" and loss.critic_network is not None:
            raise ValueError(
                "weight_target='advantage' asks for the advantage on raw rewards, but with td_error='shaped' the"
                " critic has seen the bonus: use td_error='original', or leave the critic out and write a"
                " 'raw_advantage' in the batch."
            )

    @property
    def shifted(self) -> bool:
        """Whether what is weighed is the advice on the next state."""
        return self.loss.weight_target == "td" and self.loss.spec.bonus == "next"

    @property
    def in_keys(self) -> list[NestedKey]:
        """What the weight reads where it is needed, the advice, and the target where the batch may have it."""
        names, of_weight, target = self.loss.tensor_keys, self.loss.prior_weight.in_keys, self.loss.weight_target
        keys = list(of_weight) if self.loss.spec.auxiliary or not self.shifted else []
        if self.shifted:
            keys += [under_next(key) for key in (*of_weight, names.prior_log_prob, names.terminated)]
        elif target != "none":
            keys.append(names.prior_log_prob)
        return [*keys, names.raw_advantage] if target == "advantage" else keys

    @property
    def out_keys(self) -> list[str]:
        """The loss, if there is a target, and the weight."""
        return [*(["loss_prior_weight"] if self.loss.weight_target != "none" else []), "prior_weight"]

    def __call__(self, tensordict: TensorDictBase, found: Found, dist: d.Distribution | None) -> None:
        """The weight is that at s_t (s_{t+1} where that at s_t is of no use), its loss that at the bonus' state."""
        if self.shifted:
            self._regress_at_the_next_state(tensordict, found)
            return
        found["prior_weight"] = weight = self._weight(tensordict)
        if self.loss.weight_target == "none":
            return
        log_prob = read(tensordict, self.loss.tensor_keys.prior_log_prob, HINT)
        if self.loss.weight_target == "td":
            target, signal = -found["prior_td_error"], prior_bonus(self.loss.bonus_coeff, log_prob)
        else:
            target = self._advantage(tensordict, found)
            signal = alignment(log_prob, found[STUDENT_CROSS_ENTROPY].detach())
        found["loss_prior_weight"] = _regression(target, weight, signal)

    def _regress_at_the_next_state(self, tensordict: TensorDictBase, found: Found) -> None:
        loss, names = self.loss, self.loss.tensor_keys
        terminated = read(tensordict, under_next(names.terminated), OF_ENVIRONMENT)
        signal = prior_bonus(loss.bonus_coeff, read(tensordict, under_next(names.prior_log_prob), HINT))
        signal = torch.where(terminated, torch.zeros_like(signal), signal)
        weight = self._weight(next_step(tensordict, loss.prior_weight.in_keys, terminated))
        found["loss_prior_weight"] = _regression(-found["prior_td_error"], weight, signal)
        if loss.spec.auxiliary:
            with torch.no_grad():
                weight = self._weight(tensordict)
        found["prior_weight"] = weight

    def _weight(self, tensordict: TensorDictBase) -> Tensor:
        return self.loss.evaluate("prior_weight", tensordict, self.loss.tensor_keys.prior_weight)

    def _advantage(self, tensordict: TensorDictBase, found: Found) -> Tensor:
        key = self.loss.tensor_keys.raw_advantage
        advantage = tensordict.get(key, found.get("prior_td_error"))
        if advantage is None:
            raise KeyError(
                f"weight_target='advantage' found neither {key!r} in the batch nor a critic of raw rewards: write the"
                " one or pass critic_network."
            )
        return advantage


def _regression(target: Tensor, weight: Tensor, signal: Tensor) -> Tensor:
    """The prior weight's loss, refusing shapes that would broadcast to an outer product over the batch."""
    if not target.shape == weight.shape == signal.shape:
        raise ValueError(
            "The target of the prior weight, the weight and the log-probabilities of the prior must have one shape"
            f" [*B, 1], got {tuple(target.shape)}, {tuple(weight.shape)} and {tuple(signal.shape)}."
        )
    return prior_weight_loss(target.detach(), weight, signal.detach())
