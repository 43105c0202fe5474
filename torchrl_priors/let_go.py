"""When to let a teacher go: a coefficient that is guided by the student's returns."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

from tensordict import NestedKey, TensorDictBase
from torch import Tensor, nn

from torchrl_priors.episode_returns import EpisodeReturns, welch

__all__ = ["LetGo"]

#: Share of a return that counts as a change.
_CHANGE = 0.1


class LetGo:
    r"""Lets a teacher go when its student stops gaining, and takes it back where the student loses without it.

    Beyond the paper. A teacher that gives its student a head start can hold it back later on. The right moment to let
    go differs between teachers, and the returns show it. With :math:`R` the mean return of the episodes that ended in
    the last window of :math:`w` frames, :math:`R'` that of the window before, :math:`e` the standard error of their
    difference and :math:`R_1` what :math:`R` was when the teacher began to be let go, a batch of :math:`n` frames
    changes the factor :math:`c` of the teacher's coefficient, which starts at 1, to

    .. math:: c \leftarrow \begin{cases}
        1 & R < R_1 - \max(2e,\, 0.1\,|R_1|) \quad\text{(it loses: take the teacher back)}\\
        c & R - R' > \max(e,\, 0.1\,|R'|) \quad\text{(it gains: leave that alone)}\\
        2^{-rn/w}\, c & \text{otherwise (let go)}
        \end{cases}

    The rate :math:`r` is halved whenever a teacher has to be taken back that was half gone (:math:`c<1/2`): one that is
    needed is tried without ever more rarely, one that is not is soon gone. Nothing changes in the first two windows, or
    while one of the two has fewer than ``min_episodes`` episodes.

    A student that minimises :math:`H^X(\pi\|\pi_0)` loses its entropy, and with it what it would explore by on its own.
    So a second coefficient can be kept at :math:`1-c`: with :class:`~torchrl_priors.AE2RLoss`'s ``kl_share`` the loss
    goes from the cross-entropy to the divergence while it fades, and gives the teacher's entropy back.

    TGRL (Shenfeld et al., 2023) lets its coefficient follow the gap between the student and a second one that learns
    from rewards alone. Here the student is compared with itself, and no second one has to be trained.

    Args:
        module (nn.Module): e.g. :class:`~torchrl_priors.AE2RLoss`.
        name (str): of the coefficient's buffer, with dots where it belongs to a submodule:
            ``"prior_loss.aux_coeff"``. It is changed in place.

    Keyword Args:
        window (int): frames.
        rest (str, optional): of the buffer to be kept at :math:`1-c`. Defaults to None.
        rate (float): how often :math:`c` is halved in a window, at first. Defaults to 0.5.
        min_episodes (int): in each window. Defaults to 6.
        return_key, done_key (NestedKey): see :class:`~torchrl_priors.TeacherTrial`.

    Raises:
        AttributeError: the module has no such buffer.
        ValueError: a number out of its range.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl_priors import PriorBonus
        >>> bonus = PriorBonus(bonus_coeff=0.5)
        >>> let_go = LetGo(bonus, "bonus_coeff", window=100, rate=1)
        >>> done = (torch.arange(100) % 10 == 9).unsqueeze(-1)
        >>> for _ in range(4):  # each batch is a window of the same returns
        ...     returns = torch.arange(100.0).unsqueeze(-1)
        ...     after = TensorDict(episode_reward=returns, done=done, batch_size=[100])
        ...     data = TensorDict(next=after, batch_size=[100])
        ...     print(let_go.update(data), bonus.bonus_coeff.item())
        1.0 0.5
        0.5 0.25
        0.25 0.125
        0.125 0.0625
    """

    def __init__(
        self,
        module: nn.Module,
        name: str,
        *,
        window: int,
        rest: str | None = None,
        rate: float = 0.5,
        min_episodes: int = 6,
        return_key: NestedKey = ("next", "episode_reward"),
        done_key: NestedKey = ("next", "done"),
    ) -> None:
        if window < 1:
            raise ValueError(f"window must be at least 1, got {window}.")
        if not 0 < rate < math.inf:
            raise ValueError(f"rate must be a positive number, got {rate}.")
        if min_episodes < 2:
            raise ValueError(f"min_episodes must be at least 2, got {min_episodes}.")
        self.module, self.name, self.rest = module, name, rest
        self.window, self.rate, self.min_episodes = window, rate, min_episodes
        self.factor = 1.0
        """What the coefficient is multiplied by."""
        self._full = float(module.get_buffer(name))
        self._taught = 0.0  # R_1
        self._returns = EpisodeReturns(return_key=return_key, done_key=done_key)
        self._set()

    def update(self, batch: TensorDictBase) -> float:
        """Read a batch and set the coefficient for what comes after it; its factor.

        Args:
            batch (TensorDictBase): ``[*B]``, all frames that were made since the last batch.

        Raises:
            KeyError: an entry is missing.
            ValueError: a return is not finite.
        """
        self._returns.update(batch)
        self._returns.forget(2 * self.window)
        recent, before = self._returns.within(self.window), self._returns.within(self.window, ago=self.window)
        if self._returns.frames >= 2 * self.window and min(len(recent), len(before)) >= self.min_episodes:
            self._change(recent, before, batch.numel() / self.window)
        self._set()
        return self.factor

    def _change(self, recent: Tensor, before: Tensor, windows: float) -> None:
        gain, error = welch(recent, before)
        level = float(recent.mean())
        if self.factor == 1:
            self._taught = level
        if level < self._taught - max(2 * error, _CHANGE * abs(self._taught)):
            self.rate = self.rate / 2 if self.factor < 0.5 else self.rate
            self.factor = 1.0
        elif gain <= max(error, _CHANGE * abs(float(before.mean()))):
            self.factor *= 2 ** (-self.rate * windows)

    def _set(self) -> None:
        self.module.get_buffer(self.name).fill_(self._full * self.factor)
        if self.rest is not None:
            self.module.get_buffer(self.rest).fill_(1 - self.factor)

    def state_dict(self) -> dict[str, Any]:
        """Everything that the next factor depends on, as plain values."""
        return {
            "factor": self.factor,
            "rate": self.rate,
            "full": self._full,
            "taught": self._taught,
            "returns": self._returns.state_dict(),
        }

    def load_state_dict(self, state_dict: Mapping[str, Any]) -> None:
        """Continue where another one was, and set the coefficient."""
        names = ("factor", "rate", "full", "taught")
        self.factor, self.rate, self._full, self._taught = (float(state_dict[name]) for name in names)
        self._returns.load_state_dict(state_dict["returns"])
        self._set()
