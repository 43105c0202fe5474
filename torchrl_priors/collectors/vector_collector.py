"""Collects rollouts from a vector of Gymnasium environments, as TorchRL's collector does, several times faster."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from tensordict import NestedKey, TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor

from torchrl_priors.collectors.env_state import env_state_dict, load_env_state_dict
from torchrl_priors.collectors.interface import CollectorInterface
from torchrl_priors.collectors.policy_step import policy_step
from torchrl_priors.collectors.running_norm import RunningNorm
from torchrl_priors.collectors.vector_env import action_limits, check_vector_env, spread_seed

if TYPE_CHECKING:
    from gymnasium.vector import VectorEnv


class VectorCollector(CollectorInterface):
    """Iterates over rollouts ``[num_envs, T]`` of a policy in a vector of Gymnasium environments.

    A stand-in for :class:`torchrl.collectors.Collector` where its cost per step outweighs the simulator's: observations
    stay in arrays, the policy is called once a step for all environments (a Gaussian policy without any tensordict),
    and one tensordict is made per rollout. It has what TorchRL's trainers and loops call on a collector.

    1. The policy explores (it is sampled), without gradient, with random numbers of the collector's own. Its parameters
       are used where they are: there are no weights to send. Its training mode is left alone.
    2. What is stored and scored is the action that the policy drew; the simulator gets it clipped to its action space.
    3. An episode that ends is followed by the first step of the next one: ``("next", observation)`` is the true last
       observation, the root of the following step the reset one, of another ``("collector", "traj_ids")``.
    4. The normaliser is fixed during a rollout, and updated after it with the rollout's root observations, unless it is
       frozen. The batch holds what the policy saw; ``("next", ...)`` is normalised by the same statistics.

    The entries are those of TorchRL's collector, observations and rewards in float32: the observation (and its
    normalised form), what the policy writes (``action``, ``action_log_prob``, ``loc``, ``scale``, ...), ``done``,
    ``terminated``, ``truncated``, ``("collector", "traj_ids")``, and under ``"next"`` the observation(s), ``reward``,
    ``done``, ``terminated``, ``truncated``, and, as ``RewardSum`` and ``StepCounter`` would write them,
    ``episode_reward`` and ``step_count``. Every batch has memory of its own.

    Args:
        env (VectorEnv): environments that do not reset by themselves, see :func:`make_vector_env`: their observations
            are arrays, their actions arrays of real numbers, or ``Discrete`` and given by their indices.
        policy (TensorDictModuleBase): usually a :class:`~torchrl.modules.ProbabilisticActor`; reads the observation or
            its normalised form.

    Keyword Args:
        frames_per_batch (int): steps of all environments together in a rollout; a multiple of their number.
        total_frames (int): where iteration ends; a multiple of ``frames_per_batch``. Defaults to -1, never.
        observation_key (NestedKey): defaults to ``"observation"``.
        action_key (NestedKey): defaults to ``"action"``.
        normalizer (RunningNorm, optional): normalises observations into ``normalized_key``.
        normalized_key (NestedKey): defaults to ``"observation_norm"``.
        postproc (callable, optional): what to apply to each rollout, e.g. a
            :class:`~torchrl_priors.PriorLogProb`.
        device (torch.device): the device of the policy and the batches. Defaults to ``"cpu"``.
        seed (int, optional): seeds environments and actions. Defaults to None: by the operating system.

    Raises:
        ValueError: numbers of frames that do not divide, a policy that reads what there is not, or an environment that
            resets by itself.
        TypeError: other spaces.

    Examples:
        >>> import torch
        >>> from tensordict.nn import AddStateIndependentNormalScale, TensorDictModule
        >>> from torchrl.modules import IndependentNormal, ProbabilisticActor
        >>> from torchrl_priors.collectors import RunningNorm, VectorCollector, make_vector_env
        >>> net = torch.nn.Sequential(torch.nn.Linear(3, 1), AddStateIndependentNormalScale(1))
        >>> actor = ProbabilisticActor(
        ...     TensorDictModule(net, in_keys=["observation_norm"], out_keys=["loc", "scale"]),
        ...     in_keys=["loc", "scale"],
        ...     distribution_class=IndependentNormal,
        ...     return_log_prob=True,
        ... )
        >>> env = make_vector_env("Pendulum-v1", 4)
        >>> collector = VectorCollector(
        ...     env, actor, frames_per_batch=32, total_frames=64, normalizer=RunningNorm(3), seed=0
        ... )
        >>> for batch in collector:
        ...     print(batch.shape, batch.names, collector.frames)
        torch.Size([4, 8]) [None, 'time'] 32
        torch.Size([4, 8]) [None, 'time'] 64
    """

    def __init__(
        self,
        env: VectorEnv,
        policy: TensorDictModuleBase,
        *,
        frames_per_batch: int,
        total_frames: int = -1,
        observation_key: NestedKey = "observation",
        action_key: NestedKey = "action",
        normalizer: RunningNorm | None = None,
        normalized_key: NestedKey = "observation_norm",
        postproc: Callable[[TensorDictBase], TensorDictBase] | None = None,
        device: torch.device | str = "cpu",
        seed: int | None = None,
    ) -> None:
        check_vector_env(env)
        super().__init__(env, policy, frames_per_batch=frames_per_batch, total_frames=total_frames)
        self.normalizer = normalizer
        self.postproc = postproc
        self.device = torch.device(device)
        self.observation_key = observation_key
        self.action_key = action_key
        self.normalized_key = normalized_key

        inputs = [observation_key] if normalizer is None else [observation_key, normalized_key]
        self._step = policy_step(policy, action_key, inputs)
        self._generator = torch.Generator(self.device)
        self._low, self._high = action_limits(env.single_action_space)
        self._obs = np.empty((env.num_envs, *env.single_observation_space.shape), np.float32)
        self.set_seed(seed)

    def set_seed(self, seed: int | None, static_seed: bool = False) -> int:
        """Seeds environments and actions, and begins new episodes; a seed for whatever is seeded next.

        Args:
            seed (int, optional): ``None`` for one of the operating system's.
            static_seed (bool): whether the same seed is returned, not the next one. Defaults to ``False``.
        """
        if seed is None:
            seed = int(np.random.SeedSequence().generate_state(1)[0])
        env_seeds, action_seed = spread_seed(seed, self.env.num_envs, stream=0)
        self._generator.manual_seed(action_seed)
        self._obs[...], _ = self.env.reset(seed=env_seeds)
        self._traj_ids = np.arange(self.env.num_envs)
        self._next_traj_id = self.env.num_envs
        self._episode_reward = np.zeros(self.env.num_envs)
        self._step_count = np.zeros(self.env.num_envs, np.int64)
        return seed if static_seed else seed + 1

    def reset(self, index: int | Sequence[int] | Tensor | None = None) -> None:
        """Begins new episodes, of new ``("collector", "traj_ids")``.

        Args:
            index (int, sequence of int or Tensor, optional): of which environments. Defaults to ``None``: of all.
        """
        where = np.full(self.env.num_envs, index is None)
        if index is not None:
            where[np.asarray(index)] = True
        self._begin_episodes(where, self._step_count[:, None], self._traj_ids[:, None])

    def rollout(self) -> TensorDictBase:
        """The next rollout, whatever ``total_frames`` is."""
        batch = self._collect(self.frames_per_batch // self.env.num_envs)
        self.frames += self.frames_per_batch
        if self.normalizer is not None and not self.normalizer.frozen:
            self.normalizer.update(batch.get(self.observation_key))
        return batch if self.postproc is None else self.postproc(batch)

    def _collect(self, steps: int) -> TensorDict:
        env, num_envs = self.env, self.env.num_envs
        shape = (num_envs, steps)
        obs, policy_input = self._obs, np.empty_like(self._obs)
        observations, next_observations = (np.empty((*shape, *obs.shape[1:]), np.float32) for _ in range(2))
        rewards, episode_rewards = (np.empty(shape, np.float32) for _ in range(2))
        terminations, truncations = (np.empty(shape, np.bool_) for _ in range(2))
        # column t is of the step t, the last one of the step to come
        step_counts = self._step_count[:, None] + np.arange(steps + 1)
        traj_ids = np.repeat(self._traj_ids[:, None], steps + 1, axis=1)
        sent = np.empty((num_envs, *env.single_action_space.shape), env.single_action_space.dtype)
        inputs = {self.observation_key: torch.from_numpy(obs)}
        if self.normalizer is not None:
            mean, inverse_std = (statistic.cpu().numpy() for statistic in self.normalizer.affine())
            clip = np.float32(self.normalizer.clip)
            inputs[self.normalized_key] = torch.from_numpy(policy_input)
        on_cpu = self.device.type == "cpu"
        written: dict[NestedKey, Tensor] = {}
        outputs: dict[NestedKey, Tensor] = {}
        arrays: dict[NestedKey, np.ndarray] = {}  # the memory of `written`
        drawn: dict[NestedKey, np.ndarray] = {}  # that of `outputs`

        with self._step.session(self._generator, deterministic=False):
            for t in range(steps):
                observations[:, t] = obs
                if self.normalizer is not None:
                    np.subtract(obs, mean, out=policy_input)
                    np.multiply(policy_input, inverse_std, out=policy_input)
                    np.minimum(policy_input, clip, out=policy_input)
                    np.maximum(policy_input, -clip, out=policy_input)

                last = outputs
                outputs = self._step(inputs if on_cpu else {key: x.to(self.device) for key, x in inputs.items()})
                if not written:
                    written = {key: value.new_empty((*shape, *value.shape[1:])) for key, value in outputs.items()}
                    arrays = _arrays(written)
                if arrays:
                    if outputs is not last:
                        drawn = _arrays(outputs)
                    for key, array in arrays.items():
                        array[:, t] = drawn[key]
                    action = drawn[self.action_key]
                else:  # the same, slower
                    for key, value in outputs.items():
                        written[key][:, t] = value
                    action = outputs[self.action_key].cpu().numpy()
                np.minimum(action, self._high, out=sent)
                np.maximum(sent, self._low, out=sent)

                next_obs, reward, terminated, truncated, _ = env.step(sent)

                next_observations[:, t] = next_obs
                rewards[:, t] = reward
                terminations[:, t] = terminated
                truncations[:, t] = truncated
                self._episode_reward += reward
                episode_rewards[:, t] = self._episode_reward
                obs[...] = next_obs
                done = terminated | truncated
                if True in done.tolist():  # a fraction of what `any` takes
                    self._begin_episodes(done, step_counts[:, t + 1 :], traj_ids[:, t + 1 :])

        self._step_count, self._traj_ids = step_counts[:, -1].copy(), traj_ids[:, -1].copy()
        return self._batch(
            written,
            observation=observations,
            traj_ids=traj_ids[:, :-1],
            next_observation=next_observations,
            reward=rewards,
            terminated=terminations,
            truncated=truncations,
            episode_reward=episode_rewards,
            step_count=step_counts[:, :-1] + 1,
        )

    def _begin_episodes(self, where: np.ndarray, step_counts: np.ndarray, traj_ids: np.ndarray) -> None:
        """Of some environments; what is counted of the steps to come begins with them."""
        fresh, _ = self.env.reset(options={"reset_mask": where})
        self._obs[where] = fresh[where]
        number = int(where.sum())
        traj_ids[where] = np.arange(self._next_traj_id, self._next_traj_id + number)[:, None]
        self._next_traj_id += number
        self._episode_reward[where] = 0
        step_counts[where] = np.arange(step_counts.shape[1])

    def _batch(self, written: Mapping[NestedKey, Tensor], **arrays: np.ndarray) -> TensorDict:
        """The tensordict of a rollout: of what the policy wrote and of what the environments gave."""
        tensors = {name: torch.from_numpy(array).to(self.device) for name, array in arrays.items()}
        shape = tensors["reward"].shape
        batch = TensorDict({}, batch_size=shape, names=[None, "time"], device=self.device)
        batch.set(self.observation_key, tensors["observation"])
        batch.set(("next", self.observation_key), tensors["next_observation"])
        if self.normalizer is not None:
            with torch.no_grad():
                normalized, next_normalized = (
                    self.normalizer(tensors[name].to(self.normalizer.mean.device)).to(self.device)
                    for name in ("observation", "next_observation")
                )
            batch.set(self.normalized_key, normalized)
            batch.set(("next", self.normalized_key), next_normalized)
        for key, value in written.items():
            batch.set(key, value)
        self._step.complete(batch)
        ends = {"terminated": tensors["terminated"], "truncated": tensors["truncated"]}
        ends["done"] = ends["terminated"] | ends["truncated"]
        for key, value in ends.items():
            batch.set(key, torch.zeros_like(value).unsqueeze(-1))
            batch.set(("next", key), value.unsqueeze(-1))
        for key in ("reward", "episode_reward", "step_count"):
            batch.set(("next", key), tensors[key].unsqueeze(-1))
        batch.set(("collector", "traj_ids"), tensors["traj_ids"])
        return batch

    def state_dict(self) -> dict[str, Any]:
        """All that the next rollout depends on but the policy, as tensors, numbers and strings in nested dicts.

        Take it between rollouts; :func:`torch.save` (with ``weights_only``) and ``torchrl.checkpoint`` write it. A
        collector that loads it, in this process or another, continues bit by bit, given the same policy, machine and
        versions.

        Raises:
            TypeError: the state of an environment cannot be saved, see :func:`env_state_dict`.
        """
        state: dict[str, Any] = {
            "frames": self.frames,
            "generator": self._generator.get_state(),
            "observation": torch.from_numpy(self._obs.copy()),
            "traj_ids": torch.from_numpy(self._traj_ids.copy()),
            "next_traj_id": self._next_traj_id,
            "episode_reward": torch.from_numpy(self._episode_reward.copy()),
            "step_count": torch.from_numpy(self._step_count.copy()),
            "env": env_state_dict(self.env),
        }
        if self.normalizer is not None:
            state["normalizer"] = {name: value.clone() for name, value in self.normalizer.state_dict().items()}
            state["normalizer_frozen"] = self.normalizer.frozen
        return state

    def load_state_dict(self, state_dict: Mapping[str, Any]) -> None:
        """Continues where another collector of the same environments and normaliser was.

        Raises:
            ValueError: the state is that of other environments, or of a collector with(out) a normaliser.
            TypeError: see :func:`load_env_state_dict`.
        """
        if ("normalizer" in state_dict) != (self.normalizer is not None):
            raise ValueError("Either the saved collector or this one has no normalizer: both need one, or neither.")
        observation = state_dict["observation"]
        if tuple(observation.shape) != self._obs.shape:
            raise ValueError(
                f"The saved observations have shape {tuple(observation.shape)}, this collector's {self._obs.shape}."
            )
        load_env_state_dict(self.env, state_dict["env"])
        self._generator.set_state(state_dict["generator"].cpu())
        self.frames = int(state_dict["frames"])
        self._next_traj_id = int(state_dict["next_traj_id"])
        self._obs[...] = observation.cpu().numpy()
        self._traj_ids[...] = state_dict["traj_ids"].cpu().numpy()
        self._episode_reward[...] = state_dict["episode_reward"].cpu().numpy()
        self._step_count[...] = state_dict["step_count"].cpu().numpy()
        if self.normalizer is not None:
            self.normalizer.load_state_dict(state_dict["normalizer"])
            self.normalizer.freeze(bool(state_dict["normalizer_frozen"]))


def _arrays(tensors: Mapping[NestedKey, Tensor]) -> dict[NestedKey, np.ndarray]:
    """The same memory as arrays; nothing where NumPy can't have it."""
    try:
        return {key: tensor.detach().numpy() for key, tensor in tensors.items()}
    except TypeError:  # another device, or bfloat16
        return {}
