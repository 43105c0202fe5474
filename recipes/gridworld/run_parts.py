"""What a run of the tabular study is made of, by names: its random numbers, prior, learner and tables."""

from __future__ import annotations

import re
import zlib
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from recipes.gridworld.worlds import GridWorlds
from torchrl_priors.methods import get_method

__all__ = [
    "Advice",
    "Learner",
    "PriorSpec",
    "Tables",
    "World",
    "generator",
    "learner_of",
    "make_advice",
    "new_tables",
    "parse_prior",
    "runs_of",
]


def generator(seed: int, *names: str) -> np.random.Generator:
    """The random numbers of what the names say, for the world of this seed: no other world, order or thread counts.

    Examples:
        >>> generator(3, "student", "er").random() == generator(3, "student", "er").random()
        True
        >>> generator(3, "student", "er").random() == generator(3, "student", "aer").random()
        False
    """
    words = tuple(zlib.crc32(name.encode()) for name in names)
    return np.random.Generator(np.random.PCG64(np.random.SeedSequence(seed, spawn_key=words)))


class World(NamedTuple):
    """One of :class:`~recipes.gridworld.worlds.GridWorlds` as arrays, and how it behaves.

    Attributes:
        next_cell: int64 ``[C, 4]``.
        reward: float64 ``[C]``, paid on arrival.
        terminal: bool ``[C]``.
        state: int64 ``[C]``, the row of the cell's observation in every table.
        noise: probability that a uniform action replaces the agent's.
        end_prob: probability that a step ends the episode.
    """

    next_cell: np.ndarray
    reward: np.ndarray
    terminal: np.ndarray
    state: np.ndarray
    start: int
    noise: float
    end_prob: float

    @classmethod
    def of(cls, world: GridWorlds, noise: float, end_prob: float) -> World:
        """From a batch of one world."""
        tables = (getattr(world, name)[0].numpy() for name in ("next_cell", "reward", "terminal", "state"))
        next_cell, reward, terminal, state = tables
        return cls(
            next_cell, reward.astype(np.float64), terminal, state, int(world.start), float(noise), float(end_prob)
        )


class PriorSpec(NamedTuple):
    """A prior of the study by its parts."""

    random: float = 0.0
    """Probability that the adversary answers at a visited step."""
    structural: int = 0
    """Number of states where the adversary always answers."""


def parse_prior(name: str) -> PriorSpec:
    """Read the name of a prior: ``expert``, ``random_<percent>`` or ``structural_<states>``.

    Raises:
        ValueError: the name is none of these.

    Examples:
        >>> parse_prior("random_15"), parse_prior("structural_3")
        (PriorSpec(random=0.15, structural=0), PriorSpec(random=0.0, structural=3))
    """
    if name == "expert":
        return PriorSpec()
    match = re.fullmatch(r"(random|structural)_([1-9][0-9]*)", name)
    if match and match[1] == "random" and int(match[2]) <= 100:
        return PriorSpec(random=int(match[2]) / 100)
    if match and match[1] == "structural":
        return PriorSpec(structural=int(match[2]))
    raise ValueError(f"Unknown prior {name!r}: expected expert, random_<percent> or structural_<states>.")


def runs_of(methods: Sequence[str], priors: Sequence[str]) -> list[tuple[str, str]]:
    """The (method, prior) pairs of a study: the baseline ``none`` once, every other method with every prior.

    Examples:
        >>> runs_of(["none", "er"], ["expert", "random_15"])
        [('none', ''), ('er', 'expert'), ('er', 'random_15')]
    """
    return [(method, prior) for method in methods for prior in ([""] if method == "none" else priors)]


class Advice(NamedTuple):
    """What a student's prior says.

    Attributes:
        log_prob: ``[2, C, 4]``, of the teacher, softmax(Q / temperature), and its adversary, softmax(-Q / temperature).
        prob: the same as probabilities.
        degraded: bool ``[C]``, the states where the adversary always answers.
    """

    log_prob: np.ndarray
    prob: np.ndarray
    degraded: np.ndarray
    degrade_prob: float


