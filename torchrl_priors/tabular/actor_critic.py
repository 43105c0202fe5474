"""The tabular actor-critic student: one step of many independent runs, with everything a method learns from it.

Each run is a row; nothing couples two rows. A run's tables (policy, critics, prior weight) lie in *records*, one of 16
floats (a cache line) per state. The policy and the prior weight are frozen during an episode: what a visit teaches is
added to the record's *pending* fields and takes effect when the state is first visited in a later episode, which is
the episode's summed gradient step without a pass over the episode. The losses are those of
:mod:`torchrl_priors.functional`, differentiated by :func:`torch.func.grad`; the whole step compiles into one kernel.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor
from torch.func import grad

from torchrl_priors import functional as F
from torchrl_priors.envs.gridworld import GridMaps, transition
from torchrl_priors.random import uniform
from torchrl_priors.schedules import Schedule

__all__ = [
    "ADVICE_WIDTH",
    "LOG_FIELDS",
    "RECORD_WIDTH",
    "Carry",
    "Hyper",
    "Runs",
    "advance",
    "initial_carry",
    "new_log",
    "new_records",
]

# The fields of a record; the four logits and their pending change come first.
_LOGITS, _PENDING, _VALUE, _RAW_VALUE, _WEIGHT, _WEIGHT_PENDING, _EPISODE, _USED = 0, 4, 8, 9, 10, 11, 12, 13
#: Floats per state of a run's tables.
RECORD_WIDTH = 16
#: Floats per state of a table of advice.
ADVICE_WIDTH = 8

#: What is kept of every evaluation episode: return and length; sum, sum of squares and number of the prior weights
#: at visits of degraded states; the same at the other states.
LOG_FIELDS = ("return", "length", "w_degraded", "w2_degraded", "n_degraded", "w_other", "w2_other", "n_other")


@dataclass(frozen=True)
class Hyper:
    """What all runs of a batch share; PROTOCOL-level constants of the student.

    Attributes:
        gamma: discount factor.
        lr: learning rate of actor and critics.
        noise: probability that the environment replaces the action.
        end_prob: probability that a step ends the episode.
        eval_interval: training transitions between two evaluation points.
        eval_points: evaluation episodes of a run; the last one ends it.
        schedule: factor on the coefficients of annealed runs, by training transitions; None where there are none.
    """

    gamma: float
    lr: float
    noise: float
    end_prob: float
    eval_interval: int
    eval_points: int
    schedule: Schedule | None = None


class Runs(NamedTuple):
    """What defines each run: tensors of one entry per row (float32 unless said otherwise).

    Attributes:
        key: int64, the run's random stream.
        start: int64, position where episodes begin.
        advice: int64, where the run's prior begins in the table of log-probabilities.
        adversary: int64, where the adversary of its world begins.
        degrade_prob: probability of a random degradation at each visited step.
        bonus_current, bonus_next: coefficient of each kind of bonus.
        relative: bool, whether the bonus is relative to the student's log-probability.
        aux_coeff: coefficient of the auxiliary loss.
        teacher_mean: bool, whether that averages over the teacher's actions (else over the student's).
        annealed: bool, whether the schedule applies to these coefficients.
        adaptive: bool, whether the prior weight is learned (else 1).
        advantage_target: bool, whether it regresses on the advantage (else on the TD error).
        shaped: bool, whether that TD error is of the critic that sees the bonus.
        lr_weight: learning rate of the prior weight.
    """

    key: Tensor
    start: Tensor
    advice: Tensor
    adversary: Tensor
    degrade_prob: Tensor
    bonus_current: Tensor
    bonus_next: Tensor
    relative: Tensor
    aux_coeff: Tensor
    teacher_mean: Tensor
    annealed: Tensor
    adaptive: Tensor
    advantage_target: Tensor
    shaped: Tensor
    lr_weight: Tensor


class Carry(NamedTuple):
    """Where each run stands between two steps: tensors of one entry per row.

    Attributes:
        position, action: int64, where the agent is and what it is about to do.
        advice: float32 ``[5, N]``, the prior's log-probabilities there and whether the state is degraded.
        weight_target: float32, E of the step before, which the weight of this state is to explain.
        follows: float32, 1 where there is a step before in this episode.
        episode: float32, training episodes so far.
        evaluating: bool.
        steps, points: int64, training transitions and evaluation episodes so far.
        log: float32 ``[8, N]``, the evaluation episode so far, see :data:`LOG_FIELDS`.
    """

    position: Tensor
    action: Tensor
    advice: Tensor
    weight_target: Tensor
    follows: Tensor
    episode: Tensor
    evaluating: Tensor
    steps: Tensor
    points: Tensor
    log: Tensor


def new_records(rows: int, states: int, device: torch.device | str | None = None) -> Tensor:
    """Tables of fresh runs, all zero: float32 ``[(rows * states + 1) * 16]``; the last record is a spare."""
    return torch.zeros((rows * states + 1) * RECORD_WIDTH, device=device)


def new_log(rows: int, points: int, device: torch.device | str | None = None) -> Tensor:
    """Room for the evaluation episodes of all runs: float32 ``[(rows * points + 1) * 8]``; the last is a spare."""
    return torch.zeros((rows * points + 1) * len(LOG_FIELDS), device=device)


def pick(table: Tensor, action: Tensor) -> Tensor:
    """Entry ``action`` of the four rows of ``[4, N]``, by selection: cheaper than a gather in a compiled step."""
    first = torch.where(action == 0, table[0], table[1])
    return torch.where(action < 2, first, torch.where(action == 2, table[2], table[3]))


def choose(logits: Tensor, draw: Tensor, greedy: Tensor) -> Tensor:
    """Action of the softmax policy with ``logits [4, N]``: by inversion of ``draw``, or the first best if greedy."""
    mass = logits.softmax(0)
    below = mass[0]
    sampled = (draw >= below).long()
    for action in (1, 2):
        below = below + mass[action]
        sampled = sampled + (draw >= below).long()
    top, best = logits[0], torch.zeros_like(sampled)
    for action in (1, 2, 3):
        better = logits[action] > top
        top, best = torch.where(better, logits[action], top), torch.where(better, action, best)
    return torch.where(greedy, best, sampled)


class _Visible(NamedTuple):
    """A record as the current episode sees it: what was pending from earlier episodes has taken effect."""

    logits: Tensor
    pending: Tensor
    weight: Tensor
    weight_pending: Tensor
    value: Tensor
    raw_value: Tensor


def _read(records: Tensor, at: Tensor, episode: Tensor) -> _Visible:
    first, four = at * RECORD_WIDTH, torch.arange(4, device=at.device).unsqueeze(1)
    logits, pending = records[first + (four + _LOGITS)], records[first + (four + _PENDING)]
    weight, weight_pending = records[first + _WEIGHT], records[first + _WEIGHT_PENDING]
    fresh = records[first + _EPISODE] == episode
    return _Visible(
        torch.where(fresh, logits, logits + pending),
        torch.where(fresh, pending, 0.0),
        torch.where(fresh, weight, weight + weight_pending),
        torch.where(fresh, weight_pending, 0.0),
        records[first + _VALUE],
        records[first + _RAW_VALUE],
    )


def _advice(advice_table: Tensor, table: Tensor) -> Tensor:
    # One gather each: with a vector of fields the whole index would be computed again for every field.
    return torch.stack([advice_table[table * ADVICE_WIDTH + field] for field in range(5)])


def _visit_loss(
    logits: Tensor,
    weight_logit: Tensor,
    runs: Runs,
    action: Tensor,
    advice: Tensor,
    advantage: Tensor,
    raw_advantage: Tensor,
    followed_log_prob: Tensor,
    target_before: Tensor,
    target_now: Tensor,
) -> Tensor:
    """Sum over rows of the actor's and the prior weight's losses of one visit, all of which touch one record."""
    log_probs = logits.log_softmax(0)
    prior_log_prob = pick(advice, action)
    student, prior = log_probs.movedim(0, -1), advice.movedim(0, -1)
    cross_entropy = F.categorical_cross_entropy(student, prior)
    weight = torch.where(runs.adaptive, weight_logit.sigmoid(), 1.0)
    actor = F.policy_gradient_loss(pick(log_probs, action), advantage)
    pulled = torch.where(runs.teacher_mean, F.categorical_cross_entropy(prior, student), cross_entropy)
    auxiliary = runs.aux_coeff * weight.detach() * pulled
    by_td = F.prior_weight_loss(target_before, weight, runs.bonus_next * followed_log_prob)
    by_td = by_td + F.prior_weight_loss(target_now, weight, runs.bonus_current * prior_log_prob)
    aligned = F.alignment(prior_log_prob, cross_entropy.detach())
    by_advantage = F.prior_weight_loss(raw_advantage, weight, aligned)
    return (actor + auxiliary + torch.where(runs.advantage_target, by_advantage, by_td)).sum()


_visit_gradient = grad(_visit_loss, argnums=(0, 1))


def advance(
    clock: Tensor,
    maps: GridMaps,
    advice_table: Tensor,
    runs: Runs,
    carry: Carry,
    records: Tensor,
    log: Tensor,
    hyper: Hyper,
) -> Carry:
    """Take one step in every run that is not finished, and learn from it; ``records`` and ``log`` change in place.

    Args:
        clock (Tensor): int64 ``[N]``, steps each run has made; its random draws depend on this and on its key alone.
        maps (GridMaps): the worlds.
        advice_table (Tensor): float32 ``[tables * C * 8]``: for each state of each table, log pi0 of the four actions,
            whether the state is degraded, and padding.
        runs (Runs): ``N`` rows.
        carry (Carry): from the step before or :func:`initial_carry`.
        records (Tensor): from :func:`new_records`.
        log (Tensor): from :func:`new_log`, the evaluation episodes.
        hyper (Hyper): what all runs share.

    Returns:
        Carry: the same rows one step later.
    """
    rows = runs.key.shape[0]
    states = (records.shape[0] // RECORD_WIDTH - 1) // rows
    row = torch.arange(rows, device=clock.device)
    draw, slip, end, degrade = uniform(runs.key, clock)
    if hyper.schedule is not None:
        factor = torch.where(runs.annealed, hyper.schedule(carry.steps), 1.0)
        scaled = (value * factor for value in (runs.bonus_current, runs.bonus_next, runs.aux_coeff))
        runs = runs._replace(**dict(zip(("bonus_current", "bonus_next", "aux_coeff"), scaled, strict=True)))
    active = carry.points < hyper.eval_points
    training, tested = active & ~carry.evaluating, active & carry.evaluating

    state = maps.state[carry.position].long()
    here = _read(records, row * states + state, carry.episode)
    weight = torch.where(runs.adaptive, here.weight.sigmoid(), 1.0)
    position, reward, done = transition(
        maps, carry.position, carry.action, slip, end, noise=hyper.noise, end_prob=hyper.end_prob
    )
    prior_log_prob = pick(carry.advice, carry.action)
    own_log_prob = torch.where(runs.relative, pick(here.logits.log_softmax(0), carry.action), 0.0)
    current_bonus = runs.bonus_current * F.prior_bonus(weight, prior_log_prob - own_log_prob)

    def learn(
        value: Tensor, raw_value: Tensor, next_bonus: Tensor, terminated: Tensor, stays: Tensor
    ) -> tuple[Tensor, ...]:
        """What this visit changes, given the value of the next state, in this order: critics, then actor and weight."""
        delta = F.td_residual(here.value, reward, value, terminated, hyper.gamma, current_bonus + next_bonus)
        raw_delta = F.td_residual(here.raw_value, reward, raw_value, terminated, hyper.gamma)
        new, raw_new = here.value + hyper.lr * delta, here.raw_value + hyper.lr * raw_delta
        after = torch.where(runs.shaped, new, raw_new)
        next_after = torch.where(stays, after, torch.where(runs.shaped, value, raw_value))
        target = -F.td_residual(after, reward, next_after, terminated, hyper.gamma)
        logit_gradient, weight_gradient = _visit_gradient(
            here.logits,
            here.weight,
            runs,
            carry.action,
            carry.advice[:4],
            delta,
            raw_delta,
            carry.follows * prior_log_prob,
            carry.weight_target,
            target,
        )
        return (
            here.pending - hyper.lr * logit_gradient,
            new,
            raw_new,
            here.weight_pending - runs.lr_weight * weight_gradient,
            target,
        )

    zero, never = torch.zeros_like(reward), torch.zeros_like(done)
    at_end = learn(zero, zero, zero, ~never, never)

    # Arrive: at the next state of the episode, or at the start of another one.
    over = done & active
    points = carry.points + (over & tested)
    steps = carry.steps + training
    episode = carry.episode + (over & training)
    due = (steps >= (points + 1) * hyper.eval_interval) & (points < hyper.eval_points)
    evaluating = torch.where(over, due, carry.evaluating)
    position = torch.where(over, runs.start, position)
    next_state = maps.state[position].long()
    stays = next_state == state
    there = _read(records, row * states + next_state, episode)
    # The record of an episode's last state is not written yet when the next episode begins in the same state.
    same = stays & over & training
    logits = torch.where(same, here.logits + at_end[0], there.logits)
    next_weight = torch.where(same, here.weight + at_end[3], there.weight)
    action = choose(logits, draw, evaluating)
    table = torch.where(degrade < runs.degrade_prob, runs.adversary, runs.advice) + next_state
    advice = _advice(advice_table, table)
    next_weight = torch.where(runs.adaptive, next_weight.sigmoid(), 1.0)
    next_bonus = runs.bonus_next * F.prior_bonus(next_weight, pick(advice, action))
    go_on = learn(there.value, there.raw_value, next_bonus, never, stays)

    learned = [torch.where(done, last, more) for last, more in zip(at_end, go_on, strict=True)]
    scalars = torch.stack([learned[1], learned[2], here.weight, learned[3], carry.episode])
    field = torch.arange(_USED, device=clock.device).unsqueeze(1)
    # Rows that are not training write to the spare record, which nobody reads.
    at = torch.where(training, row * states + state, rows * states) * RECORD_WIDTH + field
    records.index_put_((at,), torch.cat([here.logits, learned[0], scalars]))

    degraded = carry.advice[4]
    seen = torch.stack([weight, weight.square(), torch.ones_like(weight)])
    other = (1 - degraded) * seen
    visit = torch.cat([torch.stack([reward, torch.ones_like(reward)]), degraded * seen, other])
    episode_log = carry.log + torch.where(tested, visit, 0.0)
    field = torch.arange(len(LOG_FIELDS), device=clock.device).unsqueeze(1)
    at = torch.where(tested, row * hyper.eval_points + carry.points, rows * hyper.eval_points)
    log.index_put_((at * len(LOG_FIELDS) + field,), episode_log)
    return Carry(
        position,
        action,
        advice,
        torch.where(over, 0.0, go_on[4]),
        (~over).float(),
        episode,
        evaluating,
        steps,
        points,
        torch.where(over, 0.0, episode_log),
    )


def initial_carry(maps: GridMaps, advice_table: Tensor, runs: Runs, hyper: Hyper) -> Carry:
    """Runs about to take their first step, with uniform policies.

    Args: as for :func:`advance`.
    """
    rows, device = len(runs.key), runs.key.device
    draw, _, _, degrade = uniform(runs.key, 0, 1)
    table = torch.where(degrade < runs.degrade_prob, runs.adversary, runs.advice) + maps.state[runs.start].long()
    integer = torch.zeros(rows, dtype=torch.int64, device=device)
    real = torch.zeros(rows, device=device)
    return Carry(
        position=runs.start.clone(),
        action=(draw * 4).long(),
        advice=_advice(advice_table, table),
        weight_target=real,
        follows=real.clone(),
        episode=real.clone(),
        evaluating=torch.zeros(rows, dtype=torch.bool, device=device),
        steps=integer,
        points=integer.clone(),
        log=torch.zeros(len(LOG_FIELDS), rows, device=device),
    )
