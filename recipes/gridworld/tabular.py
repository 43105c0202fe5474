"""The paper's tabular algorithms, one world at a time, as compiled scalar loops: Q-learning teacher and student.

Everything here is a pure function of its arguments and of the random generator that it is given. The loops release the
GIL, so that threads run one world each.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numba import njit

if TYPE_CHECKING:  # Numba looks at the values themselves
    from recipes.gridworld.run_parts import Advice, Learner, Tables, World

__all__ = ["LOG_FIELDS", "arrive", "best_action", "play_episode", "step", "teach", "teacher_episode", "train"]
__all__ += ["train_episode"]

#: What is kept of every evaluation episode: return and length; sum, sum of squares and number of the prior weights
#: at visits of degraded states; the same at the other states.
LOG_FIELDS = ("return", "length", "w_degraded", "n_degraded", "w_other", "n_other")

# Without `_nrt` Numba would count references to every table at every step, which takes as long as all of the rest. The
# price: nothing is allocated in here, arrays come from outside.
compiled = njit(nogil=True, cache=True, error_model="numpy", _nrt=False)


# -- The world ---------------------------------------------------------------------------------------------------------


@compiled
def step(world: World, cell: int, action: int, slip: float, end: float) -> tuple[int, float, bool]:
    """Next cell, reward and whether the episode is over; the draws ``slip`` and ``end`` decide what is random."""
    if slip < world.noise:
        action = min(int(slip / world.noise * 4), 3)
    cell = world.next_cell[cell, action]
    return cell, world.reward[cell], world.terminal[cell] or end < world.end_prob


@compiled
def highest(table: np.ndarray, state: int) -> float:
    """The highest of a state's four entries."""
    return max(max(table[state, 0], table[state, 1]), max(table[state, 2], table[state, 3]))


@compiled
def best_action(table: np.ndarray, state: int, draw: float) -> int:
    """The action of a state's highest entry, ties broken by a draw."""
    top, ties, best = highest(table, state), 0, -1
    for action in range(4):
        ties += table[state, action] == top
    rank = int(draw * ties)
    for action in range(4):
        if table[state, action] == top:
            best = action if rank == 0 else best
            rank -= 1
    return best


# -- The teacher -------------------------------------------------------------------------------------------------------


@compiled
def teach(
    world: World,
    q: np.ndarray,
    visited: np.ndarray,
    steps: int,
    gamma: float,
    lr: float,
    epsilon: float,
    rng: np.random.Generator,
) -> None:
    """Q-learning, into action values ``[C, 4]`` of zeros; marks the states that it visits, bool ``[C]``."""
    cell = world.start
    for _ in range(steps):
        state = world.state[cell]
        visited[state] = True
        action = int(rng.random() * 4) if rng.random() < epsilon else best_action(q, state, rng.random())
        cell, reward, done = step(world, cell, action, rng.random(), rng.random())
        future = 0.0 if done else highest(q, world.state[cell])
        q[state, action] += lr * (reward + gamma * future - q[state, action])
        if done:
            cell = world.start


@compiled
def teacher_episode(world: World, q: np.ndarray, rng: np.random.Generator) -> tuple[float, int]:
    """Undiscounted return and length of a greedy episode."""
    cell, total, length, done = world.start, 0.0, 0, False
    while not done:
        action = best_action(q, world.state[cell], rng.random())
        cell, reward, done = step(world, cell, action, rng.random(), rng.random())
        total += reward
        length += 1
    return total, length


# -- The student -------------------------------------------------------------------------------------------------------


@compiled
def arrive(world: World, cell: int, advice: Advice, tables: Tables, rng: np.random.Generator) -> tuple[int, int, int]:
    """State, sampled action, and who advises there: 0 the teacher, 1 its adversary."""
    state = world.state[cell]
    draw, below, action = rng.random(), 0.0, 0
    for other in range(3):
        below += tables.policy[state, other]
        action += draw >= below
    adverse = advice.degraded[state]
    if advice.degrade_prob > 0:
        adverse = adverse or rng.random() < advice.degrade_prob
    return state, action, int(adverse)


