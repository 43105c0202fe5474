"""Whether a student's returns still rise."""

from __future__ import annotations

from tensordict import NestedKey, TensorDictBase

from torchrl_priors.episode_returns import EpisodeReturns, welch

__all__ = ["Plateau"]


class Plateau(EpisodeReturns):
    r"""Sees from a student's batches whether its returns still rise: a teacher that does not help any more may go.

    With :math:`R` the mean return of the episodes that ended in the last ``window`` frames, :math:`R'` that of the
    window before and :math:`e` the standard error of their difference, returns rise where
    :math:`R - R' > \max(e,\, 0.1\,|R'|)`. Nothing is said before there are two windows with ``min_episodes`` each.

    Keyword Args:
        window (int): frames.
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
        """Read a batch, and forget what no window holds any more; see :meth:`EpisodeReturns.update`."""
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
