"""Runs of the MuJoCo recipe that take a second."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from pathlib import Path
from typing import Any

import pytest
from composed import composed
from omegaconf import DictConfig
from torch import Tensor

from recipes.mujoco import train
from recipes.mujoco.run import Run
from torchrl_priors.objectives import compiled_step

ROOT = Path(__file__).parents[2]
TINY = [
    "env.num_envs=2",
    "env.frames_per_batch=64",
    "env.minibatch_size=32",
    "total_frames=256",
    "ppo.epochs=2",
    "ppo.hidden=[8]",
    "evaluation.interval=64",
    "evaluation.episodes=2",
    "checkpoint.interval=1000000",
    "compile=false",
]


def config(out: Path, *overrides: str) -> DictConfig:
    cfg = composed("mujoco", *TINY, *overrides)
    cfg.out = str(out)
    return cfg


@contextmanager
def without_records() -> Iterator[None]:
    """Steps that are not compiled are not recorded either: that takes longer than the few of a tiny run.

    That a record does what the step does is tested where records are.
    """
    record = compiled_step.record

    def take(step: Any, inputs: list[Tensor], backend: str) -> Any:
        return (lambda inputs: step(*inputs)) if backend == "eager" else record(step, inputs, backend)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(compiled_step, "record", take)
        yield


def run(out: Path, *overrides: str, recorded: bool = False) -> Path:
    """A run to its end; ``recorded`` to the bit as in a process of its own."""
    with nullcontext() if recorded else without_records():
        train.run(config(out, *overrides))
    return out


class Interrupted(BaseException):
    """Stands for a kill between two rollouts."""


def interrupt(monkeypatch: pytest.MonkeyPatch, out: Path, frames: int, *overrides: str) -> None:
    """Start a run, with a checkpoint of every rollout, that is broken off after the one that ends at ``frames``."""
    log = Run.log

    def stopping(self, at, *args, **kwargs):
        log(self, at, *args, **kwargs)
        if at == frames:
            raise Interrupted

    with monkeypatch.context() as patch:
        patch.setattr(Run, "log", stopping)
        with pytest.raises(Interrupted):
            run(out, "checkpoint.interval=64", *overrides)
