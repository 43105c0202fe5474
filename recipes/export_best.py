"""Pick a teacher as the paper does: the baseline whose last evaluation is the best over the seeds.

python -m recipes.export_best runs=outputs/mujoco env_id=Hopper-v5 out=teacher.safetensors
"""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import hydra
from hydra.core.config_store import ConfigStore
from omegaconf import MISSING

from recipes.common.checks import check_keys, require_file_name
from recipes.common.sweeps import start
from recipes.report.runs import FinishedRun, find, read
from torchrl_priors.artifacts import read_manifest
from torchrl_priors.atomic import write_atomically


@dataclass
class ExportConfig:
    """The whole configuration of ``python -m recipes.export_best``."""

    runs: Any = MISSING
    env_id: str = MISSING
    out: str = MISSING
    method: str = MISSING


ConfigStore.instance().store(group="schema", name="export_best", node=ExportConfig, package="_global_")


def last_return(run: FinishedRun) -> float:
    """Mean return of the run's last evaluation."""
    return float(run.evaluations["mean_return"].iloc[-1])


def export(cfg: ExportConfig) -> None:
    """Copy the policy of the best run, and print the candidates.

    Raises:
        ValueError: no finished run of that method and environment, or its policy is damaged or of another one.
    """
    check_keys(cfg)
    require_file_name(cfg.out)
    runs, left_out = read(find(cfg.runs))
    runs = [run for run in runs if run.env == cfg.env_id and run.method == cfg.method]
    if not runs:
        others = "".join(f"\n  {run.path}: {run.reason}" for run in left_out)
        raise ValueError(f"No finished run of method={cfg.method} on env_id={cfg.env_id} in runs={cfg.runs}.{others}")
    for entry in left_out:
        print(f"Left out: {entry.path}: {entry.reason}", file=sys.stderr)
    runs.sort(key=last_return, reverse=True)
    for run in runs:
        print(f"{last_return(run):10.1f}  seed {run.seed}  {run.path}")
    best = runs[0].path / "policy.safetensors"
    manifest = read_manifest(best)
    if manifest.env_id != cfg.env_id.split(" (")[0]:  # a policy does not say with which arguments its environment was
        raise ValueError(f"{best} is a policy for {manifest.env_id}, expected {cfg.env_id}.")
    write_atomically(Path(cfg.out), best.read_bytes())
    print(f"Written: {cfg.out}")


@hydra.main(version_base="1.3", config_path="../conf", config_name="export_best")
def main(cfg: ExportConfig) -> None:
    """Export the best teacher."""
    try:
        export(cfg)
    except (ValueError, OSError, ImportError) as error:
        sys.exit(f"Error: {error}")


if __name__ == "__main__":
    start(main, "export_best")
