"""Priors that are wrong on purpose: bad advice in some states, or at some steps."""

from __future__ import annotations

from collections.abc import Callable
from copy import deepcopy
from functools import partial
from typing import Any

import torch
from tensordict import NestedKey, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from tensordict.utils import unravel_key
from torch import Tensor
from torch import distributions as d
from torchrl.modules import IndependentNormal

from torchrl_priors.keys import read
from torchrl_priors.priors.prior import NegatedPrior, Prior, PriorWrapper
from torchrl_priors.state_table import StateTable

__all__ = ["Degradation", "RandomDegradation", "StructuralDegradation"]


class Degradation(PriorWrapper):
    """A prior whose advice is an adversary's wherever :meth:`mask` says so: the base of the degradations.

    Args:
        prior (Prior): the good advice.
        adversary (Prior, optional): the bad advice, a distribution with the same parameters. Defaults to
            ``None``: the negated advice, see :meth:`Prior.adversary`.

    Raises:
        ValueError: the adversary's distribution has other parameters than the prior's, or is of another kind.
        NotImplementedError: no adversary is given, and the prior has none.
    """

    def __init__(self, prior: Prior, adversary: Prior | None = None) -> None:
        super().__init__(prior)
        adversary = prior.adversary() if adversary is None else adversary
        if adversary.param_names != self.param_names:
            raise ValueError(
                f"An adversary must have the parameters of the prior that it replaces, got {adversary.param_names} and"
                f" {self.param_names}."
            )
        kinds = adversary.distribution_class, self.distribution_class
        if "loc" in self.param_names and {*kinds} - {d.Normal, IndependentNormal} and kinds[0] != kinds[1]:
            ours, theirs = (getattr(kind, "__name__", kind) for kind in kinds)
            raise ValueError(f"The adversary's {ours} would be read as the prior's {theirs}: give both the same.")
        self.bad_advice = adversary
        self._read_too(adversary.in_keys)

    def _read_too(self, keys: list[NestedKey]) -> None:
        self.in_keys = [*self.in_keys, *(key for key in keys if key not in self.in_keys)]

    def mask(self, tensordict: TensorDictBase) -> Tensor:
        """Where the advice is the adversary's: bool, ``[*B]`` or ``[*B, 1]``."""
        raise NotImplementedError

    @property
    def draw_keys(self) -> list[NestedKey]:
        """What the prior drew at random and left in the batch, its adversary's draws included."""
        return list(dict.fromkeys([*super().draw_keys, *self.bad_advice.draw_keys]))

    def draw(self, tensordict: TensorDictBase) -> None:
        """Draws what the prior and its adversary draw at random, unless it is there already."""
        super().draw(tensordict)
        self.bad_advice.draw(tensordict)

    @torch.no_grad()
    def get_params(self, tensordict: TensorDictBase) -> dict[str, Tensor]:
        """The parameters of the distribution by name: the adversary's where the mask is true."""
        mask = self.mask(tensordict)
        good = self.module.get_params(tensordict)
        if isinstance(self.bad_advice, NegatedPrior) and self.bad_advice.module is self.module:
            bad = self.bad_advice.negate(good)  # the policy need not run twice
        else:
            bad = self.bad_advice.get_params(tensordict)
        return {name: torch.where(_align(mask, good[name]), bad[name], good[name]) for name in good}


def _align(mask: Tensor, value: Tensor) -> Tensor:
    """A mask ``[*B]`` or ``[*B, 1]`` with as many dimensions as ``value``."""
    if mask.ndim > value.ndim:
        return mask.squeeze(-1)
    return mask.reshape(*mask.shape, *[1] * (value.ndim - mask.ndim))


class StructuralDegradation(Degradation):
    """The adversary in some states, always: a teacher that does not know a part of its task.

    The structural setting of Centa & Preux, "Soft Action Priors: Towards Robust Policy Transfer".

    Args:
        prior (Prior): the good advice.
        degraded (Tensor, NestedKey, Callable or TensorDictModule): which states are degraded:

            * a bool tensor ``[S]`` or ``[*W, S]`` (one mask for each world of a batch), indexed by the integer states
              under ``state_key``;
            * the key of a bool entry ``[*B]`` or ``[*B, 1]``;
            * a function of the tensordict, or a TensorDict module that writes its first key, returning the same.
        adversary (Prior, optional): as in :class:`Degradation`.

    Keyword Args:
        state_key (NestedKey): where a table of states finds its integers. Defaults to ``"state"``.

    Raises:
        ValueError: the mask is not bool.
        KeyError: the mask is missing.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl_priors.priors import BoltzmannPrior
        >>> teacher = BoltzmannPrior(torch.tensor([[0.0, 1.0], [0.0, 1.0]]))
        >>> prior = StructuralDegradation(teacher, torch.tensor([False, True]))
        >>> prior.get_dist(TensorDict(state=torch.tensor([0, 1]), batch_size=[2])).probs.argmax(-1)
        tensor([1, 0])
    """

    def __init__(
        self,
        prior: Prior,
        degraded: Tensor | NestedKey | Callable[[TensorDictBase], Tensor] | TensorDictModuleBase,
        adversary: Prior | None = None,
        *,
        state_key: NestedKey = "state",
    ) -> None:
        super().__init__(prior, adversary)
        if isinstance(degraded, Tensor):
            _check_bool(degraded)
            degraded = StateTable(degraded, in_key=state_key, out_key="degraded")
        elif not callable(degraded):
            self._read_too([degraded := unravel_key(degraded)])
            degraded = partial(read, key=degraded, hint="it says which states are degraded")
        self.degraded = degraded
        if isinstance(degraded, TensorDictModuleBase):
            self.degraded = deepcopy(degraded).requires_grad_(False).eval()
            self._read_too(degraded.in_keys)

    def mask(self, tensordict: TensorDictBase) -> Tensor:
        """Which of the states of ``tensordict`` are degraded: bool, ``[*B]`` or ``[*B, 1]``."""
        mask: Any = self.degraded(tensordict.copy())
        if isinstance(self.degraded, TensorDictModuleBase):
            mask = mask.get(self.degraded.out_keys[0])
        _check_bool(mask)
        return mask


