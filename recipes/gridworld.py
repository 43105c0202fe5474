"""The tabular study: sample worlds, train a teacher in each, then every student with every prior, and report.

    python -m recipes.gridworld [study=small|paper|beyond] [key=value ...]

An interrupted run continues where it was; a finished one only reports again. See ``conf/gridworld.yaml`` for the keys.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import hydra
import numpy as np
import torch
from omegaconf import OmegaConf
from tqdm import tqdm

from recipes import gridworld_report
from recipes.gridworld_config import GridworldConfig, check
from recipes.launchers import fail
from recipes.runs import RunFolder, digest
from recipes.schedule_config import applies, make_schedule, without_idle
from recipes.workers import run_all
from torchrl_priors.envs import GridMaps, GridWorlds, sample_worlds
from torchrl_priors.random import derive_key
from torchrl_priors.tabular import (
    Hyper,
    StudentConfig,
    TeacherHyper,
    evaluate_greedy,
    parse_prior,
    runs_of,
    sample_degraded,
    train_students,
    train_teachers,
)

#: Teachers trained together.
_TEACHERS = 2048
#: What the results do not depend on.
_INCIDENTAL = ("out", "workers", "lanes", "block_worlds")


def open_folder(cfg: GridworldConfig) -> RunFolder:
    """The folder of this configuration's results."""
    plain: Any = OmegaConf.to_container(cfg, resolve=True)
    matters = {key: value for key, value in plain.items() if key not in _INCIDENTAL}
    matters = without_idle(matters, cfg.schedule, cfg.methods)
    path = Path(cfg.out or f"outputs/gridworld/{cfg.name}-{digest(matters)}")
    return RunFolder(path, matters, OmegaConf.to_yaml(cfg, resolve=True))


def world_sampler(cfg: GridworldConfig, seeds: torch.Tensor) -> GridWorlds:
    """One world per seed."""
    world = cfg.world
    return sample_worlds(
        seeds, size=world.size, window=world.window, wall_prob=world.wall_prob, object_prob=world.object_prob
    )


def teachers(cfg: GridworldConfig, folder: RunFolder) -> dict[str, np.ndarray]:
    """Action values and facts about each world; kept in ``teachers.npz``."""
    hyper = TeacherHyper(cfg.teacher.gamma, cfg.teacher.lr, cfg.teacher.epsilon, cfg.world.noise, cfg.world.end_prob)

    def compute() -> dict[str, np.ndarray]:
        seeds = torch.arange(cfg.seed, cfg.seed + cfg.worlds, device=cfg.device)
        parts = []
        with tqdm(total=cfg.worlds * cfg.teacher.steps, unit="step", unit_scale=True, desc="teachers") as bar:
            for chunk in seeds.split(_TEACHERS):
                worlds = world_sampler(cfg, chunk)
                q, visited = train_teachers(
                    worlds, chunk, hyper, steps=cfg.teacher.steps, compile=cfg.compile, progress=bar.update
                )
                start = worlds.start + torch.arange(len(chunk), device=cfg.device) * worlds.num_cells
                returns, lengths = evaluate_greedy(
                    GridMaps.from_worlds(worlds),
                    derive_key(chunk, "teacher-evaluation"),
                    start,
                    q.flatten(),
                    hyper,
                    episodes=cfg.teacher.eval_episodes,
                )
                part = {"seed": chunk, "q": q, "visited": visited, "return": returns, "length": lengths}
                parts.append(part | {"goal": worlds.has_goal()})
        return {name: torch.cat([part[name] for part in parts]).cpu().numpy() for name in parts[0]}

    return folder.arrays("teachers", compute)


def student_config(cfg: GridworldConfig) -> StudentConfig:
    """How students learn."""
    rates, points, interval = cfg.student.lr_weight, cfg.evaluation.points, cfg.evaluation.interval
    annealed = any(applies(cfg.schedule, method) for method in cfg.methods)
    return StudentConfig(
        hyper=Hyper(
            gamma=cfg.student.gamma,
            lr=cfg.student.lr,
            noise=cfg.world.noise,
            end_prob=cfg.world.end_prob,
            eval_interval=interval,
            eval_points=points,
            schedule=make_schedule(cfg.schedule, points * interval) if annealed else None,
        ),
        lr_weight={"td": rates.shaped if cfg.td_error == "shaped" else rates.original, "advantage": rates.advantage},
        td_error=cfg.td_error,
        bonus_coeff=cfg.student.bonus_coeff,
        aux_coeff=cfg.student.aux_coeff,
        temperature=cfg.teacher.temperature,
        anneal_all=cfg.schedule.methods == "all",
    )


