"""The returns of the episodes that a student finished, and whether they still rise: what decides about a teacher."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import torch
from tensordict import NestedKey, TensorDictBase
from torch import Tensor

from torchrl_priors.keys import read

__all__ = ["EpisodeReturns", "Plateau", "welch"]


class EpisodeReturns:
    """Collects the returns of finished episodes from a student's batches.

    Keyword Args:
        return_key (NestedKey): undiscounted return so far, ``[*B, 1]``, as
            :class:`~torchrl.envs.RewardSum` writes it. Defaults to ``("next", "episode_reward")``.
        done_key (NestedKey): where episodes end, bool ``[*B, 1]``. Defaults to ``("next", "done")``.
        name (str): whose they are, for messages.
    """

    def __init__(
        self,
        *,
        return_key: NestedKey = ("next", "episode_reward"),
        done_key: NestedKey = ("next", "done"),
        name: str = "the student",
    ) -> None:
        self.return_key, self.done_key, self.name = return_key, done_key, name
        self.frames = 0
        self._episodes: list[tuple[int, float]] = []

    def update(self, batch: TensorDictBase) -> None:
        """Read a batch ``[*B]``, all frames since the last one; returns that are not finite are refused."""
        hint = "TorchRL's RewardSum writes the returns of episodes"
        ended, returns = (read(batch, key, hint).reshape(-1) for key in (self.done_key, self.return_key))
        finished = returns[ended.bool()].double()
        if not finished.isfinite().all():
            raise ValueError(f"{self.name!r} has an episode whose return, under {self.return_key!r}, is not finite.")
        self.frames += batch.numel()
        self._episodes += [(self.frames, value) for value in finished.tolist()]

    def within(self, frames: float, ago: float = 0) -> Tensor:
        """Returns of the episodes that ended in the last ``frames`` up to ``ago`` frames ago, float64 ``[N]``."""
        last = self.frames - ago
        found = [value for frame, value in self._episodes if last - frames < frame <= last]
        return torch.tensor(found, dtype=torch.float64)

    def forget(self, frames: float) -> None:
        """Keep the episodes of the last ``frames`` only."""
        self._episodes = [(frame, value) for frame, value in self._episodes if frame > self.frames - frames]

    def state_dict(self) -> dict[str, Any]:
        """Everything that was read, as plain values."""
        return {"frames": self.frames, "episodes": [list(episode) for episode in self._episodes]}

    def load_state_dict(self, state_dict: Mapping[str, Any]) -> None:
        """Continue from what was saved."""
        self.frames = int(state_dict["frames"])
        self._episodes = [(int(frame), float(value)) for frame, value in state_dict["episodes"]]


class Plateau(EpisodeReturns):
    r"""Sees from a student's batches whether its returns still rise: a teacher that does not help any more may go.

    With :math:`R` the mean return of the episodes that ended in the last ``window`` frames, :math:`R'` that of the
    window before and :math:`e` the standard error of their difference, returns rise where
    :math:`R - R' > \max(e,\, 0.1\,|R'|)`. Nothing is said before there are two windows with ``min_episodes`` each.

    Keyword Args:
        window (int): frames, at least those of a batch, as episodes count as ended at the end of their batch.
        min_episodes (int): in each window. Defaults to 6.
        gain (float): share of :math:`R'` that counts as a gain. Defaults to 0.1.
        return_key, done_key (NestedKey): see :class:`~torchrl_priors.TeacherTrial`.

    Raises:
        ValueError: a number out of its range.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> plateau = Plateau(window=100)
        >>> def batch(mean):  # ten episodes of ten steps
        ...     done = (torch.arange(100) % 10 == 9).unsqueeze(-1)
        ...     after = TensorDict(episode_reward=mean + torch.rand(100, 1), done=done, batch_size=[100])
        ...     return TensorDict(next=after, batch_size=[100])
        >>> for mean in (1.0, 5.0, 10.0, 10.0):
        ...     plateau.update(batch(mean))
        ...     print(plateau.reached)
        False
        False
        False
        True
    """

    def __init__(
        self,
        *,
        window: int,
        min_episodes: int = 6,
        gain: float = 0.1,
        return_key: NestedKey = ("next", "episode_reward"),
        done_key: NestedKey = ("next", "done"),
    ) -> None:
        if window < 1:
            raise ValueError(f"window must be at least 1, got {window}.")
        if min_episodes < 2:
            raise ValueError(f"min_episodes must be at least 2, got {min_episodes}.")
        if not 0 <= gain < float("inf"):
            raise ValueError(f"gain must be at least 0, got {gain}.")
        self.window, self.min_episodes, self.gain = window, min_episodes, gain
        super().__init__(return_key=return_key, done_key=done_key)

    def update(self, batch: TensorDictBase) -> None:
        """Read a batch, and forget what no window holds any more; see :meth:`EpisodeReturns.update`.

        Raises:
            ValueError: the batch has more frames than the window.
        """
        if batch.numel() > self.window:
            raise ValueError(f"window={self.window} is less than the {batch.numel()} frames of a batch: raise it.")
        super().update(batch)
        self.forget(2 * self.window)

    @property
    def reached(self) -> bool:
        """Whether returns have stopped to rise."""
        recent, before = self.within(self.window), self.within(self.window, ago=self.window)
        if self.frames < 2 * self.window or min(len(recent), len(before)) < self.min_episodes:
            return False
        rise, error = welch(recent, before)
        return rise <= max(error, self.gain * abs(float(before.mean())))


def welch(x: Tensor, y: Tensor) -> tuple[float, float]:
    r"""The difference of two means, and its standard error :math:`\sqrt{s_x^2/n_x + s_y^2/n_y}` (Welch, 1947).

    Examples:
        >>> welch(torch.tensor([3.0, 5.0]), torch.tensor([1.0, 3.0]))
        (2.0, 1.4142135381698608)
    """
    difference = float(x.mean() - y.mean())
    return difference, float((x.var() / len(x) + y.var() / len(y)).sqrt())
