"""What TorchRL's trainers and loops call on a collector, of one that collects where it is."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING, Any

from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import nn

if TYPE_CHECKING:
    from gymnasium.vector import VectorEnv


class CollectorInterface(ABC):
    """Iteration, the number of batches, weights and the end, with the names and arguments of TorchRL's collectors."""

    init_random_frames = 0
    """None: the policy acts from the first step on."""

    def __init__(
        self, env: VectorEnv, policy: TensorDictModuleBase, *, frames_per_batch: int, total_frames: int
    ) -> None:
        if frames_per_batch < 1 or frames_per_batch % env.num_envs:
            raise ValueError(
                f"frames_per_batch ({frames_per_batch}) must be a multiple of {env.num_envs} environments."
            )
        if total_frames != -1 and (total_frames < 1 or total_frames % frames_per_batch):
            raise ValueError(
                f"total_frames ({total_frames}) must be a multiple of frames_per_batch ({frames_per_batch}), or -1."
            )
        self.env = env
        self.policy = policy
        self.frames_per_batch = frames_per_batch
        self.total_frames = total_frames
        self.frames = 0
        """Steps of all environments together since the beginning."""

    @property
    def requested_frames_per_batch(self) -> int:
        """As TorchRL calls ``frames_per_batch``."""
        return self.frames_per_batch

    @abstractmethod
    def rollout(self) -> TensorDictBase:
        """The next rollout, whatever ``total_frames`` is."""

    def __iter__(self) -> Iterator[TensorDictBase]:
        """Rollouts until ``total_frames``; continues where it was left, also after ``load_state_dict``."""
        while (batch := self.next()) is not None:
            yield batch

    def iterator(self) -> Iterator[TensorDictBase]:
        """The same as ``iter``."""
        return iter(self)

    def next(self) -> TensorDictBase | None:
        """The next rollout, or ``None`` after ``total_frames``."""
        return self.rollout() if self.total_frames == -1 or self.frames < self.total_frames else None

    def __len__(self) -> int:
        """The number of rollouts in ``total_frames``."""
        if self.total_frames == -1:
            raise RuntimeError("A collector without total_frames has no length.")
        return self.total_frames // self.frames_per_batch

    def __bool__(self) -> bool:
        return True

    def update_policy_weights_(
        self,
        policy_or_weights: TensorDictBase | nn.Module | Mapping[str, Any] | None = None,
        *,
        weights: TensorDictBase | Mapping[str, Any] | None = None,
        policy: nn.Module | None = None,
        weights_dict: Mapping[str, Any] | None = None,
        worker_ids: Any = None,
        model_id: str | None = None,
    ) -> None:
        """Copies weights into the policy; without any there is nothing to do, for the policy is used where it is.

        Weights are a policy of the same parameters, those as a tensordict, or a ``state_dict``, under any one of the
        names that TorchRL has for them. There is no worker, and one model, ``"policy"``.

        Raises:
            TypeError: weights of another kind, or more than one of them.
            ValueError: a worker, or another model.
            KeyError, RuntimeError: they are not those of the policy.
        """
        models = set(weights_dict or ()) | ({model_id} if model_id is not None else set())
        if worker_ids is not None or models - {"policy"}:
            raise ValueError(
                f"A {type(self).__name__} has no workers and one model, 'policy': got worker_ids={worker_ids}, models"
                f" {sorted(models)}."
            )
        given = [policy_or_weights, weights, policy, None if weights_dict is None else weights_dict.get("policy")]
        given = [value for value in given if value is not None]
        if len(given) > 1:
            raise TypeError("Pass weights once: as the first argument, weights, policy or weights_dict.")
        for value in given:
            self._copy_weights(value)

    def _copy_weights(self, value: Any) -> None:
        if isinstance(value, nn.Module):
            value = TensorDict.from_module(value)
        if isinstance(value, TensorDictBase):
            TensorDict.from_module(self.policy).data.update_(value.data)
        elif isinstance(value, Mapping):
            self.policy.load_state_dict(value)
        else:
            raise TypeError(f"Expected a policy, a tensordict or a state_dict of weights, got {type(value).__name__}.")

    def start(self) -> None:
        """Refuses to collect in the background."""
        raise NotImplementedError(
            f"A {type(self).__name__} collects when it is iterated over, and not in the background: pass"
            " async_collection=False to the trainer, or use a collector of TorchRL."
        )

    def shutdown(self, timeout: float | None = None, close_env: bool = True, raise_on_error: bool = True) -> None:
        """Closes the environments, once; there is nothing to wait for, so that ``timeout`` has no effect."""
        if not close_env:
            return
        try:
            self.env.close()
        except Exception:
            if raise_on_error:
                raise

    def async_shutdown(self, timeout: float | None = None, close_env: bool = True) -> None:
        """The same as :meth:`shutdown`."""
        self.shutdown(timeout, close_env)
