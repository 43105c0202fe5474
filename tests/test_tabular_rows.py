"""A run depends on its own seed and settings, and on nothing else in the batch: results are compared bit by bit."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import pytest
import torch
from tabular_cases import Study

from torchrl_priors.envs import GridWorlds, sample_worlds
from torchrl_priors.methods import METHODS
from torchrl_priors.tabular import TeacherHyper, runs_of, sample_degraded, train_students, train_teachers
from torchrl_priors.tabular.study import StudentConfig

PAIRS = runs_of(list(METHODS), ["expert", "random_30", "structural_3"])
TEACHER = TeacherHyper(gamma=0.95, lr=0.1, epsilon=0.2, noise=0.1, end_prob=0.06)


def worlds_of(seeds: list[int]) -> GridWorlds:
    # 25 states and 9 by 9 windows: nothing is a multiple of a vector's length
    return sample_worlds(torch.tensor(seeds), size=5, wall_prob=0.1, object_prob=0.03)


def teach(seeds: list[int], steps: int = 300) -> tuple[torch.Tensor, torch.Tensor]:
    return train_teachers(worlds_of(seeds), torch.tensor(seeds), TEACHER, steps=steps)


def config(td_error: str = "original") -> StudentConfig:
    return Study.small([("none", "")], td_error=td_error, eval_interval=40, eval_points=3).config


def study(seeds: list[int], pairs: list[tuple[str, str]], **kwargs) -> dict[tuple[int, tuple[str, str]], torch.Tensor]:
    """From seeds to the evaluation episodes of each run."""
    q, visited = teach(seeds)
    degraded = {3: sample_degraded(q, visited, torch.tensor(seeds), 3, 1.0)}
    episodes = train_students(worlds_of(seeds), torch.tensor(seeds), q, degraded, pairs, config(), **kwargs)
    return {(seed, pair): episodes[i, j] for i, seed in enumerate(seeds) for j, pair in enumerate(pairs)}


def assert_same_runs(some: dict, more: dict) -> None:
    assert some.keys() <= more.keys()
    differ = [run for run, episodes in some.items() if not torch.equal(episodes, more[run])]
    assert not differ


@pytest.fixture(scope="module")
def whole() -> dict[tuple[int, tuple[str, str]], torch.Tensor]:
    return study([5, 2, 9], PAIRS)


@pytest.fixture
def two_threads() -> Iterator[None]:
    before = torch.get_num_threads()
    torch.set_num_threads(2)
    yield
    torch.set_num_threads(before)


def test_runs_of_a_study_differ(whole):
    logs = torch.stack(list(whole.values())).flatten(1)
    # where a reward lies beside the start, methods without a weight to tell them apart end in the same greedy step
    assert len(logs.unique(dim=0)) > 0.8 * len(logs)
    assert (logs.view(-1, 3, 8)[..., 1] >= 1).all()  # every evaluation episode took place


def test_run_is_the_same_again(whole):
    assert_same_runs(study([5, 2, 9], PAIRS), whole)


@pytest.mark.parametrize("lanes", [1, 17, 48])
def test_run_does_not_depend_on_how_many_are_stepped_together(whole, lanes):
    assert_same_runs(study([5, 2, 9], PAIRS, lanes=lanes), whole)


def test_run_does_not_depend_on_the_order_of_worlds_and_methods(whole):
    assert_same_runs(study([9, 5, 2], PAIRS[::-1]), whole)


def test_run_does_not_depend_on_its_neighbours(whole):
    assert_same_runs(study([2], [("ae2r", "structural_3")]), whole)
    assert_same_runs(whole, study([5, 1, 2, 7, 9], [*PAIRS, ("er", "random_99")]))


def test_run_does_not_depend_on_the_number_of_threads(two_threads):
    seeds = torch.arange(150)
    worlds = worlds_of(seeds.tolist())
    q = torch.randn(150, 25, 4)
    degraded = {3: torch.rand(150, 25) < 0.2}
    short = replace(config(), hyper=replace(config().hyper, eval_interval=10, eval_points=1, end_prob=0.3))

    def train(count: int) -> torch.Tensor:
        few = {3: degraded[3][:count]}
        return train_students(worlds[:count], seeds[:count], q[:count], few, PAIRS, short, lanes=4096)

    together = train(150)  # 2850 rows, enough for torch to share its operations out among threads
    torch.set_num_threads(1)
    assert torch.equal(train(150), together)
    assert torch.equal(train(3), together[:3])


def test_padding_of_a_batch_is_not_counted_as_progress():
    counted: list[int] = []
    episodes = study([4], [("none", ""), ("er", "expert")], progress=counted.append)
    assert len(episodes) == 2
    assert 2 * 3 * 40 <= sum(counted) < 2 * (3 * 40 + 200)


def test_teacher_does_not_depend_on_its_neighbours_nor_on_the_batch():
    q, visited = teach(list(range(20)))
    for seeds in ([3], [11, 3, 19]):
        fewer_q, fewer_visited = teach(seeds)
        assert torch.equal(fewer_q, q[seeds])
        assert torch.equal(fewer_visited, visited[seeds])
    assert len(q.flatten(1).unique(dim=0)) == 20


def test_compiled_run_does_not_depend_on_neighbours_order_or_threads_either(two_threads):
    pairs = runs_of(["none", "er", "ae2r", "aligned"], ["random_30", "structural_3"])
    many = study([5, 2], pairs, lanes=32, compile=True)
    torch.set_num_threads(1)
    torch.compiler.reset()
    assert_same_runs(study([2, 5], pairs[::-1], lanes=16, compile=True), many)
    assert_same_runs(study([2, 5], pairs[1:3], lanes=16, compile=True), many)
    eager = study([5, 2], pairs)
    close = [torch.allclose(episodes, eager[run], rtol=1e-3, atol=1e-3) for run, episodes in many.items()]
    assert sum(close) > 0.9 * len(close)  # the last bits may turn an action, rarely
