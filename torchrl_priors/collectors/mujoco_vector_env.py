"""Vectors of MuJoCo's walking tasks: what is around the simulator's steps is computed for all environments at once."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from copy import copy
from typing import Any

import numpy as np
from gymnasium import Env
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from gymnasium.wrappers import OrderEnforcing, PassiveEnvChecker, TimeLimit

from torchrl_priors.collectors.env_state import wrappers
from torchrl_priors.collectors.mujoco_tasks import READ, TASKS, Task

_CHECKED_STEPS = 2  # those in which Gymnasium's passive checker looks at what it is given

_UNEXPECTED = (AttributeError, LookupError, TypeError, ValueError)  # of another version of Gymnasium

_Step = tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]


class MujocoVectorEnv(SyncVectorEnv):
    """Gymnasium's ``SyncVectorEnv``, to the bit, but faster with HalfCheetah, Hopper, Walker2d, Ant and Humanoid.

    Gymnasium's own models and data take Gymnasium's own physical steps; observations, rewards and ends are computed for
    all environments at once, and the infos of steps are empty. This is for versions 4 and 5, with any of their
    arguments, under the wrappers of :func:`gymnasium.make`; see :attr:`fast`. All else is the superclass's: resets,
    spaces, ``envs``, and the steps of any other environments, e.g. of a subclass or under another wrapper. They are
    also the superclass's after :meth:`set_attr`, or if the first two give other numbers than the formulas known here.
    """

    _observations: np.ndarray
    _autoreset_envs: np.ndarray

    def __init__(self, env_fns: Sequence[Callable[[], Env]]) -> None:
        super().__init__(env_fns, autoreset_mode=AutoresetMode.DISABLED)
        self._task = _find_task(self.envs)
        self._steps = 0
        self._limits: list[tuple[int, Any]] = [
            (number, layer)
            for number, env in enumerate(self.envs)
            for layer in wrappers(env)
            if isinstance(layer, TimeLimit)
        ]

    @property
    def fast(self) -> bool:
        """Whether steps are computed for all environments at once."""
        return self._task is not None

    def reset(self, *, seed: Any = None, options: dict[str, Any] | None = None) -> tuple[np.ndarray, dict[str, Any]]:
        """See :class:`gymnasium.vector.SyncVectorEnv`."""
        if self._task is not None:
            self._task.dt = self._task.base.dt
        if self._steps:  # the superclass's observations of those that are not reset
            self._env_obs = list(self._observations.copy())
        return super().reset(seed=seed, options=options)

    def step(self, actions: np.ndarray) -> _Step:
        """See :class:`gymnasium.vector.SyncVectorEnv`."""
        task = self._task
        if task is None or not isinstance(actions, np.ndarray) or actions.shape != self.action_space.shape:
            return super().step(actions)
        if self._steps < _CHECKED_STEPS:
            return self._checked_step(task, actions)
        assert True not in self._autoreset_envs.tolist(), "An episode that ended has to be reset first."
        task.before()
        task.simulate(actions, task.data)
        obs, reward, terminated = task.after(actions)
        truncated = np.zeros(self.num_envs, np.bool_)
        for number, limit in self._limits:
            limit._elapsed_steps += 1
            if limit._elapsed_steps >= limit._max_episode_steps:
                truncated[number] = True
        self._observations = obs.copy()
        self._terminations, self._truncations = terminated.copy(), truncated.copy()
        self._autoreset_envs = terminated | truncated
        return obs, reward, terminated, truncated, {}

    def _checked_step(self, task: Task, actions: np.ndarray) -> _Step:
        """The superclass's step, and whether the physics and the task's formulas give the same."""
        task.before()
        twins = [copy(base.data) for base in task.bases]
        step = super().step(actions)
        try:
            task.simulate(actions, twins)
            pairs = [*zip(step[:3], task.after(actions), strict=True)]
            for base, twin in zip(task.bases, twins, strict=True):
                pairs += [(getattr(base.data, name), getattr(twin, name)) for name in READ]
            same = all(np.array_equal(one, other, equal_nan=True) for one, other in pairs)
        except _UNEXPECTED:
            same = False
        if not same:
            self._task = None
            return step
        self._steps += 1
        return (*step[:4], {})

    def set_attr(self, name: str, values: Any) -> None:
        """See :class:`gymnasium.vector.SyncVectorEnv`."""
        self._task = None
        super().set_attr(name, values)


def _find_task(envs: Sequence[Env]) -> Task | None:
    """How to step environments at once; None where that is not known."""
    bases: list[Any] = [env.unwrapped for env in envs]
    kinds = {f"{type(base).__module__}.{type(base).__qualname__}" for base in bases}
    plain = (TimeLimit, OrderEnforcing, PassiveEnvChecker)
    if len(kinds) > 1 or not all(type(layer) in plain for env in envs for layer in wrappers(env)):
        return None
    make = TASKS.get(kinds.pop())
    if make is None or any(base.render_mode == "human" for base in bases):
        return None
    try:
        return make(bases) if all(_settings(base) == _settings(bases[0]) for base in bases) else None
    except _UNEXPECTED:
        return None


def _settings(base: Any) -> dict[str, Any]:
    """What an environment was made with, as far as its formulas read it."""
    simple = (bool, int, float, str, tuple)
    return {"dt": base.dt, **{name: value for name, value in vars(base).items() if isinstance(value, simple)}}