class RandomDegradation(Degradation):
    """The adversary at random steps: a noisy teacher.

    The random setting of Centa & Preux, "Soft Action Priors: Towards Robust Policy Transfer". Each visited step has one
    Bernoulli(p) draw. It is written into the tensordict under ``draw_key`` when the prior is first asked, and
    reused when it is there: the bonus and the auxiliary loss of a step see the same advice.

    Args:
        prior (Prior): the good advice.
        p (float): the probability of the adversary at a step, in [0, 1].
        adversary (Prior, optional): as in :class:`Degradation`.

    Keyword Args:
        seed (int, optional): seeds a generator of the prior's own, whose state is part of the ``state_dict``. The draws
            are the same on every device. Defaults to ``None``: torch's global generator.
        draw_key (NestedKey, optional): where the draw is kept, bool ``[*B, 1]``. Defaults to
            ``(namespace, "degraded")``. Two degradations of one prior need two keys.

    Raises:
        ValueError: ``p`` is not a probability, or a degradation inside ``prior`` uses the same ``draw_key``.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl_priors.priors import BoltzmannPrior
        >>> prior = RandomDegradation(BoltzmannPrior(torch.tensor([[0.0, 1.0]])), p=0.5, seed=0)
        >>> batch = TensorDict(state=torch.zeros(6, dtype=torch.int64), batch_size=[6])
        >>> first = prior.get_dist(batch).probs
        >>> batch["prior", "degraded"].squeeze(-1).shape
        torch.Size([6])
        >>> bool((prior.get_dist(batch).probs == first).all())  # the draw is reused
        True
    """

    def __init__(
        self,
        prior: Prior,
        p: float,
        adversary: Prior | None = None,
        *,
        seed: int | None = None,
        draw_key: NestedKey | None = None,
    ) -> None:
        if not 0 <= p <= 1:
            raise ValueError(f"p must be a probability in [0, 1], got {p}.")
        super().__init__(prior, adversary)
        self.p = float(p)
        self.generator = None if seed is None else torch.Generator().manual_seed(seed)
        self.draw_key = unravel_key((self.namespace, "degraded") if draw_key is None else draw_key)
        if self.draw_key in super().draw_keys:
            raise ValueError(
                f"A degradation inside this one already keeps its draw in {self.draw_key!r}: pass a draw_key."
            )

    @property
    def draw_keys(self) -> list[NestedKey]:
        """What the prior drew at random and left in the batch; its own draw is the last."""
        return [*super().draw_keys, self.draw_key]

    def draw(self, tensordict: TensorDictBase) -> None:
        """Draws whose advice each step sees, unless it is there already."""
        super().draw(tensordict)
        self.mask(tensordict)

    def mask(self, tensordict: TensorDictBase) -> Tensor:
        """The draw of each step, bool ``[*B, 1]``: the tensordict's, or a new one that is written into it."""
        mask = tensordict.get(self.draw_key, None)
        if mask is None:
            shape = (*tensordict.batch_size, 1)
            device = tensordict.device
            if device is None:  # of a batch without next observations, the device of what there is
                device = next((value.device for value in tensordict.values(True, True)), None)
            mask = (torch.rand(shape, generator=self.generator, device="cpu") < self.p).to(device)
            tensordict.set(self.draw_key, mask)
        _check_bool(mask)
        return mask

    def get_extra_state(self) -> Tensor | None:
        """The state of the prior's own generator, so that a resumed run draws the same numbers."""
        return None if self.generator is None else self.generator.get_state()

    def set_extra_state(self, state: Tensor | None) -> None:
        """Restores the generator."""
        if state is not None:
            self.generator = self.generator or torch.Generator()
            self.generator.set_state(state.cpu())


def _check_bool(mask: Tensor) -> None:
    if mask.dtype is not torch.bool:
        raise ValueError(f"The mask of degraded states must be bool, got {mask.dtype}.")