@dataclass(frozen=True)
class Block:
    """Some worlds of a study, whose students are trained as one batch and kept in one file."""

    cfg: GridworldConfig
    folder: RunFolder
    name: str
    worlds: slice


def train_block(block: Block, progress: Callable[[int], Any]) -> None:
    """Train every student in the block's worlds, unless they are there already."""
    block.folder.arrays(block.name, lambda: {"episodes": _train(block, progress)})


def _train(block: Block, progress: Callable[[int], Any]) -> np.ndarray:
    cfg = block.cfg
    taught = block.folder.arrays("teachers")
    seeds, q, visited = (
        torch.from_numpy(taught[name][block.worlds]).to(cfg.device) for name in ("seed", "q", "visited")
    )
    counts = sorted({parse_prior(prior).structural for prior in cfg.priors} - {0})
    episodes = train_students(
        world_sampler(cfg, seeds),
        seeds,
        q,
        {count: sample_degraded(q, visited, seeds, count, cfg.teacher.temperature) for count in counts},
        runs_of(cfg.methods, cfg.priors),
        student_config(cfg),
        lanes=cfg.lanes,
        compile=cfg.compile,
        progress=progress,
    )
    return episodes.cpu().numpy()


def students(cfg: GridworldConfig, folder: RunFolder) -> np.ndarray:
    """Evaluation episodes of every run, ``[worlds, pairs, points, fields]``; each block is kept in ``blocks/``."""
    workers = (len(os.sched_getaffinity(0)) if cfg.workers is None else cfg.workers) if cfg.device == "cpu" else 1
    pairs = len(runs_of(cfg.methods, cfg.priors))
    # Blocks are equal in size, for a compiled step serves one shape: the last one is filled up with worlds of the one
    # before, whose results are the same there. Small studies are split too, so that every worker has a block.
    count = max(-(-cfg.worlds // cfg.block_worlds), min(workers, cfg.worlds))
    size = -(-cfg.worlds // count)
    firsts = range(0, cfg.worlds, size)
    begins = [min(first, cfg.worlds - size) for first in firsts]
    blocks = [
        Block(cfg, folder, f"blocks/{first:06d}-{size}", slice(begin, begin + size))
        for first, begin in zip(firsts, begins, strict=True)
    ]
    # Read at once what is there, so that a damaged file is found before any work.
    kept = {block.name: folder.arrays(block.name)["episodes"] for block in blocks if folder.has(block.name)}
    missing = [block for block in blocks if block.name not in kept]
    budget = size * pairs * cfg.evaluation.points * cfg.evaluation.interval
    with tqdm(total=len(blocks) * budget, unit="step", unit_scale=True, desc="students") as bar:
        bar.update((len(blocks) - len(missing)) * budget)
        # Runs end with an episode, a little after their budget.
        run_all(train_block, missing, workers, lambda steps: bar.update(min(steps, bar.total - bar.n)))
        bar.update(bar.total - bar.n)
    kept |= {block.name: folder.arrays(block.name)["episodes"] for block in missing}
    offsets = [first - begin for first, begin in zip(firsts, begins, strict=True)]
    return np.concatenate([kept[block.name][offset:] for block, offset in zip(blocks, offsets, strict=True)])


@hydra.main(version_base="1.3", config_path="../conf", config_name="gridworld")
def main(cfg: GridworldConfig) -> str | None:
    """Run or continue a study."""
    try:
        check(cfg)
        folder = open_folder(cfg)
        torch.set_num_threads(1)  # rows are spread over processes instead, see `workers`
        taught = teachers(cfg, folder)
        episodes = students(cfg, folder)
        gridworld_report.write(cfg, folder, world_sampler(cfg, torch.from_numpy(taught["seed"])), taught, episodes)
    except (ValueError, OSError) as error:
        return fail(f"Error: {error}")
    return None


if __name__ == "__main__":
    main()
