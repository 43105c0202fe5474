"""Runs of the MuJoCo recipe that take a second."""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path

import pytest
from hydra import compose, initialize_config_dir
from omegaconf import DictConfig

from recipes.mujoco import train
from recipes.mujoco.run import Run

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
    "checkpoint.interval=64",
    "compile=false",
]


@lru_cache
def composed(*overrides: str) -> DictConfig:
    with initialize_config_dir(str(ROOT / "conf"), version_base="1.3"):
        return compose("mujoco", overrides=list(overrides))


def config(out: Path, *overrides: str) -> DictConfig:
    """What Hydra makes of a command line, once for each: it takes a tenth of a second, a tiny run not much more."""
    cfg = composed(*TINY, *overrides).copy()
    cfg.out = str(out)
    return cfg


def run(out: Path, *overrides: str) -> Path:
    train.run(config(out, *overrides))
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
