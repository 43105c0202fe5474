"""Sweeps: one run after the other, and on a cluster of Slurm."""

from __future__ import annotations

import os
from pathlib import Path

import pytest
from hydra import compose, initialize_config_dir
from hydra.core.config_store import ConfigStore
from hydra.core.plugins import Plugins
from hydra.utils import instantiate
from sweep_cases import sweep

import recipes.gridworld.config  # noqa: F401 (stores the schema)
from recipes.common.sweeps import cores

submitit = pytest.importorskip("submitit")

ROOT = Path(__file__).parents[2]


@pytest.mark.parametrize("launcher", ["basic", "submitit_local"])
def test_a_broken_run_does_not_stop_the_others(tmp_path: Path, launcher: str) -> None:
    result, done = sweep(tmp_path, "seed=range(3)", "raises=0", f"hydra/launcher={launcher}")
    assert list(done) == ["1", "2"]
    assert result.returncode != 0
    assert "seed 0 is broken" in result.stderr


def test_cores_falls_back_to_one_run_after_the_other_without_ray(tmp_path: Path) -> None:
    with initialize_config_dir(str(ROOT / "conf"), version_base="1.3"):
        Plugins.instance()
        ConfigStore.instance().store(group="hydra/launcher", name="alone", node=cores(installed=False))
        cfg = compose("gridworld", ["hydra/launcher=alone"], return_hydra_config=True)
    assert cfg.hydra.launcher._target_.endswith("BasicLauncher")


def test_the_slurm_launcher_is_instantiated_and_asks_for_one_core_a_run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with initialize_config_dir(str(ROOT / "conf"), version_base="1.3"):
        cfg = compose("gridworld", ["hydra/launcher=slurm", "hydra.launcher.partition=cpu"], return_hydra_config=True)
    cfg.hydra.sweep.dir, cfg.hydra.job.name = str(tmp_path), "gridworld"
    launcher = instantiate(cfg.hydra.launcher)
    assert type(launcher).__name__ == "SlurmLauncher"

    for program in ("sbatch", "srun"):  # a cluster to look at, though not to run on
        (tmp_path / program).write_text("#!/bin/sh\n")
        (tmp_path / program).chmod(0o755)
    monkeypatch.setenv("PATH", str(tmp_path), prepend=os.pathsep)
    executor = submitit.SlurmExecutor(folder=tmp_path)
    own = {"submitit_folder", "max_num_timeout"}
    names = executor._equivalence_dict()
    executor.update_parameters(
        **{names.get(name, name): value for name, value in launcher.params.items() if name not in own}
    )
    script = executor._make_submission_file_text("python", "0")
    assert "#SBATCH --cpus-per-task=1" in script
    assert "#SBATCH --partition=cpu" in script
    assert "#SBATCH --time=720" in script
    assert "export OMP_NUM_THREADS=1" in script
