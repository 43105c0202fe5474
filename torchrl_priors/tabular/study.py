"""The tabular study as functions: teachers for a batch of worlds, then every (world, method, prior) run as a row."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from torchrl_priors.envs.gridworld import GridMaps
from torchrl_priors.envs.worlds import GridWorlds
from torchrl_priors.methods import get_method
from torchrl_priors.random import derive_key
from torchrl_priors.tabular.actor_critic import (
    LOG_FIELDS,
    RECORD_WIDTH,
    Hyper,
    Runs,
    advance,
    initial_carry,
    new_log,
    new_records,
)
from torchrl_priors.tabular.advice import advice_tables, parse_prior
from torchrl_priors.tabular.q_learning import TeacherHyper, Teachers, q_step

__all__ = ["StudentConfig", "runs_of", "train_students", "train_teachers"]

#: Rows come in multiples of this, so that no row is ever computed by the remainder loop of a vectorised kernel, whose
#: last bits may differ: a run's result must not depend on its place in the batch.
_LANES = 64
_CHECK = 256

Progress = Callable[[int], Any]


@dataclass(frozen=True)
class StudentConfig:
    """How students learn, beside :class:`~torchrl_priors.tabular.actor_critic.Hyper`.

    Attributes:
        hyper: what all runs share.
        lr_weight: learning rate of the prior weight by what it regresses on, ``"td"`` or ``"advantage"``.
        td_error: ``"original"`` or ``"shaped"``, the critic in the prior weight's loss.
        bonus_coeff: coefficient of the bonus.
        aux_coeff: coefficient of the auxiliary loss.
        temperature: of the Boltzmann teacher.
        anneal_all: whether the schedule applies to every method (else to those that are annealed by definition).
    """

    hyper: Hyper
    lr_weight: dict[str, float]
    td_error: str
    bonus_coeff: float
    aux_coeff: float
    temperature: float
    anneal_all: bool = False


def _pad(values: Tensor, rows: int) -> Tensor:
    """Repeat the first entries up to ``rows``."""
    return torch.cat([values, values[:1].expand(rows - len(values), *values.shape[1:])])


def _compiled(function: Callable, compile: bool) -> Callable:
    return torch.compile(function, fullgraph=True, dynamic=False) if compile else function


def runs_of(methods: Sequence[str], priors: Sequence[str]) -> list[tuple[str, str]]:
    """The (method, prior) pairs of a study: the baseline ``none`` once, every other method with every prior.

    Examples:
        >>> runs_of(["none", "er"], ["expert", "random_15"])
        [('none', ''), ('er', 'expert'), ('er', 'random_15')]
    """
    return [(method, prior) for method in methods for prior in ([""] if method == "none" else priors)]


@torch.no_grad()
def train_teachers(
    worlds: GridWorlds,
    seeds: Tensor,
    hyper: TeacherHyper,
    *,
    steps: int,
    compile: bool = False,
    progress: Progress = lambda n: None,
) -> tuple[Tensor, Tensor]:
    """Tabular Q-learning in every world.

    Args:
        worlds (GridWorlds): ``W`` worlds.
        seeds (Tensor): int64 ``[W]``.
        hyper (TeacherHyper): what all teachers share.

    Keyword Args:
        steps (int): transitions in each world.
        compile (bool): whether to compile the step.
        progress (callable): called with the number of transitions made since the last call.

    Returns:
        two Tensors: action values, float32 ``[W, C, 4]``, and which states were visited, bool ``[W, C]``.
    """
    count, cells, device = len(worlds), worlds.num_cells, worlds.kind.device
    rows = -(-count // _LANES) * _LANES
    # Padding rows must have worlds of their own: a teacher's table is its world's.
    padded: GridWorlds = worlds[torch.arange(rows, device=device) % count]
    maps = GridMaps.from_worlds(padded)
    start = padded.start + torch.arange(rows, device=device) * cells
    teachers = Teachers(
        key=derive_key(_pad(seeds, rows), "teacher"),
        start=start,
        position=start.clone(),
        q=torch.zeros(rows * cells * 4, device=device),
        visited=torch.zeros(rows * cells, dtype=torch.bool, device=device),
    )
    step = _compiled(q_step, compile)
    clock = torch.zeros((), dtype=torch.int64, device=device)
    for index in range(steps):
        teachers = teachers._replace(position=step(clock, maps, teachers, hyper))
        clock = clock + 1
        if (index + 1) % _CHECK == 0 or index + 1 == steps:
            progress(count * (index % _CHECK + 1))
    return teachers.q.view(rows, cells, 4)[:count], teachers.visited.view(rows, cells)[:count]


def build_runs(
    worlds: GridWorlds,
    seeds: Tensor,
    pairs: Sequence[tuple[str, str]],
    degraded: dict[int, Tensor],
    config: StudentConfig,
) -> Runs:
    """The rows of a batch: for each world, each (method, prior) pair."""
    count, cells, device = len(worlds), worlds.num_cells, worlds.kind.device
    tables = 2 + len(degraded)
    world = torch.arange(count, device=device)
    rows: dict[str, list[Tensor]] = {name: [] for name in Runs._fields}
    for method, prior in pairs:
        spec, degradation = get_method(method), parse_prior(prior or "expert")
        table = 2 + list(degraded).index(degradation.structural) if degradation.structural else 0
        values: dict[str, Tensor | float] = {
            "key": derive_key(seeds, "student", method, prior),
            "start": worlds.start + world * cells,
            "advice": (world * tables + table) * cells,
            "adversary": (world * tables + 1) * cells,
            "degrade_prob": float(degradation.random),
            "bonus_current": float(config.bonus_coeff * (spec.bonus == "current")),
            "bonus_next": float(config.bonus_coeff * (spec.bonus == "next")),
            "relative": torch.full((count,), spec.relative, device=device),
            "aux_coeff": float(config.aux_coeff * spec.auxiliary),
            "teacher_mean": torch.full((count,), spec.cross_entropy == "teacher", device=device),
            "annealed": torch.full((count,), spec.annealed or config.anneal_all, device=device),
            "adaptive": torch.full((count,), spec.adaptive, device=device),
            "advantage_target": torch.full((count,), spec.weight_target == "advantage", device=device),
            "shaped": torch.full((count,), config.td_error == "shaped", device=device),
            "lr_weight": float(config.lr_weight[spec.weight_target]),
        }
        for name, value in values.items():
            filled = torch.full((count,), value, device=device) if isinstance(value, float) else value
            rows[name].append(filled)
    # [pair, world] -> world-major rows, so that the runs of a world share its tables in the cache
    return Runs(**{name: torch.stack(values, 1).flatten() for name, values in rows.items()})


class _Lanes:
    """The runs being stepped: as soon as one has finished, its lane is given to the next one that waits.

    Args:
        waiting (Runs): every run of the batch.
        lanes (int): how many are stepped together.
        maps, advice, hyper: as for :func:`~torchrl_priors.tabular.actor_critic.advance`.
        states (int): rows of a run's tables.
    """

    def __init__(self, waiting: Runs, lanes: int, maps: GridMaps, advice: Tensor, hyper: Hyper, states: int) -> None:
        device = waiting.key.device
        self.waiting, self.maps, self.advice, self.hyper, self.lanes = waiting, maps, advice, hyper, lanes
        self.runs = Runs(*(_pad(value[:lanes], lanes) for value in waiting))
        self.carry = initial_carry(maps, advice, self.runs, hyper)
        self.clock = torch.zeros(lanes, dtype=torch.int64, device=device)
        self.records = new_records(lanes, states, device)
        self.log = new_log(lanes, hyper.eval_points, device)
        self.next = min(lanes, len(waiting.key))
        #: the run in each lane; none (-1) in lanes that only fill up the batch
        self.run = torch.where(torch.arange(lanes, device=device) < self.next, torch.arange(lanes, device=device), -1)
        self.finished_steps = 0
        self.results = torch.zeros(len(waiting.key), hyper.eval_points, len(LOG_FIELDS), device=device)

    def step(self, advance: Callable) -> None:
        """One step in every lane."""
        self.carry = advance(
            self.clock, self.maps, self.advice, self.runs, self.carry, self.records, self.log, self.hyper
        )
        self.clock = self.clock + 1

    def training_steps(self) -> int:
        """Training transitions made so far, in all runs."""
        return self.finished_steps + int(torch.where(self.run >= 0, self.carry.steps, 0).sum())

    def refill(self) -> bool:
        """Keep what has finished and start what waits; whether anything is left to step."""
        finished = ((self.carry.points >= self.hyper.eval_points) & (self.run >= 0)).nonzero().squeeze(-1)
        if len(finished) == 0:
            return True
        log = self.log[: -len(LOG_FIELDS)].view(self.lanes, *self.results.shape[1:])
        self.results[self.run[finished]] = log[finished]
        self.finished_steps += int(self.carry.steps[finished].sum())
        count = min(len(finished), len(self.waiting.key) - self.next)
        lanes, new = finished[:count], torch.arange(self.next, self.next + count, device=finished.device)
        self.next += count
        self.run[finished] = -1
        self.run[lanes] = new
        arriving = Runs(*(value[new] for value in self.waiting))
        for mine, theirs in zip(self.runs, arriving, strict=True):
            mine[lanes] = theirs
        for mine, theirs in zip(self.carry, initial_carry(self.maps, self.advice, arriving, self.hyper), strict=True):
            mine[..., lanes] = theirs
        self.clock[lanes] = 0
        self.records[:-RECORD_WIDTH].view(self.lanes, -1)[lanes] = 0
        return bool((self.run >= 0).any())


@torch.no_grad()
def train_students(
    worlds: GridWorlds,
    seeds: Tensor,
    q: Tensor,
    degraded: dict[int, Tensor],
    pairs: Sequence[tuple[str, str]],
    config: StudentConfig,
    *,
    lanes: int = 1024,
    compile: bool = False,
    progress: Progress = lambda n: None,
) -> Tensor:
    """Train every (method, prior) pair in every world, and keep every evaluation episode.

    Args:
        worlds (GridWorlds): ``W`` worlds.
        seeds (Tensor): int64 ``[W]``; with the names of method and prior, a seed determines the run.
        q (Tensor): the teachers' action values, ``[W, C, 4]``.
        degraded (dict): bool masks ``[W, C]`` by number of states, for the ``structural_<n>`` priors in ``pairs``.
        pairs (sequence): from :func:`runs_of`.
        config (StudentConfig): how they learn.

    Keyword Args:
        lanes (int): runs stepped together.
        compile (bool): whether to compile the step.
        progress (callable): called with the number of training transitions made since the last call.

    Returns:
        Tensor: float32 ``[W, pairs, points, 8]``, see :data:`~torchrl_priors.tabular.actor_critic.LOG_FIELDS`.
    """
    advice = advice_tables(q, degraded, config.temperature)
    runs = build_runs(worlds, seeds, pairs, degraded, config)
    lanes = -(-min(lanes, len(runs.key)) // _LANES) * _LANES
    batch = _Lanes(runs, lanes, GridMaps.from_worlds(worlds), advice, config.hyper, worlds.num_cells)
    step = _compiled(advance, compile)
    left, steps = True, 0
    while left:
        for _ in range(_CHECK):
            batch.step(step)
        before, steps = steps, batch.training_steps()
        progress(steps - before)
        left = batch.refill()
    return batch.results.view(len(worlds), len(pairs), *batch.results.shape[1:])
