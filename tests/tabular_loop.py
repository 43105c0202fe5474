"""One run of the tabular study as a plain loop in float64, which shares no maths with the library."""

from __future__ import annotations

import math
from collections import defaultdict

import numpy as np
from tabular_cases import Study

from torchrl_priors.envs.worlds import KINDS, MOVES
from torchrl_priors.methods import get_method
from torchrl_priors.tabular import LOG_FIELDS


class PlainWorld:
    """A world cell by cell; the draws decide what is random."""

    def __init__(self, study: Study, world: int) -> None:
        self.size = study.worlds.size
        self.kind = study.worlds.kind[world].tolist()
        self.state = study.worlds.state[world].tolist()
        self.start = int(study.worlds.start[world])
        self.noise, self.end_prob = study.config.hyper.noise, study.config.hyper.end_prob

    def step(self, cell: int, action: int, slip: float, end: float) -> tuple[int, float, bool]:
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
    """The tabular student as one would write it down, an episode at a time.

    The batched student may take any of the best actions in an evaluation if rounding alone tells them apart (teacher
    and adversary cancel out where both have advised the same policy): ``ties`` are the actions it took.
    """

    def __init__(
        self,
        study: Study,
        method: str,
        prior: str,
        world: int,
        draws: np.ndarray,
        first: np.ndarray,
        ties: list[int],
    ) -> None:
        self.world, self.config, self.spec = PlainWorld(study, world), study.config, get_method(method)
        q = study.q[world].double().numpy() / study.config.temperature
        self.teacher = [np.log(softmax(values)) for values in q]
        self.adversary = [np.log(softmax(-values)) for values in q]
        structural = prior.startswith("structural")
        self.degraded = set(study.degraded[3][world].nonzero().flatten().tolist()) if structural else set()
        self.degrade_prob = 0.3 if prior.startswith("random") else 0.0
        self.logits = defaultdict(lambda: np.zeros(4))
        self.value, self.raw_value, self.weight_logit = defaultdict(float), defaultdict(float), defaultdict(float)
        self.draws, self.first, self.ties = draws, first, ties
        self.trace: list[tuple[int, int]] = []
        self.log: list[dict[str, float]] = []

    def weight(self, state: int) -> float:
        return sigmoid(self.weight_logit[state]) if self.spec.adaptive else 1.0

    def arrive(self, cell: int, draws: np.ndarray, greedy: bool) -> tuple[int, int, np.ndarray]:
        """State, action, and the log-probabilities of whoever advises on this visit."""
        state = self.world.state[cell]
        policy = softmax(self.logits[state])
        action = min(3, int((draws[0] >= policy.cumsum()).sum()))
        if greedy:
            best = (policy > policy.max() - 1e-6).nonzero()[0].tolist()
            taken = self.ties[len(self.trace)] if len(self.trace) < len(self.ties) else best[0]
            action = taken if taken in best else best[0]
        adverse = state in self.degraded or draws[3] < self.degrade_prob
        return state, action, (self.adversary if adverse else self.teacher)[state]

    def run(self, steps: int) -> int:
        """Learn for so many steps, or to the last evaluation; returns the number of transitions learned from."""
        hyper = self.config.hyper
        draws, learned = self.first, 0
        while len(self.log) < hyper.eval_points:
            greedy = learned >= (len(self.log) + 1) * hyper.eval_interval
            cell, done = self.world.start, False
            state, action, advice = self.arrive(cell, draws, greedy)
            self.policy_gradient = defaultdict(lambda: np.zeros(4))
            self.weight_gradient = defaultdict(float)
            episode = dict.fromkeys(LOG_FIELDS, 0.0)
            while not done:
                if len(self.trace) == steps:
                    return learned
                draws = self.draws[len(self.trace)]
                self.trace.append((state, action))
                cell, reward, done = self.world.step(cell, action, draws[1], draws[2])
                following = None if done else self.arrive(cell, draws, greedy)
                if greedy:
                    weight, group = self.weight(state), "degraded" if state in self.degraded else "other"
                    for name, amount in (
                        ("return", reward),
                        ("length", 1),
                        (f"w_{group}", weight),
                        (f"w2_{group}", weight**2),
                        (f"n_{group}", 1),
                    ):
                        episode[name] += amount
                else:
                    self.learn(state, action, advice, reward, following, learned)
                    learned += 1
                if not done:
                    state, action, advice = following
            if greedy:
                self.log.append(episode)
            for state, gradient in self.policy_gradient.items():
                self.logits[state] -= hyper.lr * gradient
            for state, gradient in self.weight_gradient.items():
                self.weight_logit[state] -= self.config.lr_weight[self.spec.weight_target] * gradient
        return learned

    def learn(
        self, state: int, action: int, advice: np.ndarray, reward: float, following: tuple | None, learned: int
    ) -> None:
        config, spec, hyper = self.config, self.spec, self.config.hyper
        weight, bonus, policy = self.weight(state), 0.0, softmax(self.logits[state])
        if spec.bonus == "current":
            own = math.log(policy[action]) if spec.relative else 0.0
            bonus = config.bonus_coeff * weight * (advice[action] - own)
        if spec.bonus == "next" and following:
            bonus = config.bonus_coeff * self.weight(following[0]) * following[2][following[1]]

        def error(value: dict[int, float], bonus: float = 0.0) -> float:
            return reward + bonus + (hyper.gamma * value[following[0]] if following else 0.0) - value[state]

        delta, raw_delta = error(self.value, bonus), error(self.raw_value)
        self.value[state] += hyper.lr * delta
        self.raw_value[state] += hyper.lr * raw_delta

        self.policy_gradient[state] += delta * (policy - np.eye(4)[action])
        cross_entropy = -(policy * advice).sum()
        if spec.auxiliary:
            pull = policy * (-advice - cross_entropy)
            if spec.cross_entropy == "teacher":
                pull = policy - np.exp(advice)
            annealed = 0.2 + 0.8 * (1 + math.cos(math.pi * min(learned / 40, 1))) / 2 if spec.annealed else 1.0
            self.policy_gradient[state] += annealed * config.aux_coeff * weight * pull
        if not spec.adaptive:
            return
        if spec.weight_target == "advantage":
            where, target, signal = state, raw_delta, advice[action] + cross_entropy
        else:
            target = -error(self.value if config.td_error == "shaped" else self.raw_value)
            if spec.bonus == "next" and not following:
                return
            where, signal = (
                (state, advice[action]) if spec.bonus == "current" else (following[0], following[2][following[1]])
            )
            signal = config.bonus_coeff * signal
        weight = self.weight(where)
        self.weight_gradient[where] += -2 * (target - weight * signal) * signal * weight * (1 - weight)
