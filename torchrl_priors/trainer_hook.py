"""Soft action priors in TorchRL's trainers."""

from __future__ import annotations

from typing import Any, Literal

from tensordict import NestedKey, TensorDictBase
from torchrl.envs import Compose
from torchrl.trainers import Trainer, TrainerHookBase

from torchrl_priors.transforms import prior_transforms

__all__ = ["PriorShaping"]


class PriorShaping(TrainerHookBase):
    """Shapes the reward of every batch of a :class:`~torchrl.trainers.Trainer` by the prior of its loss.

    It runs :func:`prior_transforms` of the trainer's loss when a batch arrives, before the advantage is estimated: a
    trainer that Hydra builds from a YAML file shares what has to be shared.

    Keyword Args:
        boundary, time_dim, traj_key, mask_key: as for :class:`PriorLogProb`.

    Raises:
        TypeError: at registration, the trainer's loss is none of this library.
        ValueError: at registration, the trainer collects asynchronously: it sees no batch of trajectories.

    Examples:
        >>> from torchrl_priors import PriorShaping
        >>> hook = PriorShaping(boundary="sample")
        >>> # trainer = PPOTrainer(loss_module=ClipPPOPriorLoss(...), reward_key="shaped_reward", ...)
        >>> # hook.register(trainer)
    """

    def __init__(
        self,
        *,
        boundary: Literal["expected", "sample", "zero"] = "expected",
        time_dim: int | None = None,
        traj_key: NestedKey = ("collector", "traj_ids"),
        mask_key: NestedKey = ("collector", "mask"),
    ) -> None:
        self.kwargs: dict[str, Any] = {
            "boundary": boundary,
            "time_dim": time_dim,
            "traj_key": traj_key,
            "mask_key": mask_key,
        }
        self.transform: Compose | None = None

    def __call__(self, batch: TensorDictBase) -> TensorDictBase:
        """Writes the log-probabilities, the bonus and the shaped reward into a batch ``[*B, T]``."""
        if self.transform is None:
            raise RuntimeError("PriorShaping takes its networks from a trainer: call hook.register(trainer) first.")
        return self.transform(batch)

    def state_dict(self) -> dict[str, Any]:
        """Empty: what it uses belongs to the loss."""
        return {}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Nothing to load."""

    def register(self, trainer: Trainer, name: str = "prior_shaping") -> None:
        """Adds itself to what a trainer does with a new batch."""
        if getattr(trainer, "async_collection", False):
            raise ValueError("PriorShaping needs whole batches of trajectories: use async_collection=False.")
        self.transform = prior_transforms(trainer.loss_module, **self.kwargs)
        trainer.register_op("batch_process", self)
        trainer.register_module(name, self)
