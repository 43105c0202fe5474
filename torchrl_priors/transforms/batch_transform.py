"""Transforms that look at whole trajectories, and can therefore not run inside of an environment."""

from __future__ import annotations

from copy import deepcopy
from typing import Any, NoReturn

from tensordict import TensorDictBase
from torchrl.envs import EnvBase, Transform


class BatchTransform(Transform):
    """Base of transforms that read and write batches of trajectories ``[*B, T]``, outside of environments.

    Their ``forward`` does the work: as a plain call on a batch, as the ``postproc`` of a collector, and in a replay
    buffer when it is sampled (``rb.append_transform(transform)``) or written (``rb.append_transform(transform,
    invert=True)``), alone or in a :class:`~torchrl.envs.Compose`.

    A sampler of slices returns them back to back: reshape the sample to ``[slices, slice_len]`` first, with a transform
    of the buffer or after sampling, lest the end of a slice continue with the beginning of another of its trajectory.
    """

    def __deepcopy__(self, memo: dict[int, Any]) -> BatchTransform:
        # Asynchronous collectors copy their postproc: networks that belong to others stay theirs, and go on learning.
        copy = self.__class__.__new__(self.__class__)
        memo[id(self)] = copy
        for name, value in self.__dict__.items():
            other = name in ("actor", "prior_weight")
            copy.__dict__[name] = memo.get(id(value), value) if other else deepcopy(value, memo)
        return copy

    def set_container(self, container: Transform | EnvBase) -> None:
        """Refuses an environment, at whatever depth."""
        if isinstance(container, EnvBase) or container.parent is not None:
            self._refuse()
        super().set_container(container)

    def _refuse(self) -> NoReturn:
        raise ValueError(
            f"{type(self).__name__} reads whole trajectories, which an environment does not see: use it as the"
            " postproc of a collector, in a replay buffer, or call it on a batch."
        )

    def _call(self, next_tensordict: TensorDictBase) -> TensorDictBase:
        # what a replay buffer calls for a transform that was appended with invert=True
        if self.parent is not None:
            self._refuse()
        return self.forward(next_tensordict)
