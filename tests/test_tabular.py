"""Every student and teacher of the batched study against a plain loop over one run, in float64."""

from __future__ import annotations

from functools import cache
from itertools import pairwise

import numpy as np
import pytest
import torch
from tabular_cases import Step, Study, play, read_tables
from tabular_loop import PlainStudent, PlainWorld

from torchrl_priors.envs import GridMaps
from torchrl_priors.methods import METHODS
from torchrl_priors.random import derive_key, uniform
from torchrl_priors.tabular import LOG_FIELDS, TeacherHyper, evaluate_greedy, runs_of, train_teachers
from torchrl_priors.tabular import actor_critic as ac

PRIORS = ["expert", "random_30", "structural_3"]
STEPS, INTERVAL, POINTS = 300, 30, 5


@cache
def recorded(td_error: str, end_prob: float = 0.06) -> tuple[Study, list[Step], torch.Tensor, np.ndarray, np.ndarray]:
    study = Study.small(
        runs_of(list(METHODS), PRIORS),
        td_error=td_error,
        eval_interval=INTERVAL,
        eval_points=POINTS,
        end_prob=end_prob,
    )
    _, history, log, runs = play(study, STEPS)
    draws = torch.stack(uniform(runs.key.unsqueeze(1), torch.arange(STEPS)), -1).double().numpy()
    first = torch.stack(uniform(runs.key, 0, 1), -1).double().numpy()
    return study, history, log, draws, first


def compare(method: str, prior: str, world: int, *how) -> None:
    """A row of the recorded batch and its plain loop: what they did, logged and learned."""
    study, history, log, draws, first = recorded(*how)
    row = study.row((method, prior), world)
    log = log[: -len(LOG_FIELDS)].view(-1, POINTS, len(LOG_FIELDS))[row]
    end = max(index for index, step in enumerate(history) if step.done[row])  # the last whole episode
    ties = [int(step.action[row]) for step in history]
    plain = PlainStudent(study, method, prior, world, draws[row], first[row], ties)
    learned = plain.run(end + 1)
    steps = history[: len(plain.trace)]
    assert [(int(step.state[row]), int(step.action[row])) for step in steps] == plain.trace
    assert int(history[end].after.steps[row]) == learned
    assert int(history[end].after.points[row]) == len(plain.log)
    expected = torch.tensor([list(episode.values()) for episode in plain.log]).view(-1, len(LOG_FIELDS)).float()
    torch.testing.assert_close(log[: len(plain.log)], expected, rtol=1e-4, atol=1e-4)
    tables = read_tables(history[end].records, len(history[end].state))
    for name, values in (
        ("logits", plain.logits),
        ("value", plain.value),
        ("raw_value", plain.raw_value),
        ("weight", plain.weight_logit),
    ):
        expected = torch.from_numpy(np.array([values[state] for state in range(study.states)])).float()
        torch.testing.assert_close(getattr(tables, name)[row], expected, rtol=1e-3, atol=1e-4)


@pytest.mark.parametrize("td_error", ["original", "shaped"])
@pytest.mark.parametrize(("method", "prior"), runs_of(list(METHODS), PRIORS))
def test_student_does_and_learns_what_a_plain_loop_does(method, prior, td_error):
    for world in range(2):
        compare(method, prior, world, td_error)


@pytest.mark.parametrize("method", [method for method in METHODS if METHODS[method].auxiliary])
@pytest.mark.parametrize("prior", PRIORS)
def test_episode_that_begins_where_the_last_one_ended_sees_what_that_taught(method, prior):
    compare(method, prior, 0, "original", 1.0)  # every episode is one step from the start


def test_the_recorded_runs_saw_every_kind_of_event():
    study, history, log, _, _ = recorded("original")
    tables = read_tables(history[-1].records, len(history[-1].state))
    points = history[-1].after.points
    assert (points == POINTS).any()  # some have finished
    assert (points < POINTS).any()  # others have not
    stayed = torch.stack([(step.state == step.next_state) & ~step.done for step in history])
    paid = torch.stack([step.reward for step in history])
    assert stayed.any()
    assert {1.0, -1.0, 5.0, -5.0} & set(paid.unique().tolist())
    assert (torch.stack([step.before.evaluating for step in history]).sum(0) > 0).all()
    adaptive = [row for row in range(len(points)) if METHODS[study.pairs[row % len(study.pairs)][0]].adaptive]
    assert (tables.weight[adaptive].abs().amax(1) > 1e-3).all()
    assert log[LOG_FIELDS.index("n_degraded") :: len(LOG_FIELDS)].sum() > 0


def test_finished_run_changes_nothing_any_more():
    _, history, _, _, _ = recorded("original")
    rows = len(history[0].state)
    finished = next(index for index, step in enumerate(history) if (step.after.points == POINTS).any())
    row = int((history[finished].after.points == POINTS).nonzero()[0])
    assert finished < STEPS - 20
    for before, after in zip(
        read_tables(history[finished].records, rows), read_tables(history[-1].records, rows), strict=True
    ):
        assert torch.equal(before[row], after[row])
    assert history[finished].after.steps[row] == history[-1].after.steps[row]


