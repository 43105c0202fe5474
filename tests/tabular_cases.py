"""What the tests of the tabular study share: a small batch of runs, stepped eagerly and recorded step by step."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from torchrl_priors.envs import GridMaps, GridWorlds
from torchrl_priors.envs.gridworld import transition
from torchrl_priors.random import uniform
from torchrl_priors.schedules import CosineSchedule
from torchrl_priors.tabular import Hyper, StudentConfig, advice_tables
from torchrl_priors.tabular import actor_critic as ac
from torchrl_priors.tabular.study import build_runs

# Of every kind of cell some, none so near to the start that all episodes are short: ABC pay 10, 5 and 1, abc cost that.
MAPS = (
    ("..#..A", ".C....", "...#..", "#.....", "..c..B", "b....."),
    ("A....#", "......", ".#.c..", "......", ".....C", "#a..#."),
    ("......", ".#..#.", "..C...", "......", ".#..c.", "...b.A"),
)


def drawn_worlds(count: int) -> GridWorlds:
    """The first maps, of 36 cells each, seen through windows of 3 by 3."""
    kinds = torch.tensor([[[".#AaBbCc".index(cell) for cell in line] for line in lines] for lines in MAPS[:count]])
    return GridWorlds.from_kinds(kinds, torch.full((count,), 21), 3)


class Tables(NamedTuple):
    """A run's tables as its next episode will see them, ``[rows, states(, 4)]``."""

    logits: Tensor
    value: Tensor
    raw_value: Tensor
    weight: Tensor


def read_tables(records: Tensor, rows: int) -> Tables:
    """At the end of an episode, when all that is pending takes effect."""
    fields = records[: -ac.RECORD_WIDTH].view(rows, -1, ac.RECORD_WIDTH)
    return Tables(
        fields[..., ac._LOGITS : ac._LOGITS + 4] + fields[..., ac._PENDING : ac._PENDING + 4],
        fields[..., ac._VALUE],
        fields[..., ac._RAW_VALUE],
        fields[..., ac._WEIGHT] + fields[..., ac._WEIGHT_PENDING],
    )


def randomise(records: Tensor, runs: ac.Runs) -> None:
    """Tables in the middle of learning, with changes pending from an earlier episode."""
    fields = records[: -ac.RECORD_WIDTH].view(len(runs.key), -1, ac.RECORD_WIDTH)
    fields.copy_(torch.randn(fields.shape, generator=torch.Generator().manual_seed(3)))
    fields[..., ac._EPISODE] = -1
    # Without a bonus there is but one critic, and both of its tables agree.
    alone = (runs.bonus_current == 0) & (runs.bonus_next == 0)
    fields[alone, :, ac._RAW_VALUE] = fields[alone, :, ac._VALUE]


@dataclass
class Study:
    """The small batch: every pair in every world, as rows in the order of ``build_runs``."""

    worlds: GridWorlds
    seeds: Tensor
    q: Tensor
    degraded: dict[int, Tensor]
    pairs: list[tuple[str, str]]
    config: StudentConfig

    @classmethod
    def small(
        cls,
        pairs: Sequence[tuple[str, str]],
        *,
        worlds: int = 2,
        td_error: str = "original",
        eval_interval: int = 10**9,
        eval_points: int = 1,
        end_prob: float = 0.06,
    ) -> Study:
        """The drawn worlds, teachers of random action values, three degraded states in ten, uneven coefficients."""
        generator = torch.Generator().manual_seed(5)
        states = 36
        hyper = Hyper(
            gamma=0.95,
            lr=0.1,
            noise=0.1,
            end_prob=end_prob,
            eval_interval=eval_interval,
            eval_points=eval_points,
            schedule=CosineSchedule(1.0, 0.2, frames=40),
        )
        return cls(
            worlds=drawn_worlds(worlds),
            seeds=torch.arange(worlds),
            q=2 * torch.randn(worlds, states, 4, generator=generator),
            degraded={3: torch.rand(worlds, states, generator=generator) < 0.3},
            pairs=list(pairs),
            config=StudentConfig(
                hyper=hyper,
                lr_weight={"td": 0.05, "advantage": 0.2},
                td_error=td_error,
                bonus_coeff=0.7,
                aux_coeff=1.3,
                temperature=1.5,
            ),
        )

    def row(self, pair: tuple[str, str], world: int = 0) -> int:
        return world * len(self.pairs) + self.pairs.index(pair)

    @property
    def states(self) -> int:
        return self.worlds.num_cells


class Step(NamedTuple):
    """What happened to all rows at one step, ``[rows]`` each (``before`` and ``after`` are the carries around it)."""

    state: Tensor
    action: Tensor
    reward: Tensor
    done: Tensor
    next_state: Tensor
    degraded: Tensor
    steps: Tensor
    before: ac.Carry
    after: ac.Carry
    records: Tensor


def play(study: Study, steps: int, *, random_tables: bool = False) -> tuple[Tensor, list[Step], Tensor, ac.Runs]:
    """The records at first, every step with a copy of the records after it, the log, and the rows."""
    maps = GridMaps.from_worlds(study.worlds)
    advice = advice_tables(study.q, study.degraded, study.config.temperature)
    runs = build_runs(study.worlds, study.seeds, study.pairs, study.degraded, study.config)
    hyper, rows = study.config.hyper, len(runs.key)
    records, log = ac.new_records(rows, study.states), ac.new_log(rows, hyper.eval_points)
    if random_tables:
        randomise(records, runs)
    first = records.clone()
    carry = ac.initial_carry(maps, advice, runs, hyper)
    # One draw a visited step: made on arrival, and for the very first state in a stream of its own.
    degraded = uniform(runs.key, 0, 1)[3] < runs.degrade_prob
    history = []
    for clock in range(steps):
        clock = torch.full((rows,), clock)
        _, slip, end, degrade = uniform(runs.key, clock)
        position, reward, done = transition(
            maps, carry.position, carry.action, slip, end, noise=hyper.noise, end_prob=hyper.end_prob
        )
        after = ac.advance(clock, maps, advice, runs, carry, records, log, hyper)
        state, next_state = maps.state[carry.position].long(), maps.state[position].long()
        facts = (state, carry.action, reward, done, next_state, degraded, carry.steps)
        history.append(Step(*facts, carry, after, records.clone()))
        carry, degraded = after, degrade < runs.degrade_prob
    return first, history, log, runs
