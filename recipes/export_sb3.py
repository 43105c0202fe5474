"""Make a teacher of a Stable-Baselines3 policy, for ``prior.path`` of ``recipes.mujoco``.

python -m recipes.export_sb3 model=ppo.zip vecnormalize=vec.pkl env_id=Hopper-v5 out=teacher.safetensors
"""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path

import hydra
from hydra.core.config_store import ConfigStore
from omegaconf import MISSING
from torchrl.modules import TanhNormal

from recipes.common.checks import check_keys, require_file_name
from recipes.common.sweeps import start
from torchrl_priors.artifacts import load_sb3_prior, save_prior


@dataclass
class ExportConfig:
    """The whole configuration of ``python -m recipes.export_sb3``."""

    model: str = MISSING
    env_id: str = MISSING
    out: str = MISSING
    vecnormalize: str | None = MISSING
    std: float | None = MISSING
    activation: str | None = MISSING


ConfigStore.instance().store(group="schema", name="export_sb3", node=ExportConfig, package="_global_")


def export(cfg: ExportConfig) -> None:
    """Convert the policy, and write it.

    Raises:
        ValueError: see :func:`load_sb3_prior`; or it is one that the students of ``recipes.mujoco`` can't learn from.
    """
    check_keys(cfg)
    require_file_name(cfg.out)
    prior = load_sb3_prior(cfg.model, vecnormalize=cfg.vecnormalize, std=cfg.std, activation=cfg.activation)
    if prior.distribution_class is TanhNormal:
        raise ValueError(
            f"std=null: {cfg.model} is a SAC policy, whose squashed Gaussian has no finite opinion beyond the bounds of"
            " the actions, and the students of recipes.mujoco are Gaussians: set std, the spread around its action, in"
            " the unit of the action. (save_prior writes it as it is.)"
        )
    files = {"model": cfg.model, "vecnormalize": cfg.vecnormalize}
    training = {name: None if path is None else Path(path).name for name, path in files.items()}
    save_prior(cfg.out, prior, env_id=cfg.env_id, training={"from": "stable_baselines3", **training})
    print(f"Written: {cfg.out}")


@hydra.main(version_base="1.3", config_path="../conf", config_name="export_sb3")
def main(cfg: ExportConfig) -> None:
    """Export one policy."""
    try:
        export(cfg)
    except (ValueError, OSError, ImportError) as error:
        sys.exit(f"Error: {error}")


if __name__ == "__main__":
    start(main, "export_sb3")
