"""Which figures a run has of its prior weight; maps of the weight in a gridworld."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from hydra.core.config_store import ConfigStore
from omegaconf import MISSING, OmegaConf

from recipes import plots
from recipes.common.checks import check_keys
from recipes.gridworld.run_parts import parse_prior
from recipes.gridworld.study import TaughtWorld, make_learner
from recipes.report.runs import is_gridworld
from recipes.show_weight.source import read_config, reading
from torchrl_priors.methods import get_method


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
    from recipes.show_weight.episode import show_episode  # needs MuJoCo

    return show_episode(
        folder, out, seed=cfg.seed, steps=cfg.episode.steps, teacher=cfg.episode.teacher, video=cfg.episode.video
    )


def _show_gridworld(cfg: ShowConfig, folder: Path, out: Path) -> list[Path]:
    idle = {"schedule": {"methods": "annealed"}}  # a study may be older than schedules
    study: Any = OmegaConf.merge(idle, read_config(folder))
    with reading(folder / "config.yaml"):
        return _maps(cfg, study, folder, out)


def _maps(cfg: ShowConfig, study: Any, folder: Path, out: Path) -> list[Path]:
    method, prior, last = cfg.gridworld.method, cfg.gridworld.prior, study.evaluation.points
    parse_prior(prior)
    if not get_method(method).adaptive:
        raise ValueError(f"gridworld.method={method}: it has no learned weight.")
    if not 0 <= cfg.seed < study.worlds:
        raise ValueError(f"seed={cfg.seed}: the study in {folder} has worlds 0 to {study.worlds - 1}.")
    points = sorted({min(point, last) for point in cfg.gridworld.points})
    if not points or points[0] < 1:
        raise ValueError(f"gridworld.points={cfg.gridworld.points}: expected numbers from 1 to {last}.")

    # One student of the study once more: its runs depend on their seed alone.
    taught = TaughtWorld(study, study.seed + cfg.seed)
    advice = taught.advice(prior)
    _, weights, visits = taught.train(method, prior, advice, make_learner(study, method), watch=True)
    world, bad, state = taught.grid[0], advice.degraded, taught.world.state

    def square(values: Any) -> Any:
        return np.asarray(values).reshape(world.size, world.size)

    blank = square((world.kind == 1) | world.terminal)
    maps = {}
    for point in points:
        weight = square(np.where(visits[point - 1] > 0, weights[point - 1], np.nan)[state])
        maps[f"After {point * study.evaluation.interval:,} transitions"] = np.where(blank, np.nan, weight)
    figure = plots.weight_maps(
        taught.grid.layers(),
        maps,
        square(bad[state]),
        steps=np.arange(1, last + 1) * study.evaluation.interval,
        over_degraded=mean_over(bad, weights, visits),
        over_other=mean_over(~bad, weights, visits),
    )
    return plots.save_figure(figure, out / f"weight_{method}_{prior}_{cfg.seed}")


def mean_over(states: np.ndarray, weights: np.ndarray, visits: np.ndarray) -> np.ndarray:
    """Mean weight of the states (bool ``[C]``) that were visited by then, at each point; NaN if there is none."""
    seen = (visits > 0) & states
    with np.errstate(invalid="ignore"):
        return np.where(seen, weights, 0.0).sum(-1) / seen.sum(-1)
