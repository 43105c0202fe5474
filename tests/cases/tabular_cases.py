"""What the tests of the tabular study share: small worlds, teachers, and a student as one would write it down."""

from __future__ import annotations

import math
from collections import defaultdict
from typing import NamedTuple

import numpy as np
import torch

from recipes.gridworld import run_parts, tabular
from recipes.gridworld.worlds import KINDS, MOVES, GridWorlds
from torchrl_priors.methods import get_method

PRIORS = ["expert", "random_30", "structural_3"]
STATES = 36
RATES = {"td": 0.05, "advantage": 0.2}
COEFFS = {"gamma": 0.95, "lr": 0.1, "bonus_coeff": 0.7, "aux_coeff": 1.3}
SCHEDULE = np.array([0.2 + 0.8 * (1 + math.cos(math.pi * step / 40)) / 2 for step in range(41)])

# Of every kind of cell some, none so near to the start that all episodes are short: ABC pay 10, 5 and 1, abc cost that.
MAPS = (
    ("..#..A", ".C....", "...#..", "#.....", "..c..B", "b....."),
    ("A....#", "......", ".#.c..", "......", ".....C", "#a..#."),
    ("......", ".#..#.", "..C...", "......", ".#..c.", "...b.A"),
)


def drawn_worlds(count: int = 3) -> GridWorlds:
    """The first maps, of 36 cells each, seen through windows of 3 by 3."""
    kinds = torch.tensor([[[".#AaBbCc".index(cell) for cell in line] for line in lines] for lines in MAPS[:count]])
    return GridWorlds.from_kinds(kinds, torch.full((count,), 21), 3)


def action_values(world: int) -> np.ndarray:
    """Those of a teacher who has seen a lot."""
    return 2 * np.random.default_rng(world).standard_normal((STATES, 4))


class Run(NamedTuple):
    """A student about to learn in one of the drawn worlds."""

    method: str
    prior: str
    world_index: int
    td_error: str
    world: run_parts.World
    q: np.ndarray
    advice: run_parts.Advice
    learner: run_parts.Learner


def make_run(method: str, prior: str, world: int = 0, td_error: str = "original", end_prob: float = 0.06) -> Run:
    q = action_values(world)
    advice = run_parts.make_advice(run_parts.parse_prior(prior or "expert"), q, np.ones(STATES, bool), 1.5, world)
    learner = run_parts.learner_of(
        method,
        lr_weight=RATES,
        td_error=td_error,
        schedule=SCHEDULE if get_method(method).annealed else None,
        **COEFFS,
    )
    where = run_parts.World.of(drawn_worlds()[world : world + 1], 0.1, end_prob)
    return Run(method, prior, world, td_error, where, q, advice, learner)


def random_tables(run: Run) -> run_parts.Tables:
    """In the middle of learning."""
    tables, rng = run_parts.new_tables(STATES, run.learner.adaptive), np.random.default_rng(3)
    for table in (tables.logits, tables.value, tables.raw_value):
        table[:] = rng.standard_normal(table.shape)
    tables.policy[:] = np.exp(tables.logits) / np.exp(tables.logits).sum(-1, keepdims=True)
    if run.learner.adaptive:
        tables.weight_logit[:] = rng.standard_normal(STATES)
        tables.weight[:] = 1 / (1 + np.exp(-tables.weight_logit))
    if get_method(run.method).bonus == "none":  # then there is but one critic, and both of its tables agree
        tables.raw_value[:] = tables.value
    return tables


class Visit(NamedTuple):
    """A training transition."""

    state: int
    action: int
    reward: float
    done: bool
    next_state: int
    adverse: bool
    steps: int


class PlainWorld:
    """A world cell by cell."""

    def __init__(self, world: int, end_prob: float, noise: float = 0.1) -> None:
        worlds = drawn_worlds()
        self.kind, self.state = worlds.kind[world].tolist(), worlds.state[world].tolist()
        self.size, self.start = worlds.size, int(worlds.start[world])
        self.noise, self.end_prob = noise, end_prob

    def step(self, cell: int, action: int, rng: np.random.Generator) -> tuple[int, float, bool]:
        slip, end = rng.random(), rng.random()
        if slip < self.noise:
            action = int(slip / self.noise * 4)
        row, col = cell // self.size + MOVES[action][0], cell % self.size + MOVES[action][1]
        if 0 <= row < self.size and 0 <= col < self.size and self.kind[row * self.size + col] != 1:
            cell = row * self.size + col
        reward = KINDS[self.kind[cell]]
        return cell, reward, abs(reward) >= 5 or end < self.end_prob


def softmax(values: np.ndarray) -> np.ndarray:
    exp = np.exp(values - values.max())
    return exp / exp.sum()


def sigmoid(value: float) -> float:
    return 1 / (1 + math.exp(-value))


