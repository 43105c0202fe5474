"""The formulas of MuJoCo's walking tasks, for many environments at once."""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from functools import partial
from types import SimpleNamespace
from typing import Any

import mujoco
import numpy as np

READ = ("qpos", "qvel", "ctrl", "xpos", "xipos", "cinert", "cvel", "cfrc_ext", "qfrc_actuator")
"""What the formulas read of the simulator's data."""


class _Rows:
    """Reads arrays of real numbers, the same of each environment, into the rows of a new matrix."""

    def __init__(self, arrays: Sequence[Sequence[np.ndarray]]) -> None:
        if not all(array.flags.c_contiguous for row in arrays for array in row):
            raise ValueError("Arrays that are not contiguous would be copied, and not be read again.")
        self._views = [array.reshape(-1) for row in arrays for array in row]
        self._shape = (len(arrays), sum(array.size for array in arrays[0]))

    def __call__(self) -> np.ndarray:
        return np.concatenate(self._views).reshape(self._shape)


def _clip(values: np.ndarray, low: float, high: float) -> np.ndarray:
    """``np.clip`` in place: the same numbers, without its overhead."""
    return np.minimum(np.maximum(values, low, out=values), high, out=values)


def _cost(weight: float, values: np.ndarray) -> np.ndarray:
    """``weight * np.sum(np.square(row))`` of each row, in the order of summation and the precision of a single one."""
    sums = np.add.reduce(np.square(values, order="C"), axis=-1)
    dtype = (weight * sums[0]).dtype  # that of scalars, which depends on the version of NumPy
    return sums.astype(dtype, copy=False) * dtype.type(weight)


