"""A trial that decides by returns: students with and without a teacher, side by side until one is clearly ahead."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any, Literal, NamedTuple

from tensordict import NestedKey, TensorDictBase
from torch import Tensor

from torchrl_priors.episode_returns import EpisodeReturns, welch

__all__ = ["TeacherTrial", "TrialResult"]


class TrialResult(NamedTuple):
    """What a :class:`TeacherTrial` decided.

    Attributes:
        winner: the arm to go on with.
        margin: its mean recent return minus that of the best other arm that was still in the trial.
        confidence: 1 minus the level at which the last arms were dropped, all looks and pairs counted; 0 where the
            trial ended in doubt.
        frames: of each arm when it left the trial, by name.
        returns: mean recent return of each arm then, by name.
    """

    winner: str
    margin: float
    confidence: float
    frames: dict[str, int]
    returns: dict[str, float]

    def __str__(self) -> str:
        """One line for a log."""
        arms = ", ".join(f"{arm} {value:.4g}" for arm, value in self.returns.items())
        sure = f"confidence {self.confidence:.1%}" if self.confidence else "in doubt"
        return f"{self.winner} wins by {self.margin:.4g} ({sure}) after {sum(self.frames.values())} frames: {arms}"


class TeacherTrial:
    r"""Finds out whether a teacher helps, by trying: one student alone and one for each teacher, and their returns.

    Beyond the paper. The loop trains every arm that is still ``active`` for the same number of frames, gives each
    batch to :meth:`update`, and calls :meth:`decide` after each round. Compared are the returns of *recent* episodes,
    those that ended in the last quarter of an arm's frames so far, for what a student does at first says little. With
    mean :math:`m` and variance :math:`s^2` of :math:`n` recent returns, an arm is behind another where

    .. math:: \frac{m_1 - m_2}{\sqrt{s_1^2/n_1 + s_2^2/n_2}} > \Phi^{-1}\!\left(1 - \frac{\alpha}{L}\right),

    Welch's statistic. The pairs of arms and the looks that ``max_frames`` leaves room for, :math:`L` in all, share the
    level :math:`\alpha` (Bonferroni). An arm that is behind any other leaves the trial. The trial ends when one arm is
    left, or at ``max_frames`` of each arm. Then, in doubt, the first arm wins if it is still in the trial, else the one
    with the highest recent return.

    Args:
        arms (sequence of str): names of the students, at least two, the one without a teacher first.

    Keyword Args:
        max_frames (int): of each arm.
        in_doubt (str): who wins in doubt, ``"first"`` or ``"best"``: the first arm, or always the one with the highest
            recent return. Defaults to ``"first"``.
        alpha (float): probability of dropping an arm though it is no worse, as far as means of returns are normal: it
            is larger with few episodes. Defaults to 0.05.
        min_frames (int, optional): of each arm before the first decision. Learning curves cross, and a test can't see
            that: on Hopper the student of a bad teacher leads at 4096 frames and is clearly behind at 24576. Defaults
            to half of ``max_frames``.
        recent (float): the share of an arm's frames in which recent episodes ended, in whole batches. Defaults to 0.25.
        min_episodes (int): recent episodes of each arm before a decision. Defaults to 8.
        return_key (NestedKey): undiscounted return so far, ``[*B, 1]``, as
            :class:`~torchrl.envs.RewardSum` writes it. Defaults to ``("next", "episode_reward")``.
        done_key (NestedKey): where episodes end, bool ``[*B, 1]``. Defaults to ``("next", "done")``.

    Raises:
        ValueError: fewer than two arms, a name twice, or a setting out of its range.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> trial = TeacherTrial(["alone", "taught"], max_frames=1000)
        >>> def batch(mean):  # ten episodes of ten steps
        ...     done = (torch.arange(100) % 10 == 9).unsqueeze(-1)
        ...     returns = mean + torch.randn(100, 1)
        ...     return TensorDict(
        ...         next=TensorDict(episode_reward=returns, done=done, batch_size=[100]), batch_size=[100]
        ...     )
        >>> while trial.decide() is None:
        ...     for arm, mean in (("alone", 0.0), ("taught", 5.0)):
        ...         if arm in trial.active:
        ...             trial.update(arm, batch(mean))
        >>> trial.result.winner, trial.result.confidence > 0.95
        ('taught', True)
    """

    def __init__(
        self,
        arms: Sequence[str],
        *,
        max_frames: int,
        in_doubt: Literal["first", "best"] = "first",
        alpha: float = 0.05,
        min_frames: int | None = None,
        recent: float = 0.25,
        min_episodes: int = 8,
        return_key: NestedKey = ("next", "episode_reward"),
        done_key: NestedKey = ("next", "done"),
    ) -> None:
        self.arms = list(arms)
        if len(self.arms) < 2 or len(set(self.arms)) < len(self.arms):
            raise ValueError(f"A trial needs at least two arms of different names, got {self.arms}.")
        if in_doubt not in ("first", "best"):
            raise ValueError(f"in_doubt must be 'first' or 'best', got {in_doubt!r}.")
        self.in_doubt = in_doubt
        if not 0 < alpha < 1:
            raise ValueError(f"alpha must be in (0, 1), got {alpha}.")
        for name, number, least in (("max_frames", max_frames, 1), ("min_episodes", min_episodes, 2)):
            if number < least:
                raise ValueError(f"{name} must be at least {least}, got {number}.")
        if not 0 < recent <= 1:
            raise ValueError(f"recent must be in (0, 1], got {recent}.")
        min_frames = max_frames // 2 if min_frames is None else min_frames
        if not 0 <= min_frames <= max_frames:
            raise ValueError(f"min_frames must be between 0 and max_frames={max_frames}, got {min_frames}.")
        self.max_frames, self.alpha, self.min_frames, self.min_episodes = max_frames, alpha, min_frames, min_episodes
        self.recent = recent
        self.active = list(self.arms)
        self.result: TrialResult | None = None
        self._round = 0  # frames of an arm at the first look
        self._returns = {arm: EpisodeReturns(return_key=return_key, done_key=done_key, name=arm) for arm in self.arms}

    def update(self, arm: str, batch: TensorDictBase) -> None:
        """Read the returns of the episodes that ended in a batch.

        Args:
            arm (str): whose batch it is.
            batch (TensorDictBase): ``[*B]``, all frames that the arm has made since its last batch.

        Raises:
            KeyError: an arm that is not in the trial, or an entry that is missing.
            ValueError: a return that is not finite.
        """
        if arm not in self.active:
            raise KeyError(f"{arm!r} is not in the trial any more, or never was: active are {self.active}.")
        self._returns[arm].update(batch)

    @property
    def frames(self) -> dict[str, int]:
        """That each arm has made."""
        return {arm: returns.frames for arm, returns in self._returns.items()}

    def decide(self) -> TrialResult | None:
        """Drop the arms that are clearly behind; the result as soon as there is one.

        Raises:
            ValueError: active arms have different numbers of frames, or one has finished no episode by ``max_frames``.
        """
        if self.result is not None:
            return self.result
        frames = {self.frames[arm] for arm in self.active}
        if len(frames) > 1:
            made = {arm: self.frames[arm] for arm in self.active}
            raise ValueError(f"Arms are compared at the same number of frames, got {made}.")
        done = frames.pop()
        if done == 0:
            return None
        self._round = self._round or done
        last = done >= self.max_frames
        recent = {arm: self.recent_returns(arm) for arm in self.active}
        if last and (silent := [arm for arm, values in recent.items() if len(values) == 0]):
            raise ValueError(
                f"{silent} finished no episode in the last {self.recent:.0%} of {done} frames: raise max_frames, or"
                " limit the length of episodes."
            )
        confidence = 0.0
        if done >= self.min_frames and all(len(values) >= self.min_episodes for values in recent.values()):
            confidence = self._drop(recent)
        if len(self.active) == 1 or last:
            self._end(recent, confidence if len(self.active) == 1 else 0.0)
        return self.result

    def recent_returns(self, arm: str) -> Tensor:
        """Returns of an arm's recent episodes, float64 ``[N]``."""
        returns = self._returns[arm]
        return returns.within(returns.frames * self.recent)

    def _drop(self, recent: Mapping[str, Tensor]) -> float:
        """Take the arms out that are clearly behind another one; how sure the least sure of these decisions is."""
        looks = math.ceil(self.max_frames / self._round)
        comparisons = looks * len(self.arms) * (len(self.arms) - 1)
        sure = {}
        for arm, values in recent.items():
            level = min(_tail(theirs, values) for other, theirs in recent.items() if other != arm) * comparisons
            if level < self.alpha:
                sure[arm] = 1 - level
        self.active = [arm for arm in self.active if arm not in sure]
        return min(sure.values(), default=0.0)

    def _end(self, recent: Mapping[str, Tensor], confidence: float) -> None:
        means = {arm: float(values.mean()) for arm, values in recent.items()}
        best = max(self.active, key=means.__getitem__)
        winner = self.arms[0] if self.in_doubt == "first" and self.arms[0] in self.active else best
        margin = means[winner] - max(value for arm, value in means.items() if arm != winner)
        returns = {arm: float(self.recent_returns(arm).mean()) for arm in self.arms}
        self.result = TrialResult(winner, margin, confidence, dict(self.frames), returns)

    def state_dict(self) -> dict[str, Any]:
        """Everything that was seen and decided, as plain values."""
        return {
            "active": list(self.active),
            "round": self._round,
            "returns": {arm: returns.state_dict() for arm, returns in self._returns.items()},
            "result": None if self.result is None else self.result._asdict(),
        }

    def load_state_dict(self, state_dict: Mapping[str, Any]) -> None:
        """Continue where a saved trial was.

        Raises:
            ValueError: it was one of other arms.
        """
        saved = state_dict["returns"]
        if set(saved) != set(self.arms):
            raise ValueError(f"The saved trial is of {sorted(saved)}, this one of {sorted(self.arms)}.")
        self.active, self._round = list(state_dict["active"]), int(state_dict["round"])
        for arm, returns in self._returns.items():
            returns.load_state_dict(saved[arm])
        result = state_dict["result"]
        self.result = None if result is None else TrialResult(**result)


def _tail(better: Tensor, worse: Tensor) -> float:
    """Probability of a Welch statistic as large as this where the means are equal, by the normal distribution."""
    difference, error = welch(better, worse)
    if error == 0:
        return 0.0 if difference > 0 else 1.0
    return 0.5 * math.erfc(difference / error / math.sqrt(2))
