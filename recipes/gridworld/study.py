"""The tabular study: in each world a teacher, then every student with every prior."""

from __future__ import annotations

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from omegaconf import OmegaConf

from recipes import plots
from recipes.common.progress import progress_bar
from recipes.common.run_folder import RunFolder, digest
from recipes.common.schedules import applies, make_schedule, without_idle
from recipes.gridworld import page, run_parts, tabular
from recipes.gridworld.config import GridworldConfig
from recipes.gridworld.tables import Episodes, prior_weight_curves, tables_of
from recipes.gridworld.worlds import GridWorlds, sample_worlds

#: What the results do not depend on.
_INCIDENTAL = ("out", "workers", "block_worlds", "bootstrap")


def open_folder(cfg: GridworldConfig) -> RunFolder:
    """The folder of this configuration's results."""
    plain: Any = OmegaConf.to_container(cfg, resolve=True)
    matters = {key: value for key, value in plain.items() if key not in _INCIDENTAL}
    matters = without_idle(matters, cfg.schedule, cfg.methods)
    path = Path(cfg.out or f"outputs/gridworld/{cfg.name}-{digest(matters)}")
    return RunFolder(path, matters, OmegaConf.to_yaml(cfg, resolve=True))


def sample_world(cfg: GridworldConfig, seed: int) -> GridWorlds:
    """The world of a seed, as a batch of one."""
    names = ("size", "window", "wall_prob", "object_prob")
    return sample_worlds(torch.tensor([seed]), **{name: cfg.world[name] for name in names})  # type: ignore[index]


def make_learner(cfg: GridworldConfig, method: str) -> run_parts.Learner:
    """How the students of a method learn."""
    rates, budget = cfg.student.lr_weight, cfg.evaluation.points * cfg.evaluation.interval
    schedule = None
    if applies(cfg.schedule, method):
        schedule = make_schedule(cfg.schedule, budget)(torch.arange(budget + 1)).double().numpy()
    return run_parts.learner_of(
        method,
        gamma=cfg.student.gamma,
        lr=cfg.student.lr,
        lr_weight={"td": rates.shaped if cfg.td_error == "shaped" else rates.original, "advantage": rates.advantage},
        td_error=cfg.td_error,
        bonus_coeff=cfg.student.bonus_coeff,
        aux_coeff=cfg.student.aux_coeff,
        cross_entropy=cfg.student.cross_entropy,
        schedule=schedule,
    )