def test_evaluation_teaches_nothing_and_training_teaches_something():
    _, history, _, _, _ = recorded("original")
    rows = len(history[0].state)
    tested, taught = torch.zeros(rows), torch.zeros(rows)
    for before, step in pairwise(history):
        one, two = (part.records[: -ac.RECORD_WIDTH].view(rows, -1) for part in (before, step))
        changed = (one != two).any(1)
        assert not changed[step.before.evaluating].any()
        tested += step.before.evaluating
        taught += changed
    assert tested.min() > 0
    assert taught.min() > 50


def test_evaluations_come_at_the_first_episode_end_after_each_interval():
    _, history, _, _, _ = recorded("original")
    for row in range(len(history[0].state)):
        for before, after in pairwise(history):
            if after.before.evaluating[row] and not before.before.evaluating[row]:
                due = INTERVAL * (int(after.before.points[row]) + 1)
                assert before.done[row]
                assert int(after.before.steps[row]) >= due
            if before.done[row] and not after.before.evaluating[row] and after.before.points[row] < POINTS:
                assert int(after.before.steps[row]) < INTERVAL * (int(after.before.points[row]) + 1)


def test_choice_follows_the_softmax_and_greedy_takes_the_first_best():
    logits = torch.tensor([0.3, -1.0, 0.3, 0.0]).unsqueeze(1)
    draw = (torch.arange(10_000) + 0.5) / 10_000
    chosen = ac.choose(logits.expand(4, 10_000), draw, torch.zeros(10_000, dtype=torch.bool))
    torch.testing.assert_close(chosen.bincount() / 10_000, logits.softmax(0).squeeze(1), atol=2e-4, rtol=0)
    assert ac.choose(logits, torch.tensor([0.99]), torch.tensor([True])).item() == 0
    below_one = torch.tensor([1 - 2.0**-24])
    for _ in range(100):
        assert ac.choose(20 * torch.randn(4, 1), below_one, torch.tensor([False])).item() in range(4)


def plain_best(values: list[float], draw: float) -> int:
    ties = [action for action in range(4) if values[action] == max(values)]
    return ties[int(draw * len(ties))]


def test_teacher_learns_what_a_plain_loop_learns():
    study, steps = Study.small([("none", "")], worlds=3), 1500
    hyper = TeacherHyper(gamma=0.95, lr=0.1, epsilon=0.2, noise=0.1, end_prob=0.06)
    counted: list[int] = []
    q, visited = train_teachers(study.worlds, study.seeds, hyper, steps=steps, progress=counted.append)
    assert sum(counted) == 3 * steps
    for world in range(3):
        plain, table = PlainWorld(study, world), np.zeros((study.states, 4))
        key = derive_key(study.seeds[world], "teacher")
        draws = torch.stack(uniform(key, torch.arange(steps)), -1).double().numpy()
        cell, met = plain.start, set()
        for tie, explore, slip, end in draws:
            state = plain.state[cell]
            met.add(state)
            action = int(explore / 0.2 * 4) if explore < 0.2 else plain_best(table[state].tolist(), tie)
            cell, reward, done = plain.step(cell, action, slip, end)
            future = 0.0 if done else table[plain.state[cell]].max()
            table[state, action] += 0.1 * (reward + 0.95 * future - table[state, action])
            cell = plain.start if done else cell
        torch.testing.assert_close(q[world], torch.from_numpy(table).float(), rtol=1e-3, atol=1e-4)
        assert visited[world].nonzero().flatten().tolist() == sorted(met)
    assert q.abs().amax((1, 2)).min() > 0.5


def test_teachers_evaluation_is_a_mean_over_greedy_episodes():
    study = Study.small([("none", "")], worlds=3)
    hyper = TeacherHyper(gamma=0.95, lr=0.1, epsilon=0.2, noise=0.1, end_prob=0.06)
    maps, keys = GridMaps.from_worlds(study.worlds), derive_key(study.seeds, "evaluation")
    start = study.worlds.start + torch.arange(3) * study.states
    returns, lengths = evaluate_greedy(maps, keys, start, study.q.flatten(), hyper, episodes=5)
    for world in range(3):
        plain, total, length = PlainWorld(study, world), 0.0, 0
        for episode in range(5):
            cell, done, clock = plain.start, False, 0
            while not done:
                tie, _, slip, end = (draw.item() for draw in uniform(keys[world] + episode, clock, 1))
                action = plain_best(study.q[world, plain.state[cell]].tolist(), tie)
                cell, reward, done = plain.step(cell, action, slip, end)
                total, length, clock = total + reward, length + 1, clock + 1
        assert returns[world].item() == pytest.approx(total / 5)
        assert lengths[world].item() == pytest.approx(length / 5)
