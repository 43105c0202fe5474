"""What Hydra makes of a command line, and what a process is started with."""

from __future__ import annotations

import os
from functools import lru_cache
from pathlib import Path

from hydra import compose, initialize_config_dir
from omegaconf import DictConfig

CONF = Path(__file__).parents[2] / "conf"


@lru_cache
def _composed(name: str, *overrides: str) -> DictConfig:
    with initialize_config_dir(str(CONF), version_base="1.3"):
        return compose(name, overrides=list(overrides))


def composed(name: str, *overrides: object) -> DictConfig:
    """The configuration of a recipe, composed once for each command line: that takes longer than a tiny run does."""
    return _composed(name, *map(str, overrides)).copy()


def with_another_hash_seed() -> dict[str, str]:
    """The environment of a process that orders sets differently than this one."""
    return {**os.environ, "PYTHONHASHSEED": "2" if os.environ.get("PYTHONHASHSEED") == "1" else "1"}
