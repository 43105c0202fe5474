"""PPO with an AVEC critic on MuJoCo, learning from a teacher by any of the methods.

    python -m recipes.mujoco env.id=LunarLander-v3 prior.path=ppo.zip
    python -m recipes.mujoco env=hopper method=ae2r prior.path=teacher.safetensors [key=value ...]

A run keeps everything in one folder: ``eval.csv``, ``metrics.csv``, checkpoints and, at the end, the teacher that it
makes, ``policy.safetensors``. An interrupted run continues with the same command; a finished one is not run again. See
``conf/mujoco.yaml`` for the keys.
"""

from __future__ import annotations

import re
import sys

import hydra

from recipes.common.sweeps import start
from recipes.mujoco.config import MujocoConfig
from recipes.mujoco.train import run


@hydra.main(version_base="1.3", config_path="../../conf", config_name="mujoco")
def _main(cfg: MujocoConfig) -> str | None:
    return run(cfg)


def main() -> None:
    """Train, or continue training, one agent."""
    sys.argv[1:] = with_env(sys.argv[1:])
    _main()


def with_env(words: list[str]) -> list[str]:
    """The command line, with ``env=any`` where an environment is given by its id and version only.

    Examples:
        >>> with_env(["env.id=LunarLander-v3", "seed=1"])
        ['env.id=LunarLander-v3', 'seed=1', 'env=any']
    """
    by_id = any(re.match(r"env\.id=.*-v\d", word) for word in words)
    return [*words, "env=any"] if by_id and not any(word.startswith("env=") for word in words) else words


if __name__ == "__main__":
    start(main, "mujoco")
