"""What the prior weight of a run does: maps of it in a gridworld, or its course along an episode of MuJoCo.

    python -m recipes.show_weight run=<folder> [key=value ...]

See ``conf/show_weight.yaml`` for the keys.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import hydra
import torch
from hydra.core.config_store import ConfigStore
from omegaconf import MISSING, OmegaConf
from tqdm import tqdm

from recipes.checks import check_keys
from recipes.gridworld import student_config, world_sampler
from recipes.report_runs import is_gridworld
from torchrl_priors import plots
from torchrl_priors.methods import get_method
from torchrl_priors.tabular import TeacherHyper, parse_prior, sample_degraded, train_teachers, weight_history


@dataclass
class Gridworld:
    """Which run of a study, and when."""

    method: str = MISSING
    prior: str = MISSING
    points: list[int] = MISSING


@dataclass
class Episode:
    """The episode of a MuJoCo run."""

    steps: int = MISSING
    teacher: str | None = MISSING
    video: bool = MISSING


@dataclass
class ShowConfig:
    """The whole configuration of ``python -m recipes.show_weight``."""

    run: str = MISSING
    out: str | None = MISSING
    seed: int = MISSING
    gridworld: Gridworld = field(default_factory=Gridworld)
    episode: Episode = field(default_factory=Episode)


ConfigStore.instance().store(group="schema", name="show_weight", node=ShowConfig, package="_global_")


def show(cfg: ShowConfig) -> list[Path]:
    """Make the figures of a run; their files.

    Raises:
        ValueError: there is no such run, or it has no learned weight, or a setting is out of range.
        OSError: something cannot be read or written.
    """
    check_keys(cfg)
    folder = Path(cfg.run)
    if not (folder / "config.yaml").is_file():
        raise ValueError(f"run={folder}: no run or study is there (it would have a config.yaml).")
    if not 0 <= cfg.seed < 2**31:
        raise ValueError(f"seed={cfg.seed}: expected a number in [0, 2**31).")
    out = Path(cfg.out) if cfg.out else folder
    if is_gridworld(folder):
        return _show_gridworld(cfg, folder, out)
    from recipes.show_episode import show_episode  # needs MuJoCo

    return show_episode(
        folder, out, seed=cfg.seed, steps=cfg.episode.steps, teacher=cfg.episode.teacher, video=cfg.episode.video
    )


def _show_gridworld(cfg: ShowConfig, folder: Path, out: Path) -> list[Path]:
    idle = {"schedule": {"methods": "annealed"}}  # a study may be older than schedules
    study: Any = OmegaConf.merge(idle, OmegaConf.load(folder / "config.yaml"))
    method, prior, last = cfg.gridworld.method, cfg.gridworld.prior, study.evaluation.points
    count = parse_prior(prior).structural
    if not get_method(method).adaptive:
        raise ValueError(f"gridworld.method={method}: it has no learned weight.")
    if not 0 <= cfg.seed < study.worlds:
        raise ValueError(f"seed={cfg.seed}: the study in {folder} has worlds 0 to {study.worlds - 1}.")
    points = sorted({min(point, last) for point in cfg.gridworld.points})
    if not points or points[0] < 1:
        raise ValueError(f"gridworld.points={cfg.gridworld.points}: expected numbers from 1 to {last}.")

    seeds = torch.tensor([study.seed + cfg.seed])
    world = world_sampler(study, seeds)
    hyper = TeacherHyper(
        study.teacher.gamma, study.teacher.lr, study.teacher.epsilon, study.world.noise, study.world.end_prob
    )
    torch.set_num_threads(1)
    q, visited = train_teachers(world, seeds, hyper, steps=study.teacher.steps, compile=study.compile)
    degraded = {count: sample_degraded(q, visited, seeds, count, study.teacher.temperature)} if count else {}
    study.methods = [method]
    with tqdm(total=last, unit="evaluation", desc=f"{method}, {prior}") as bar:
        history = weight_history(
            world,
            int(seeds),
            q,
            degraded,
            (method, prior),
            student_config(study),
            compile=study.compile,
            progress=bar.update,
        )
    bad = degraded[count][0] if count else torch.zeros(world.num_cells, dtype=torch.bool)
    state = world.state[0]

    def square(values: torch.Tensor) -> Any:
        return values.view(world.size, world.size).numpy()

    maps = {}
    for point in points:
        seen = history.visits[point - 1] > 0
        weight = torch.where(seen, history.weight[point - 1], torch.nan)[state]
        weight[(world.kind[0] == 1) | world.terminal[0]] = torch.nan
        maps[f"After {point * study.evaluation.interval:,} transitions"] = square(weight)
    figure = plots.weight_maps(
        {
            "walls": square(world.kind[0] == 1),
            "rewards": square(world.reward[0]),
            "terminal": square(world.terminal[0]),
            "start": divmod(int(world.start), world.size),
        },
        maps,
        square(bad[state]),
        steps=torch.arange(1, last + 1) * study.evaluation.interval,
        over_degraded=history.mean_over(bad),
        over_other=history.mean_over(~bad),
    )
    return plots.save_figure(figure, out / f"weight_{method}_{prior}_{cfg.seed}")


@hydra.main(version_base="1.3", config_path="../conf", config_name="show_weight")
def main(cfg: ShowConfig) -> None:
    """Show what a weight does."""
    try:
        print("Written:", *(f"  {path}" for path in show(cfg)), sep="\n")
    except (ValueError, OSError, ImportError) as error:
        sys.exit(f"Error: {error}")


if __name__ == "__main__":
    main()