class Task:
    """The formulas of a task: Gymnasium's, in its order of operations."""

    skipped = 1
    """Coordinates that are not observed by default."""

    def __init__(self, bases: list[Any], version: int) -> None:
        self.bases, self.version = bases, version
        self.base = bases[0]  # its settings are those of all
        self.dt: float = self.base.dt
        self.models, self.data = [base.model for base in bases], [base.data for base in bases]
        skipped = self.skipped * bool(self.base._exclude_current_positions_from_observation)
        rows = [[base.data.qpos[skipped:], base.data.qvel, *self.observed(base)] for base in bases]
        self.positions = sum(array.size for array in rows[0][:1])
        self.motion = sum(array.size for array in rows[0][:2])
        self._obs = _Rows(rows)
        self._state = _Rows([[base.data.qpos, base.data.qvel] for base in bases])
        self.place = self.places()
        self._start = np.zeros(())

    def observed(self, base: Any) -> list[np.ndarray]:
        """What is observed besides positions and velocities."""
        return []

    def places(self) -> Callable[[], np.ndarray]:
        """What reads the coordinate along which to move, ``[num_envs, 1]``."""
        return _Rows([[base.data.qpos[:1]] for base in self.bases])

    def healthy(self, state: np.ndarray) -> np.ndarray:
        """Whether bodies of these positions and velocities have not fallen."""
        raise NotImplementedError

    def limit(self, obs: np.ndarray) -> None:
        """Limits what is observed, in place."""

    def costs(self, actions: np.ndarray) -> np.ndarray:
        """What is subtracted from the rewards."""
        return _cost(self.base._ctrl_cost_weight, actions)

    def before(self) -> None:
        """Remembers where the bodies are, before a step."""
        self._start = self.place()

    def simulate(self, actions: np.ndarray, data: Sequence[Any]) -> None:
        """Gymnasium's physical step, of each environment's data."""
        frame_skip = self.base.frame_skip
        for model, state, action in zip(self.models, data, actions, strict=True):
            state.ctrl[:] = action
            mujoco.mj_step(model, state, frame_skip)
            mujoco.mj_rnePostConstraint(model, state)

    def after(self, actions: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Observations, rewards and which episodes terminated, after a step."""
        obs = self._obs()
        self.limit(obs)
        gains, terminated = self.gains(((self.place() - self._start) / self.dt)[:, 0])
        return obs, gains - self.costs(actions), terminated

    def gains(self, velocity: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The rewards before costs, and which episodes terminated."""
        base, healthy = self.base, self.healthy(self._state())
        ends = bool(base._terminate_when_unhealthy)
        paid = healthy | ends if self.version == 4 else healthy
        gains = getattr(base, "_forward_reward_weight", 1.0) * velocity + paid * base._healthy_reward
        return gains, ~healthy & ends


class _HalfCheetah(Task):
    def gains(self, velocity: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return self.base._forward_reward_weight * velocity, np.zeros(len(self.bases), np.bool_)


class _Walker2d(Task):
    def __init__(self, bases: list[Any], version: int) -> None:
        super().__init__(bases, version)
        self._low, self._high = np.array(self.bounds(), np.float64).T

    def bounds(self) -> list[tuple[float, float]]:
        """Of healthy states, from their second coordinate on."""
        return [self.base._healthy_z_range, self.base._healthy_angle_range]

    def limit(self, obs: np.ndarray) -> None:
        _clip(obs[:, self.positions :], -10.0, 10.0)

    def healthy(self, state: np.ndarray) -> np.ndarray:
        bounded = state[:, 1 : 1 + len(self._low)]
        return np.logical_and.reduce((self._low < bounded) & (bounded < self._high), axis=1)


class _Hopper(_Walker2d):
    def bounds(self) -> list[tuple[float, float]]:
        height, (left, right) = super().bounds()
        low, high = self.base._healthy_state_range
        others = self.base.model.nq + self.base.model.nv - 3
        return [height, (max(low, left), min(high, right)), *[(low, high)] * others]


class _Ant(Task):
    skipped = 2

    def __init__(self, bases: list[Any], version: int) -> None:
        self.feels = version == 5 or bases[0]._use_contact_forces
        self._forces = _Rows([[base.data.cfrc_ext] for base in bases])
        super().__init__(bases, version)

    def places(self) -> Callable[[], np.ndarray]:
        body = "torso" if self.version == 4 else self.base._main_body
        return _Rows([[base.data.body(body).xpos[:1]] for base in self.bases])

    def observed(self, base: Any) -> list[np.ndarray]:
        if self.version == 4:
            return [base.data.cfrc_ext] if self.feels else []
        return [base.data.cfrc_ext[1:]] if base._include_cfrc_ext_in_observation else []

    def limit(self, obs: np.ndarray) -> None:
        _clip(obs[:, self.motion :], *self.base._contact_force_range)

    def healthy(self, state: np.ndarray) -> np.ndarray:
        low, high = self.base._healthy_z_range
        return np.isfinite(state).all(axis=1) & (low <= state[:, 2]) & (state[:, 2] <= high)

    def costs(self, actions: np.ndarray) -> np.ndarray:
        costs = super().costs(actions)
        if self.feels:
            forces = _clip(self._forces(), *self.base._contact_force_range)
            costs = costs + _cost(self.base._contact_cost_weight, forces)
        return costs


class _Humanoid(Task):
    skipped = 2

    def __init__(self, bases: list[Any], version: int) -> None:
        self._controls = _Rows([[base.data.ctrl] for base in bases])
        self._forces = _Rows([[base.data.cfrc_ext] for base in bases])
        super().__init__(bases, version)

    def places(self) -> Callable[[], np.ndarray]:
        mass_center = sys.modules[type(self.base).__module__].mass_center
        masses = _Rows([[base.model.body_mass] for base in self.bases])
        bodies = _Rows([[base.data.xipos] for base in self.bases])

        def one_by_one() -> np.ndarray:
            return np.array([mass_center(base.model, base.data)[:1] for base in self.bases])

        def at_once() -> np.ndarray:
            return _mass_centers(masses(), bodies())

        # Gymnasium has summed in two ways: at once only if that gives the same, to the bit
        generator, number = np.random.default_rng(0), masses().shape[1]
        weights, places = generator.random((64, number)), generator.normal(size=(64, 3 * number))
        singles = [
            mass_center(SimpleNamespace(body_mass=weight), SimpleNamespace(xipos=place.reshape(-1, 3)))[:1]
            for weight, place in zip(weights, places, strict=True)
        ]
        return at_once if np.array_equal(singles, _mass_centers(weights, places)) else one_by_one

    def observed(self, base: Any) -> list[np.ndarray]:
        data = base.data
        if self.version == 4:
            return [data.cinert, data.cvel, data.qfrc_actuator, data.cfrc_ext]
        parts = {
            "cinert": data.cinert[1:],
            "cvel": data.cvel[1:],
            "qfrc_actuator": data.qfrc_actuator[6:],
            "cfrc_ext": data.cfrc_ext[1:],
        }
        return [part for name, part in parts.items() if getattr(base, f"_include_{name}_in_observation") is True]

    def healthy(self, state: np.ndarray) -> np.ndarray:
        low, high = self.base._healthy_z_range
        return (low < state[:, 2]) & (state[:, 2] < high)

    def costs(self, actions: np.ndarray) -> np.ndarray:
        costs = _cost(self.base._ctrl_cost_weight, self._controls())
        if self.version == 5:
            contact = _cost(self.base._contact_cost_weight, self._forces())
            costs = costs + _clip(contact, *self.base._contact_cost_range)
        return costs


def _mass_centers(masses: np.ndarray, bodies: np.ndarray) -> np.ndarray:
    """The first coordinate of the centre of mass, by recent Gymnasium's operations, ``[N, 1]``."""
    sums = np.einsum("nb,nbj->nj", masses, bodies.reshape(*masses.shape, 3))
    return sums[:, :1] / masses.sum(axis=1, keepdims=True)


TASKS: dict[str, Callable[[list[Any]], Task]] = {
    f"gymnasium.envs.mujoco.{module}_v{version}.{task.__name__[1:]}Env": partial(task, version=version)
    for module, task in {
        "half_cheetah": _HalfCheetah,
        "hopper": _Hopper,
        "walker2d": _Walker2d,
        "ant": _Ant,
        "humanoid": _Humanoid,
    }.items()
    for version in (4, 5)
}
"""What makes the task of environments of a class, by its full name."""
