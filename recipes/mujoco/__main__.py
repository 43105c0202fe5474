"""PPO with an AVEC critic on MuJoCo, learning from a teacher by any of the methods.

    python -m recipes.mujoco env=hopper method=ae2r prior.path=teacher.safetensors [key=value ...]

A run keeps everything in one folder: ``eval.csv``, ``metrics.csv``, checkpoints and, at the end, the teacher that it
makes, ``policy.safetensors``. An interrupted run continues with the same command; a finished one is not run again. See
``conf/mujoco.yaml`` for the keys.
"""

from __future__ import annotations

import hydra

from recipes.common.sweeps import start
from recipes.mujoco.config import MujocoConfig
from recipes.mujoco.train import run


@hydra.main(version_base="1.3", config_path="../../conf", config_name="mujoco")
def main(cfg: MujocoConfig) -> str | None:
    """Train, or continue training, one agent."""
    return run(cfg)


if __name__ == "__main__":
    start(main, "mujoco")