class PlainStudent:
    """The tabular student in dictionaries and plain Python; of the compiled loop it shares only the order of draws."""

    def __init__(self, run: Run, tables: run_parts.Tables | None = None) -> None:
        self.run, self.spec = run, get_method(run.method)
        self.world = PlainWorld(run.world_index, run.world.end_prob)
        self.teacher = [np.log(softmax(values / 1.5)) for values in run.q]
        self.adversary = [np.log(softmax(-values / 1.5)) for values in run.q]
        self.degraded = set(np.flatnonzero(run.advice.degraded).tolist())
        self.logits = defaultdict(lambda: np.zeros(4))
        self.value, self.raw_value, self.weight_logit = defaultdict(float), defaultdict(float), defaultdict(float)
        if tables is not None:
            for state in range(STATES):
                self.logits[state] = tables.logits[state].copy()
                self.value[state], self.raw_value[state] = tables.value[state], tables.raw_value[state]
                self.weight_logit[state] = tables.weight_logit[state]
        self.steps = 0

    def weight(self, state: int) -> float:
        return sigmoid(self.weight_logit[state]) if self.spec.adaptive else 1.0

    def arrive(self, cell: int, rng: np.random.Generator) -> tuple[int, int, np.ndarray, bool]:
        """State, action, and the log-probabilities of whoever advises on this visit."""
        state = self.world.state[cell]
        action = min(3, int((rng.random() >= softmax(self.logits[state]).cumsum()).sum()))
        adverse = state in self.degraded
        if self.run.prior.startswith("random"):
            adverse = rng.random() < 0.3
        return state, action, (self.adversary if adverse else self.teacher)[state], adverse

    def train_episode(self, rng: np.random.Generator) -> list[Visit]:
        visits: list[Visit] = []
        self.policy_gradient = defaultdict(lambda: np.zeros(4))
        self.weight_gradient = defaultdict(float)
        cell, done = self.world.start, False
        here = self.arrive(cell, rng)
        while not done:
            cell, reward, done = self.world.step(cell, here[1], rng)
            following = None if done else self.arrive(cell, rng)
            self.learn(*here[:3], reward, following)
            next_state = self.world.state[cell]
            visits.append(Visit(here[0], here[1], reward, done, next_state, here[3], self.steps))
            self.steps += 1
            here = following
        for state, gradient in self.policy_gradient.items():
            self.logits[state] = self.logits[state] - 0.1 * gradient
        for state, gradient in self.weight_gradient.items():
            self.weight_logit[state] -= RATES[self.spec.weight_target] * gradient
        return visits

    def learn(self, state: int, action: int, advice: np.ndarray, reward: float, following: tuple | None) -> None:
        spec, bonus_coeff, aux_coeff = self.spec, COEFFS["bonus_coeff"], COEFFS["aux_coeff"]
        if spec.annealed:
            aux_coeff *= SCHEDULE[min(self.steps, 40)]
        weight, bonus, policy = self.weight(state), 0.0, softmax(self.logits[state])
        if spec.bonus == "current":
            own = math.log(policy[action]) if spec.relative else 0.0
            bonus = bonus_coeff * weight * (advice[action] - own)
        if spec.bonus == "next" and following:
            bonus = bonus_coeff * self.weight(following[0]) * following[2][following[1]]

        def error(value: dict[int, float], bonus: float = 0.0) -> float:
            return reward + bonus + (0.95 * value[following[0]] if following else 0.0) - value[state]

        delta, raw_delta = error(self.value, bonus), error(self.raw_value)
        self.value[state] += 0.1 * delta
        self.raw_value[state] += 0.1 * raw_delta

        self.policy_gradient[state] += delta * (policy - np.eye(4)[action])
        cross_entropy = -(policy * advice).sum()
        if spec.auxiliary:
            pull = policy * (-advice - cross_entropy)
            if spec.cross_entropy == "teacher":
                pull = policy - np.exp(advice)
            self.policy_gradient[state] += aux_coeff * weight * pull
        if not spec.adaptive:
            return
        if spec.weight_target == "advantage":
            where, target, signal = state, raw_delta, advice[action] + cross_entropy
        else:
            target = -error(self.value if self.run.td_error == "shaped" else self.raw_value)
            if spec.bonus == "next" and not following:
                return
            where, signal = (
                (state, advice[action]) if spec.bonus == "current" else (following[0], following[2][following[1]])
            )
            signal = bonus_coeff * signal
        weight = self.weight(where)
        self.weight_gradient[where] += -2 * (target - weight * signal) * signal * weight * (1 - weight)

    def play_episode(self, rng: np.random.Generator) -> list[float]:
        episode, cell, done = dict.fromkeys(tabular.LOG_FIELDS, 0.0), self.world.start, False
        while not done:
            state = self.world.state[cell]
            # rounding alone may part the best actions where teacher and adversary cancelled out
            best = np.argmax(np.round(self.logits[state], 9))
            cell, reward, done = self.world.step(cell, int(best), rng)
            weight, group = self.weight(state), "degraded" if state in self.degraded else "other"
            names = ("return", "length", f"w_{group}", f"n_{group}")
            for name, amount in zip(names, (reward, 1, weight, 1), strict=True):
                episode[name] += amount
        return list(episode.values())

    def assert_same(self, tables: run_parts.Tables) -> None:
        pairs = [("logits", self.logits), ("value", self.value), ("raw_value", self.raw_value)]
        for name, mine in [*pairs, ("weight_logit", self.weight_logit)]:
            expected = np.array([mine[state] for state in range(STATES)])
            np.testing.assert_allclose(getattr(tables, name), expected, rtol=1e-8, atol=1e-10, err_msg=name)
        np.testing.assert_allclose(tables.policy, [softmax(self.logits[s]) for s in range(STATES)], rtol=1e-8)
        np.testing.assert_allclose(tables.weight, [self.weight(s) for s in range(STATES)], rtol=1e-8)
