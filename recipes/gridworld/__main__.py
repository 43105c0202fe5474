"""The tabular study: in each world a teacher, then every student with every prior; tables and figures of all of them.

    python -m recipes.gridworld [study=paper|small|beyond|comparisons] [key=value ...]

An interrupted run continues where it was; a finished one only reports again. See ``conf/gridworld.yaml`` for the keys.
"""

from __future__ import annotations

import hydra

from recipes.common.sweeps import fail, start
from recipes.gridworld.config import GridworldConfig, check
from recipes.gridworld.study import open_folder, report, run_study


@hydra.main(version_base="1.3", config_path="../../conf", config_name="gridworld")
def main(cfg: GridworldConfig) -> str | None:
    """Run or continue a study."""
    try:
        check(cfg)
        folder = open_folder(cfg)
        try:
            report(cfg, folder, run_study(cfg, folder))
        finally:
            folder.release()
    except (ValueError, OSError) as error:
        return fail(f"Error: {error}")
    return None


if __name__ == "__main__":
    start(main, "gridworld")
