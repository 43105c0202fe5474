"""The returns of the episodes that a student finished, and when: what a trial and a coefficient are decided by."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import torch
from tensordict import NestedKey, TensorDictBase
from torch import Tensor

__all__ = ["EpisodeReturns", "welch"]


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
        """Read a batch.

        Args:
            batch (TensorDictBase): ``[*B]``, all frames that were made since the last batch.

        Raises:
            KeyError: an entry is missing.
            ValueError: a return is not finite.
        """
        ended, returns = (self._entry(batch, key).reshape(-1) for key in (self.done_key, self.return_key))
        finished = returns[ended.bool()].double()
        if not finished.isfinite().all():
            raise ValueError(f"{self.name!r} has an episode whose return, under {self.return_key!r}, is not finite.")
        self.frames += batch.numel()
        self._episodes += [(self.frames, value) for value in finished.tolist()]

    @staticmethod
    def _entry(batch: TensorDictBase, key: NestedKey) -> Tensor:
        value = batch.get(key, None)
        if value is None:
            raise KeyError(f"The batch has no {key!r}. TorchRL's RewardSum writes the returns of episodes.")
        return value

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


def welch(x: Tensor, y: Tensor) -> tuple[float, float]:
    r"""The difference of two means, and its standard error :math:`\sqrt{s_x^2/n_x + s_y^2/n_y}` (Welch, 1947).

    Examples:
        >>> welch(torch.tensor([3.0, 5.0]), torch.tensor([1.0, 3.0]))
        (2.0, 1.4142135381698608)
    """
    difference = float(x.mean() - y.mean())
    return difference, float((x.var() / len(x) + y.var() / len(y)).sqrt())
