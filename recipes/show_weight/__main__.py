"""What the prior weight of a run does: maps of it in a gridworld, or its course along an episode of MuJoCo.

    python -m recipes.show_weight run=<folder> [key=value ...]

See ``conf/show_weight.yaml`` for the keys.
"""

from __future__ import annotations

import sys

import hydra

from recipes.common.sweeps import start
from recipes.show_weight.show import ShowConfig, show


@hydra.main(version_base="1.3", config_path="../../conf", config_name="show_weight")
def main(cfg: ShowConfig) -> None:
    """Show what a weight does."""
    try:
        print("Written:", *(f"  {path}" for path in show(cfg)), sep="\n")
    except (ValueError, OSError, ImportError) as error:
        sys.exit(f"Error: {error}")


if __name__ == "__main__":
    start(main, "show_weight")
