"""The state of an environment that can't be read: how its episode began, and its actions, lead to it again."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import gymnasium
import numpy as np


class EpisodeLog(gymnasium.Wrapper):
    """Keeps the beginning and the actions of the episode at hand, so that it can be played again.

    An episode is to depend on Gymnasium's random numbers (``np_random``) and the actions only. Environments with other
    random numbers, or a memory beyond the episode, end up elsewhere, and :meth:`play_again` says so.

    Args:
        env (Env): of arrays as observations.
    """

    def __init__(self, env: gymnasium.Env) -> None:
        super().__init__(env)
        self._begin: dict[str, Any] = {}
        self._actions: list[Any] = []
        self._observation = np.empty(0)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[np.ndarray, Any]:
        """As of any environment."""
        self._begin = {"random": self._random()} if seed is None else {"seed": seed}
        self._actions = []
        self._observation, info = self.env.reset(seed=seed, options=options)
        return self._observation, info

    def step(self, action: Any) -> tuple[np.ndarray, Any, bool, bool, dict[str, Any]]:
        """As of any environment."""
        self._actions.append(np.array(action))  # what is given is written again
        self._observation, *rest = self.env.step(action)
        return self._observation, *rest

    def _random(self) -> Any:
        return self.env.unwrapped.np_random.bit_generator.state

    def _end(self) -> dict[str, Any]:
        """What tells whether the same was played."""
        return {"observation": np.asarray(self._observation).tolist(), "random": self._random()}

    def episode(self) -> dict[str, Any]:
        """The episode so far, as JSON can hold it."""
        return {"begin": self._begin, "actions": [action.tolist() for action in self._actions], "end": self._end()}

    def play_again(self, episode: Mapping[str, Any]) -> None:
        """Go to where another environment was when it gave :meth:`episode`.

        Raises:
            ValueError: its actions lead elsewhere.
        """
        begin, space = episode["begin"], self.env.action_space
        if "random" in begin:
            self.env.unwrapped.np_random.bit_generator.state = begin["random"]
        self.reset(seed=begin.get("seed"))
        for action in episode["actions"]:
            self.step(np.array(action, space.dtype) if isinstance(space, gymnasium.spaces.Box) else np.int64(action))
        if self._end() != episode["end"]:
            name = type(self.unwrapped).__name__ if self.spec is None else self.spec.id
            raise ValueError(
                f"{name}: the same actions lead elsewhere when an episode is played again, so that its state can't be"
                " restored. Its episodes are to depend on np_random and the actions only."
            )
