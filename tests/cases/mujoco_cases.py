"""Runs of the MuJoCo recipe that take a second."""

from __future__ import annotations

from pathlib import Path

import pytest
from composed import composed
from omegaconf import DictConfig

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
    "checkpoint.interval=128",
    "compile=false",
]


def config(out: Path, *overrides: str) -> DictConfig:
    cfg = composed("mujoco", *TINY, *overrides)
    cfg.out = str(out)
    return cfg


def run(out: Path, *overrides: str, recorded: bool = False) -> Path:
    """A run to its end. Where nothing is compiled and no record is asked for, its steps are taken without one.

    To record a step takes longer than the few that a tiny run has. That a record does what the step does is tested
    where records are.
    """
    cfg = config(out, *overrides)
    with pytest.MonkeyPatch.context() as patch:
        if not (recorded or cfg.compile):
            patch.setattr(compiled_step, "record", lambda step, inputs, backend: lambda inputs: step(*inputs))
        train.run(cfg)
    return out


class Interrupted(BaseException):
    """Stands for a kill between two rollouts."""


def interrupt(monkeypatch: pytest.MonkeyPatch, out: Path, frames: int, *overrides: str) -> None:
    """Start a run that is broken off after the rollout that ends at ``frames``."""
    log = Run.log

    def stopping(self, at, *args, **kwargs):
        log(self, at, *args, **kwargs)
        if at == frames:
            raise Interrupted

    with monkeypatch.context() as patch:
        patch.setattr(Run, "log", stopping)
        with pytest.raises(Interrupted):
            run(out, *overrides)