@compiled
def train_episode(
    world: World, advice: Advice, learner: Learner, tables: Tables, steps: int, rng: np.random.Generator
) -> int:
    """One episode of the student, which begins after ``steps`` training transitions; how many there are at its end."""
    logits, policy, value, raw_value, weight_logit, weight, policy_gradient, weight_gradient, visits, last, path = (
        tables
    )
    log_prob, schedule = advice.log_prob, learner.schedule
    cell, done, first = world.start, False, steps
    state, action, who = arrive(world, cell, advice, tables, rng)
    distinct = 0
    while not done:
        cell, reward, done = step(world, cell, action, rng.random(), rng.random())
        factor = schedule[min(steps, len(schedule) - 1)]
        steps += 1
        visits[state] += 1
        if last[state] <= first:
            path[distinct] = state
            distinct += 1
        last[state] = steps

        bonus_now, bonus_after = factor * learner.bonus_current, factor * learner.bonus_next
        bonus = 0.0
        if bonus_now != 0:
            own = np.log(policy[state, action]) if learner.relative else 0.0
            bonus = bonus_now * weight[state] * (log_prob[who, state, action] - own)
        next_state, next_action, next_who, next_log_prior = state, action, who, 0.0
        next_value, next_raw_value = 0.0, 0.0
        if not done:
            next_state, next_action, next_who = arrive(world, cell, advice, tables, rng)
            next_log_prior = log_prob[next_who, next_state, next_action]
            bonus += bonus_after * weight[next_state] * next_log_prior
            next_value, next_raw_value = value[next_state], raw_value[next_state]

        # Critics: TD(0), online.
        delta = reward + bonus + learner.gamma * next_value - value[state]
        raw_delta = reward + learner.gamma * next_raw_value - raw_value[state]
        value[state] += learner.lr * delta
        raw_value[state] += learner.lr * raw_delta

        # Actor: the TD error is the advantage; the auxiliary loss is a cross-entropy with the prior.
        policy_gradient[state, action] -= delta
        cross_entropy = 0.0
        for other in range(4):
            policy_gradient[state, other] += delta * policy[state, other]
            cross_entropy -= policy[state, other] * log_prob[who, state, other]
        pull = factor * learner.aux_coeff * weight[state]
        if pull != 0:
            for other in range(4):
                if learner.teacher_mean:
                    toward = advice.prob[who, state, other] - policy[state, other]
                else:
                    toward = policy[state, other] * (log_prob[who, state, other] + cross_entropy)
                policy_gradient[state, other] -= pull * toward

        # Prior weight, where its log-probability is: (target - weight * signal)^2, after the critic's update.
        if learner.adaptive:
            where, signal = state, bonus_now * log_prob[who, state, action]
            if learner.by_advantage:
                signal, target = log_prob[who, state, action] + cross_entropy, raw_delta
            else:
                if learner.shaped:
                    target = value[state] - reward - (0.0 if done else learner.gamma * value[next_state])
                else:
                    target = raw_value[state] - reward - (0.0 if done else learner.gamma * raw_value[next_state])
                if bonus_after != 0:
                    where, signal = next_state, bonus_after * next_log_prior
            slope = weight[where] * (1 - weight[where])
            weight_gradient[where] -= 2 * (target - weight[where] * signal) * signal * slope
        state, action, who = next_state, next_action, next_who

    # The end of the episode: summed gradients take effect.
    for index in range(distinct):
        state = path[index]
        total = 0.0
        for other in range(4):
            logits[state, other] -= learner.lr * policy_gradient[state, other]
            policy_gradient[state, other] = 0.0
        top = highest(logits, state)
        for other in range(4):
            policy[state, other] = np.exp(logits[state, other] - top)
            total += policy[state, other]
        for other in range(4):
            policy[state, other] /= total
        if learner.adaptive:
            weight_logit[state] -= learner.lr_weight * weight_gradient[state]
            weight_gradient[state] = 0.0
            weight[state] = 1 / (1 + np.exp(-weight_logit[state]))
    return steps


@compiled
def play_episode(world: World, advice: Advice, tables: Tables, log: np.ndarray, rng: np.random.Generator) -> None:
    """A greedy episode, written into ``log``, see :data:`LOG_FIELDS`."""
    cell, done = world.start, False
    while not done:
        state = world.state[cell]
        weight, group = tables.weight[state], 2 if advice.degraded[state] else 4
        cell, reward, done = step(world, cell, best_action(tables.logits, state, 0.0), rng.random(), rng.random())
        log[0] += reward
        log[1] += 1
        log[group] += weight
        log[group + 1] += 1


@compiled
def train(
    world: World,
    advice: Advice,
    learner: Learner,
    tables: Tables,
    interval: int,
    log: np.ndarray,
    weights: np.ndarray,
    visits: np.ndarray,
    rng: np.random.Generator,
) -> None:
    """A whole run: an evaluation episode after every ``interval`` transitions; the last row of ``log`` ends it.

    ``log`` is ``[points, 6]``, zeros. ``weights`` and ``visits``, ``[points, C]``, are filled with the tables at each
    evaluation, unless they have no rows.
    """
    steps = point = 0
    while point < len(log):
        if steps < (point + 1) * interval:
            steps = train_episode(world, advice, learner, tables, steps, rng)
            continue
        if len(weights):
            for state in range(len(tables.weight)):
                weights[point, state], visits[point, state] = tables.weight[state], tables.visits[state]
        play_episode(world, advice, tables, log[point], rng)
        point += 1
