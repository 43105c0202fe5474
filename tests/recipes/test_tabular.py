"""The compiled teacher and student against plain Python, step for step from the same random numbers."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
import torch
from tabular_cases import PRIORS, STATES, PlainStudent, PlainWorld, action_values, drawn_worlds, make_run, random_tables

from recipes.gridworld import run_parts, tabular
from recipes.gridworld.env import GridMaps, transition
from torchrl_priors.methods import METHODS, get_method

POINTS, INTERVAL = 5, 30
PAIRS = run_parts.runs_of(list(METHODS), PRIORS)


def train(run, points=POINTS, interval=INTERVAL, *, watch=False, seed=1):
    tables, log = run_parts.new_tables(STATES, run.learner.adaptive), np.zeros((points, len(tabular.LOG_FIELDS)))
    weights = np.zeros((points if watch else 0, STATES))
    visits = np.zeros(weights.shape, np.int64)
    rng = run_parts.generator(seed, run.method, run.prior)
    tabular.train(run.world, run.advice, run.learner, tables, interval, log, weights, visits, rng)
    return tables, log, weights, visits


@pytest.mark.parametrize("td_error", ["original", "shaped"])
@pytest.mark.parametrize(("method", "prior"), PAIRS)
def test_student_does_and_learns_what_plain_python_does(method, prior, td_error):
    for world in range(3):
        run = make_run(method, prior, world, td_error)
        tables, log, _, _ = train(run)
        plain, rng, evaluations = PlainStudent(run), run_parts.generator(1, method, prior), []
        while len(evaluations) < POINTS:
            if plain.steps < (len(evaluations) + 1) * INTERVAL:
                plain.train_episode(rng)
            else:
                evaluations.append(plain.play_episode(rng))
        np.testing.assert_allclose(log, evaluations, rtol=1e-8, atol=1e-10)
        plain.assert_same(tables)
        assert tables.visits.sum() == plain.steps
        assert (np.abs(tables.weight_logit).max() > 1e-3) == get_method(method).adaptive


@pytest.mark.parametrize("method", [method for method in METHODS if METHODS[method].auxiliary])
def test_episode_that_begins_where_the_last_one_ended_sees_what_that_taught(method):
    run = make_run(method, "structural_3", end_prob=1.0)  # every episode is one step from the start
    tables, plain, steps = random_tables(run), PlainStudent(run, random_tables(run)), 0
    rng, same = run_parts.generator(0), run_parts.generator(0)
    for _ in range(30):
        steps = tabular.train_episode(run.world, run.advice, run.learner, tables, steps, rng)
        plain.train_episode(same)
    assert steps == plain.steps == 30
    plain.assert_same(tables)


def test_evaluation_teaches_nothing():
    run = make_run("ae2r", "structural_3")
    tables, log = random_tables(run), np.zeros(len(tabular.LOG_FIELDS))
    before = [table.copy() for table in tables]
    tabular.play_episode(run.world, run.advice, tables, log, run_parts.generator(0))
    assert log[1] > 0
    assert all(np.array_equal(table, copy) for table, copy in zip(tables, before, strict=True))


def test_watched_run_is_the_same_and_shows_its_tables_at_each_evaluation():
    run = make_run("aligned", "structural_3")
    tables, log, weights, visits = train(run, watch=True)
    unwatched, same_log, _, _ = train(run)
    assert np.array_equal(log, same_log)
    assert np.array_equal(tables.weight, unwatched.weight)
    assert np.array_equal(weights[-1], tables.weight)
    assert np.array_equal(visits[-1], tables.visits)
    for points in range(1, POINTS):
        shorter, _, _, _ = train(run, points)
        assert np.array_equal(weights[points - 1], shorter.weight)
        assert np.array_equal(visits[points - 1], shorter.visits)
    assert (np.diff(visits.sum(1)) >= 0).all()
    assert np.abs(weights[-1] - 0.5).max() > 0.01
    # what evaluation episodes met lies among these weights
    met = log[:, tabular.LOG_FIELDS.index("w_other")] / log[:, tabular.LOG_FIELDS.index("n_other")]
    assert ((weights.min(1) <= met + 1e-12) & (met <= weights.max(1) + 1e-12)).all()


def test_runs_differ_and_threads_do_not_matter():
    def log_of(pair):
        return train(make_run(*pair, world=2))[1]

    alone = [log_of(pair) for pair in PAIRS]
    with ThreadPoolExecutor(4) as pool:
        together = list(pool.map(log_of, PAIRS[::-1]))[::-1]
    assert all(np.array_equal(one, other) for one, other in zip(alone, together, strict=True))
    assert len({log.tobytes() for log in alone}) > 0.8 * len(alone)


def test_random_numbers_are_of_the_seed_and_the_names():
    seeds = [(seed, *names) for seed in (0, 1, 2**61) for names in ((), ("student",), ("student", "er"), ("er",))]
    assert len({run_parts.generator(*seed).random() for seed in seeds}) == len(seeds)
    assert run_parts.generator(7, "a").random(3).tolist() == run_parts.generator(7, "a").random(3).tolist()


def test_the_loops_step_is_that_of_the_environment():
    worlds, noise, end_prob = drawn_worlds(), 0.3, 0.2
    maps, rng = GridMaps.from_worlds(worlds), np.random.default_rng(0)
    draws = torch.from_numpy(rng.random((2, 3, STATES, 4, 20)))
    position = torch.arange(3 * STATES).view(3, STATES, 1, 1).expand(-1, -1, 4, 20)
    action = torch.arange(4).view(1, 1, 4, 1).expand_as(position)
    theirs = transition(maps, position, action, *draws, noise=noise, end_prob=end_prob)
    assert set(theirs[1].unique().tolist()) == {0.0, 10.0, -10.0, 5.0, -5.0, 1.0, -1.0}
    for world in range(3):
        here = run_parts.World.of(worlds[world : world + 1], noise, end_prob)
        for cell in range(STATES):
            for move in range(4):
                for draw in range(20):
                    slip, end = draws[:, world, cell, move, draw].tolist()
                    after, reward, done = tabular.step(here, cell, move, slip, end)
                    at = (world, cell, move, draw)
                    assert (after + world * STATES, reward, done) == tuple(values[at].item() for values in theirs)


def test_choice_follows_the_softmax():
    run = make_run("none", "")
    tables = run_parts.new_tables(STATES, False)
    tables.policy[:] = policy = [0.4, 0.1, 0.3, 0.2]
    rng = run_parts.generator(0)
    chosen = [tabular.arrive(run.world, 0, run.advice, tables, rng)[1] for _ in range(10_000)]
    np.testing.assert_allclose(np.bincount(chosen, minlength=4) / 10_000, policy, atol=0.025)


def test_ties_are_broken_by_the_draw():
    table = np.array([[1.0, 3.0, 3.0, 2.0]])
    assert [tabular.best_action(table, 0, draw) for draw in (0.0, 0.49, 0.5, 0.99)] == [1, 1, 2, 2]
    assert {tabular.best_action(np.zeros((1, 4)), 0, draw) for draw in (0.1, 0.3, 0.6, 0.9)} == {0, 1, 2, 3}


def test_teacher_learns_what_plain_python_learns():
    for world in range(3):
        run, steps = make_run("none", "", world), 1500
        q, visited = np.zeros((STATES, 4)), np.zeros(STATES, bool)
        tabular.teach(run.world, q, visited, steps, 0.95, 0.1, 0.2, run_parts.generator(world, "teacher"))
        plain, table, met = PlainWorld(world, 0.06), np.zeros((STATES, 4)), set()
        rng, cell = run_parts.generator(world, "teacher"), plain.start
        for _ in range(steps):
            state = plain.state[cell]
            met.add(state)
            if rng.random() < 0.2:
                action = int(rng.random() * 4)
            else:
                ties = np.flatnonzero(table[state] == table[state].max())
                action = ties[int(rng.random() * len(ties))]
            cell, reward, done = plain.step(cell, int(action), rng)
            future = 0.0 if done else table[plain.state[cell]].max()
            table[state, action] += 0.1 * (reward + 0.95 * future - table[state, action])
            cell = plain.start if done else cell
        np.testing.assert_allclose(q, table, rtol=1e-10)
        assert set(np.flatnonzero(visited)) == met
        assert np.abs(q).max() > 0.5


def test_teachers_episode_is_greedy():
    run, rng = make_run("none", "", 1), run_parts.generator(0)
    plain, same, q = PlainWorld(1, 0.06), run_parts.generator(0), action_values(1)
    for _ in range(20):
        cell, done, total, length = plain.start, False, 0.0, 0
        while not done:
            same.random()  # there are no ties
            cell, reward, done = plain.step(cell, int(q[plain.state[cell]].argmax()), same)
            total, length = total + reward, length + 1
        assert tabular.teacher_episode(run.world, q, rng) == (total, length)
