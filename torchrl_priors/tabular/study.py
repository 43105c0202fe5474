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
from torchrl_priors.tabular.actor_critic import LOG_FIELDS, Hyper, Runs, advance, initial_carry, new_log, new_records
from torchrl_priors.tabular.advice import advice_tables, parse_prior
from torchrl_priors.tabular.q_learning import TeacherHyper, Teachers, q_step

__all__ = ["StudentConfig", "runs_of", "train_students", "train_teachers"]

#: Rows come in multiples of this, so that no row is ever computed by the remainder loop of a vectorised kernel, whose
#: last bits may differ: a run's result must not depend on its place in the batch.
_LANES = 16
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
    """

    hyper: Hyper
    lr_weight: dict[str, float]
    td_error: str
    bonus_coeff: float
    aux_coeff: float
    temperature: float


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
            "aux_coeff": float(config.aux_coeff * spec.auxiliary),
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


@torch.no_grad()
def train_students(
    worlds: GridWorlds,
    seeds: Tensor,
    q: Tensor,
    degraded: dict[int, Tensor],
    pairs: Sequence[tuple[str, str]],
    config: StudentConfig,
    *,
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
        compile (bool): whether to compile the step.
        progress (callable): called with the number of training transitions made since the last call.

    Returns:
        Tensor: float32 ``[W, pairs, points, 8]``, see :data:`~torchrl_priors.tabular.actor_critic.LOG_FIELDS`.
    """
    hyper, device = config.hyper, worlds.kind.device
    maps = GridMaps.from_worlds(worlds)
    advice = advice_tables(q, degraded, config.temperature)
    runs = build_runs(worlds, seeds, pairs, degraded, config)
    wanted = len(runs.key)
    rows = -(-wanted // _LANES) * _LANES
    runs = Runs(*(_pad(value, rows) for value in runs))
    carry = initial_carry(maps, advice, runs, hyper)
    records = new_records(rows, worlds.num_cells, device)
    log = new_log(rows, hyper.eval_points, device)
    step = _compiled(advance, compile)
    clock = torch.zeros((), dtype=torch.int64, device=device)
    done = 0
    while bool((carry.points < hyper.eval_points).any()):
        for _ in range(_CHECK):
            carry = step(clock, maps, advice, runs, carry, records, log, hyper)
            clock = clock + 1
        steps = int(carry.steps[:wanted].sum())
        progress(steps - done)
        done = steps
    return log[: wanted * hyper.eval_points * len(LOG_FIELDS)].view(len(worlds), len(pairs), hyper.eval_points, -1)