def make_advice(prior: PriorSpec, q: np.ndarray, visited: np.ndarray, temperature: float, seed: int) -> Advice:
    """The teacher's advice, degraded.

    Degraded states are drawn from softmax(max_a Q / temperature) over the visited ones until enough are distinct. That
    is drawing without replacement, which adding Gumbel noise and taking the highest does in one go. A world with fewer
    visited states gets them all.

    Raises:
        ValueError: the teacher's values are not finite.
    """
    if not np.isfinite(q).all():
        raise ValueError(f"The teacher of world {seed} has learned values that are not finite: lower teacher.lr.")
    logits = np.stack([q, -q]) / temperature
    logits -= logits.max(-1, keepdims=True)
    degraded = np.zeros(len(visited), bool)
    if prior.structural:
        noise = generator(seed, "degraded", str(prior.structural)).gumbel(size=len(visited))
        score = np.where(visited, q.max(-1) / temperature + noise, -np.inf)
        degraded[np.argsort(-score)[: prior.structural]] = True
    log_prob = logits - np.log(np.exp(logits).sum(-1, keepdims=True))
    return Advice(log_prob, np.exp(log_prob), degraded & visited, prior.random)


class Learner(NamedTuple):
    """How a student learns: a method's preset with the coefficients of the study.

    Attributes:
        lr: of the actor and both critics.
        bonus_current: coefficient of the bonus on the action taken.
        bonus_next: coefficient of the bonus on the action after it.
        relative: whether the bonus is relative to the student's log-probability.
        teacher_mean: whether the auxiliary loss averages over the teacher's actions (else over the student's).
        adaptive: whether the prior weight is learned (else 1).
        by_advantage: whether it regresses on the advantage (else on the TD error).
        shaped: whether that TD error is of the critic that sees the bonus.
    """

    gamma: float
    lr: float
    lr_weight: float
    bonus_current: float
    bonus_next: float
    relative: bool
    aux_coeff: float
    teacher_mean: bool
    adaptive: bool
    by_advantage: bool
    shaped: bool
    schedule: np.ndarray


def learner_of(
    method: str,
    *,
    gamma: float,
    lr: float,
    lr_weight: dict[str, float],
    td_error: str,
    bonus_coeff: float,
    aux_coeff: float | None,
    cross_entropy: str | None = None,
    schedule: np.ndarray | None = None,
) -> Learner:
    """The learner of a method by name; ``lr_weight`` has a rate for each target of the prior weight.

    Where ``aux_coeff`` and ``cross_entropy`` are None they are the method's.
    """
    spec = get_method(method)
    aux_coeff = spec.aux_coeff if aux_coeff is None else aux_coeff
    cross_entropy = spec.cross_entropy if cross_entropy is None else cross_entropy
    return Learner(
        gamma=float(gamma),
        lr=float(lr),
        lr_weight=float(lr_weight[spec.weight_target]),
        bonus_current=float(bonus_coeff * (spec.bonus == "current")),
        bonus_next=float(bonus_coeff * (spec.bonus == "next")),
        relative=spec.relative,
        aux_coeff=float(aux_coeff * spec.auxiliary),
        teacher_mean=cross_entropy == "teacher",
        adaptive=spec.adaptive,
        by_advantage=spec.weight_target == "advantage",
        shaped=td_error == "shaped",
        schedule=np.ones(1) if schedule is None else schedule,
    )


class Tables(NamedTuple):
    """What a student has learned, by state. Policy and weight change at the end of an episode, the critics at once.

    Attributes:
        logits: ``[C, 4]``.
        policy: their softmax.
        value: ``[C]``, the critic that sees the bonus.
        raw_value: the one that never does.
        weight: their sigmoid.
        policy_gradient: ``[C, 4]``, summed over the episode.
        visits: int64 ``[C]``, training transitions from each state so far.
        last: int64 ``[C]``, the number of the last of them.
    """

    logits: np.ndarray
    policy: np.ndarray
    value: np.ndarray
    raw_value: np.ndarray
    weight_logit: np.ndarray
    weight: np.ndarray
    policy_gradient: np.ndarray
    weight_gradient: np.ndarray
    visits: np.ndarray
    last: np.ndarray
    path: np.ndarray


def new_tables(states: int, adaptive: bool) -> Tables:
    """A uniform policy, values of 0, and prior weights of 1/2 (1 where they are not learned)."""
    weight = np.full(states, 0.5 if adaptive else 1.0)
    four, one = np.zeros((states, 4)), np.zeros(states)
    visits = np.zeros(states, np.int64)
    return Tables(
        four,
        four + 0.25,
        one,
        one.copy(),
        one.copy(),
        weight,
        four.copy(),
        one.copy(),
        visits,
        visits.copy(),
        visits.copy(),
    )
