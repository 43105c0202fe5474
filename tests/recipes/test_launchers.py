"""Sweeps: runs side by side on the cores of a machine, and on a cluster."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest
from hydra import compose, initialize_config_dir
from hydra.core.config_store import ConfigStore
from hydra.core.plugins import Plugins
from hydra.utils import instantiate

import recipes.gridworld.config  # noqa: F401 (stores the schema)
from recipes.common.sweeps import cores

pytest.importorskip("hydra_plugins.hydra_joblib_launcher")
submitit = pytest.importorskip("submitit")

ROOT = Path(__file__).parents[2]

# A recipe that does nothing, below the configuration of those that do: its launchers are theirs.
RECIPE = """
import os
import hydra
from hydra.core.config_store import ConfigStore
import recipes.common.sweeps

ConfigStore.instance().store(
    name="nothing",
    node={
        "defaults": ["_self_", {"override hydra/launcher": "cores"}],
        "seed": 0,
        "broken": -1,
        "out": "out",
        "hydra": {"run": {"dir": "."}, "sweep": {"dir": "sweep", "subdir": "."}, "output_subdir": None},
    },
)

@hydra.main(version_base="1.3", config_path="{conf}", config_name="nothing")
def main(cfg):
    if cfg.seed == cfg.broken:
        raise ValueError(f"seed {cfg.seed} is broken")
    with open(f"{cfg.out}/{cfg.seed}", "w") as file:
        file.write(f"{os.getpid()} {os.environ.get('OMP_NUM_THREADS')}")

if __name__ == "__main__":
    main()
"""


def sweep(folder: Path, *arguments: str) -> tuple[subprocess.CompletedProcess[str], dict[str, list[str]]]:
    (folder / "nothing.py").write_text(RECIPE.replace("{conf}", str(ROOT / "conf")))
    (folder / "out").mkdir()
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    command = [sys.executable, "nothing.py", "-m", *arguments]
    result = subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True, check=False)
    return result, {file.name: file.read_text().split() for file in sorted((folder / "out").iterdir())}


def test_a_sweep_runs_on_processes_of_its_own_with_one_thread_each(tmp_path: Path) -> None:
    result, done = sweep(tmp_path, "seed=range(3)", "hydra.launcher.n_jobs=2")
    assert result.returncode == 0, result.stderr
    assert list(done) == ["0", "1", "2"]
    cores_each = max(1, len(os.sched_getaffinity(0)) // 2)
    assert {int(threads) for _, threads in done.values()} <= set(range(1, cores_each + 1))


@pytest.mark.parametrize("launcher", ["cores", "basic", "submitit_local"])
def test_a_broken_run_does_not_stop_the_others(tmp_path: Path, launcher: str) -> None:
    result, done = sweep(tmp_path, "seed=range(3)", "broken=0", f"hydra/launcher={launcher}")
    assert list(done) == ["1", "2"]
    assert result.returncode != 0
    assert "seed 0 is broken" in result.stderr


def test_cores_falls_back_to_one_run_after_the_other_without_the_plugin(tmp_path: Path) -> None:
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
