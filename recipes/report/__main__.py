"""Report finished runs: tables (CSV), figures (PDF, PNG) and a page in Markdown.

    python -m recipes.report runs=<folder, glob or list> [out=<folder>] [key=value ...]

Runs are those of ``recipes.mujoco``, the table of a study of them, or studies of ``recipes.gridworld``. A run or study
that isn't finished, or whose data have holes, is named and in no table. See ``conf/report.yaml`` for the keys.
"""

from __future__ import annotations

import sys

import hydra

from recipes.common.sweeps import start
from recipes.report.config import ReportConfig
from recipes.report.page import report


@hydra.main(version_base="1.3", config_path="../../conf", config_name="report")
def main(cfg: ReportConfig) -> None:
    """Write a report and say where it is."""
    try:
        print(f"Written: {report(cfg)}")
    except (ValueError, OSError) as error:
        sys.exit(f"Error: {error}")


if __name__ == "__main__":
    start(main, "report")
