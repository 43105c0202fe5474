"""Many runs of the MuJoCo recipe as one study: what is missing is run, and what is finished is kept in small tables.

    python -m recipes.mujoco_study study_mujoco=trial [workers=2] [run=false] [key=value ...]

The tables are all that a report needs, and all that has to be kept: ``<name>.csv`` has every evaluation,
``<name>_training.csv`` the means of what training measured, ``<name>_trials.csv`` who won the trials,
``<name>_teachers.csv`` the return of each teacher, ``<name>_settings.csv`` what else runs were told. A run that is in
them is not run again, on whichever machine they are. One that was interrupted goes on from its checkpoint, and one that
fails or is killed stops no other. Runs whose teacher the study makes wait for it. ``run=false`` says what is missing.
"""

from __future__ import annotations

import sys
from pathlib import Path

import hydra
from omegaconf import OmegaConf

from recipes.common.checks import check_keys
from recipes.common.run_folder import keep_others_out
from recipes.common.sweeps import start
from recipes.mujoco_study.plan import StudyConfig, expand
from recipes.mujoco_study.tables import Tables
from recipes.mujoco_study.work import check_makers, run_missing, summary


def study(cfg: StudyConfig) -> None:
    """Say what is missing, and run it.

    Raises:
        ValueError: bad input, another study at work on these tables, or runs that failed; the message names them.
    """
    check_keys(cfg)
    runs, tables = expand(cfg), Tables(Path(cfg.out), cfg.name)
    tables.check(runs)
    check_makers(runs, tables)
    for line in summary(runs, tables):
        print(line, flush=True)
    if not cfg.run:
        return
    file = Path(cfg.out) / f".{cfg.name}.lock"
    lock = keep_others_out(file, f"out={cfg.out} name={cfg.name}: another study is at work on these tables")
    try:
        if failed := run_missing(runs, tables, cfg.workers):
            raise ValueError("\n".join(["Not all runs are done:", *failed]))
    finally:
        lock.release()


@hydra.main(version_base="1.3", config_path="../../conf", config_name="mujoco_study")
def main(cfg: StudyConfig) -> None:
    """Run a study."""
    OmegaConf.resolve(cfg)  # type: ignore[arg-type]
    try:
        study(cfg)
    except (ValueError, OSError, ImportError) as error:
        sys.exit(f"Error: {error}")


if __name__ == "__main__":
    start(main, "mujoco_study")