class TaughtWorld:
    """A world with its teacher, and the students who learn there.

    Args:
        cfg (GridworldConfig): the study.
        seed (int): of the world and of everything in it.
    """

    def __init__(self, cfg: GridworldConfig, seed: int) -> None:
        self.cfg, self.seed = cfg, seed
        self.grid = sample_world(cfg, seed)
        self.world = run_parts.World.of(self.grid, cfg.world.noise, cfg.world.end_prob)
        self.q, self.visited = self.teach()

    def teach(self) -> tuple[np.ndarray, np.ndarray]:
        """Action values of the teacher, ``[C, 4]``, and which states it visited, ``[C]``."""
        states, cfg = len(self.world.state), self.cfg.teacher
        q, visited, rng = np.zeros((states, 4)), np.zeros(states, bool), run_parts.generator(self.seed, "teacher")
        tabular.teach(self.world, q, visited, cfg.steps, float(cfg.gamma), float(cfg.lr), float(cfg.epsilon), rng)
        return q, visited

    def facts(self) -> dict[str, Any]:
        """What ``worlds.csv`` says about the world and its teacher."""
        rng = run_parts.generator(self.seed, "teacher evaluation")
        episodes = [tabular.teacher_episode(self.world, self.q, rng) for _ in range(self.cfg.teacher.eval_episodes)]
        total, length = np.mean(episodes, 0)
        return {
            "seed": self.seed,
            "distinct_states": self.visited.sum(),
            "teacher_return": total,
            "teacher_length": length,
            "reachable_goal": bool(self.grid.has_goal()),
        }

    def advice(self, prior: str) -> run_parts.Advice:
        """What the prior of this name says."""
        spec = run_parts.parse_prior(prior or "expert")
        return run_parts.make_advice(spec, self.q, self.visited, self.cfg.teacher.temperature, self.seed)

    def train(
        self,
        method: str,
        prior: str,
        advice: run_parts.Advice,
        learner: run_parts.Learner,
        *,
        watch: bool = False,
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """The evaluation episodes of a student, ``[points, 6]``; its weights and visits at each if they are watched."""
        points, states = self.cfg.evaluation.points, len(self.world.state)
        log, weights = np.zeros((points, len(tabular.LOG_FIELDS))), np.zeros((points if watch else 0, states))
        visits = np.zeros(weights.shape, np.int64)
        tables = run_parts.new_tables(states, learner.adaptive)
        tabular.train(
            self.world,
            advice,
            learner,
            tables,
            self.cfg.evaluation.interval,
            log,
            weights,
            visits,
            run_parts.generator(self.seed, "student", method, prior),
        )
        if not all(np.isfinite(table).all() for table in (tables.logits, tables.value, tables.weight)):
            raise ValueError(
                f"The student of {method} with the prior {prior or 'none'} in the world of seed {self.seed} diverged:"
                f" expected smaller rates than student.lr={self.cfg.student.lr} and student.lr_weight, or a smaller"
                f" student.bonus_coeff than {self.cfg.student.bonus_coeff}."
            )
        return log, weights, visits


def run_world(
    cfg: GridworldConfig, seed: int, by_method: dict[str, run_parts.Learner], progress: Callable[[int], Any]
) -> dict[str, Any]:
    """Facts about a world, and the evaluation episodes of all of its students, ``[pairs, points, 6]``."""
    taught = TaughtWorld(cfg, seed)
    progress(cfg.teacher.steps)
    advice = {prior: taught.advice(prior) for prior in ("", *cfg.priors)}
    episodes = []
    for method, prior in run_parts.runs_of(cfg.methods, cfg.priors):
        episodes.append(taught.train(method, prior, advice[prior], by_method[method])[0].astype(np.float32))
        progress(cfg.evaluation.points * cfg.evaluation.interval)
    return {**taught.facts(), "episodes": np.stack(episodes)}


def run_study(cfg: GridworldConfig, folder: RunFolder) -> dict[str, np.ndarray]:
    """What :func:`run_world` returns, stacked over worlds; blocks of worlds are kept in ``blocks/``."""
    by_method = {method: make_learner(cfg, method) for method in cfg.methods}
    pairs, budget = run_parts.runs_of(cfg.methods, cfg.priors), cfg.evaluation.points * cfg.evaluation.interval
    per_world = cfg.teacher.steps + len(pairs) * budget
    spans = [range(at, min(at + cfg.block_worlds, cfg.worlds)) for at in range(0, cfg.worlds, cfg.block_worlds)]
    blocks = {f"blocks/{span.start:06d}-{span.stop:06d}": span for span in spans}
    # Read at once what is there, so that a damaged file is found before any work.
    kept = {name: folder.arrays(name) for name in blocks if folder.has(name)}
    missing = [name for name in blocks if name not in kept]
    pool = ThreadPoolExecutor(cfg.workers or len(os.sched_getaffinity(0)))
    describe = "compiling" if missing else None
    with progress_bar(total=cfg.worlds * per_world, unit="step", unit_scale=True, desc=describe) as bar:

        def progress(steps: int) -> None:
            bar.set_description("learning", refresh=False)
            bar.update(steps)

        bar.update(per_world * sum(len(blocks[name]) for name in kept))
        try:
            futures = {
                name: [pool.submit(run_world, cfg, cfg.seed + world, by_method, progress) for world in blocks[name]]
                for name in missing
            }
            for name in missing:
                worlds = [future.result() for future in futures.pop(name)]
                stacked = {what: np.stack([world[what] for world in worlds]) for what in worlds[0]}
                kept[name] = folder.arrays(name, partial(dict, stacked))
        finally:
            pool.shutdown(cancel_futures=True)
    return {what: np.concatenate([kept[name][what] for name in blocks]) for what in kept[next(iter(blocks))]}


def report(cfg: GridworldConfig, folder: RunFolder, results: dict[str, np.ndarray]) -> None:
    """Write every table, figure and the page into the folder, and print the main tables and the paths."""
    data = Episodes(cfg, results["episodes"])
    tables = tables_of(cfg, data, results)
    written = [
        folder.write(f"{name}.csv", table.to_csv(index=False, float_format="%.6g")) for name, table in tables.items()
    ]
    pictures = {"world": plots.grid_world(**sample_world(cfg, cfg.seed).layers())}
    if by_state := prior_weight_curves(cfg, data):
        steps = np.arange(1, cfg.evaluation.points + 1) * cfg.evaluation.interval
        pictures["prior_weights"] = plots.weight_curves(by_state, steps)
    for name, figure in pictures.items():
        written += plots.save_figure(figure, folder.path / name)
    if "area_ratio" in tables:
        ratios = {
            method: np.stack([data.ratio(method, prior) for prior in cfg.priors], -1)
            for method in cfg.methods
            if method != "none"
        }
        written += page.write(folder.path, folder.path, ratios)
        print(f"\n{page.summary(folder.path)}")
    print("\nWritten:", *(f"  {path}" for path in written), sep="\n")
