"""TorchRL's loggers, beside the tables that a run always writes: ``logger=tensorboard`` or ``logger=wandb``."""

from __future__ import annotations

import importlib.util
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from torch import Tensor
from torchrl.record.loggers import get_logger

__all__ = ["LOGGERS", "RunLogger", "require_logger"]

LOGGERS = ("csv", "tensorboard", "wandb")
"""Values of ``logger``; ``csv`` is the run's own tables and nothing else."""
_BINS = 30


def require_logger(name: str) -> None:
    """Refuse a logger whose package is not there.

    Raises:
        ImportError: names the extra that has it.
    """
    if name != "csv" and importlib.util.find_spec(name) is None:
        raise ImportError(f"logger={name}: the package {name} is missing: pip install 'torchrl-priors[{name}]'.")


class RunLogger:
    """What a run sends to TensorBoard or Weights & Biases.

    A run that continues, or starts anew, goes on in the same log. What had been logged after its checkpoint comes
    again: TensorBoard is told to drop the first copy; in Weights & Biases equal points lie on each other.

    Args:
        name (str): ``"tensorboard"`` or ``"wandb"`` (``WANDB_MODE=offline`` keeps it on this machine).
        folder (Path): of the run; the log is in its ``log/``.
        config (dict): of the run, with nested keys.
        frames (int): of the checkpoint that the run continues from, or 0.
        identity (str): the same whenever the run is continued, and another for each run.
    """

    def __init__(self, name: str, folder: Path, config: dict[str, Any], frames: int, identity: str) -> None:
        require_logger(name)
        options: dict[str, Any] = {}
        if name == "wandb":
            options["wandb_kwargs"] = {"project": "torchrl_priors", "id": identity, "config": config}
        self._name = name
        continued = (folder / "log").exists()
        experiment = f"{folder.name}" if name == "wandb" else "log"
        log_dir = folder / "log" if name == "wandb" else folder
        self._logger = get_logger(name, logger_name=str(log_dir), experiment_name=experiment, **options)
        if name == "tensorboard" and continued:
            writer = self._logger.experiment
            writer.close()
            writer.purge_step = frames + 1 if frames else 0  # the next file begins with it

    def scalars(self, prefix: str, row: Mapping[str, float]) -> None:
        """Log a row of a table; what is not finite has no point."""
        step = int(row["frames"])
        for name, value in row.items():
            if name != "frames" and math.isfinite(value):
                self._logger.log_scalar(f"{prefix}/{name}", value, step=step)

    def histogram(self, name: str, values: Tensor, step: int) -> None:
        """Log the distribution of values."""
        self._logger.log_histogram(name, values.flatten().numpy(), step=step, bins=_BINS)

    def close(self) -> None:
        """Write what is not written yet."""
        experiment = self._logger.experiment
        experiment.finish() if self._name == "wandb" else experiment.close()
