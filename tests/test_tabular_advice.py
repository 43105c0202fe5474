from __future__ import annotations

from itertools import combinations

import pytest
import torch

from torchrl_priors.tabular import advice_tables, parse_prior, runs_of, sample_degraded
from torchrl_priors.tabular.actor_critic import ADVICE_WIDTH

MANY = 20_000
Q = torch.tensor([[2.0, -1.0], [0.5, 0.4], [9.0, 9.0], [1.0, 3.0], [-2.0, -3.0]]).repeat(1, 2)  # [5 states, 4 actions]
VISITED = torch.tensor([True, True, False, True, True])


def sampled(count: int, temperature: float = 1.0, worlds: int = MANY) -> torch.Tensor:
    seeds = torch.arange(worlds)
    return sample_degraded(Q.expand(worlds, 5, 4), VISITED.expand(worlds, 5), seeds, count, temperature)


def within_chance(frequency: torch.Tensor, probability: torch.Tensor) -> bool:
    return bool(((frequency - probability).abs() < 5 * (probability * (1 - probability) / MANY).sqrt() + 1e-9).all())


def visited_softmax(temperature: float) -> torch.Tensor:
    return torch.where(VISITED, Q.amax(-1) / temperature, -torch.inf).double().softmax(0)


@pytest.mark.parametrize("temperature", [0.5, 1.0, 4.0])
def test_first_degraded_state_is_drawn_from_the_softmax_of_the_visited_values(temperature):
    mask = sampled(1, temperature)
    assert (mask.sum(1) == 1).all()
    assert within_chance(mask.double().mean(0), visited_softmax(temperature))


def test_degraded_states_are_those_of_drawing_until_enough_are_distinct():
    mask, p = sampled(2, 2.0), visited_softmax(2.0)
    assert (mask.sum(1) == 2).all()
    for one, other in combinations(range(5), 2):
        expected = p[one] * p[other] / (1 - p[one]) + p[other] * p[one] / (1 - p[other])
        assert within_chance((mask[:, one] & mask[:, other]).double().mean(), expected)
    naive = torch.zeros(MANY, 5, dtype=torch.bool)
    generator = torch.Generator().manual_seed(0)
    while (few := naive.sum(1) < 2).any():
        draw = torch.multinomial(p, int(few.sum()), replacement=True, generator=generator)
        naive[few.nonzero().squeeze(1), draw] = True
    difference = naive.double().mean(0) - mask.double().mean(0)
    assert (difference.abs() < 5 * (0.5 / MANY) ** 0.5).all()


@pytest.mark.parametrize("count", [4, 5, 50])
def test_world_with_too_few_visited_states_has_them_all_degraded(count):
    assert torch.equal(sampled(count, worlds=3), VISITED.expand(3, 5))


def test_degraded_states_depend_on_the_worlds_own_seed_alone():
    q, visited, seeds = torch.randn(6, 30, 4), torch.ones(6, 30, dtype=torch.bool), torch.arange(6)
    together = sample_degraded(q, visited, seeds, 5, 1.0)
    for world in range(6):
        alone = slice(world, world + 1)
        assert torch.equal(sample_degraded(q[alone], visited[alone], seeds[alone], 5, 1.0), together[alone])
    assert not torch.equal(sample_degraded(q, visited, seeds + 6, 5, 1.0), together)


@pytest.mark.parametrize("value", [float("nan"), float("inf"), -float("inf")])
def test_broken_action_values_are_refused(value):
    q = torch.zeros(2, 3, 4)
    q[1, 2, 0] = value
    with pytest.raises(ValueError, match="action values"):
        sample_degraded(q, torch.ones(2, 3, dtype=torch.bool), torch.arange(2), 1, 1.0)


def test_tables_hold_the_expert_its_adversary_and_each_degradation():
    q = torch.randn(2, 7, 4, dtype=torch.float64).float()
    masks = {3: torch.rand(2, 7) < 0.4, 5: torch.rand(2, 7) < 0.7}
    table = advice_tables(q, masks, 0.5).view(2, 4, 7, ADVICE_WIDTH)
    expert, adversary = (2 * q).log_softmax(-1), (-2 * q).log_softmax(-1)
    torch.testing.assert_close(table[:, 0, :, :4], expert)
    torch.testing.assert_close(table[:, 1, :, :4], adversary)
    for index, mask in enumerate(masks.values(), 2):
        torch.testing.assert_close(table[:, index, :, :4], torch.where(mask.unsqueeze(-1), adversary, expert))
        assert torch.equal(table[:, index, :, 4], mask.float())
    assert not table[:, :2, :, 4].any()


def test_tables_of_a_world_do_not_depend_on_the_others():
    q, mask = torch.randn(5, 25, 4), {3: torch.rand(5, 25) < 0.3}
    together = advice_tables(q, mask, 1.0).view(5, -1)
    for world in range(5):
        assert torch.equal(advice_tables(q[world : world + 1], {3: mask[3][world : world + 1]}, 1.0), together[world])


@pytest.mark.parametrize(
    ("name", "random", "structural"),
    [("expert", 0, 0), ("random_1", 0.01, 0), ("random_100", 1.0, 0), ("structural_10", 0, 10)],
)
def test_prior_is_read_from_its_name(name, random, structural):
    assert parse_prior(name) == (random, structural)


UNKNOWN = ["", "Expert", "expert_1", "none", "random", "random_", "random_0", "random_101", "random_1.5", "random_-5"]
UNKNOWN += ["random_05", "structural_0", "structural_x", "structural_3 ", "structural_٣"]


@pytest.mark.parametrize("name", UNKNOWN)
def test_unknown_prior_is_refused_with_what_is_expected(name):
    with pytest.raises(ValueError, match=r"expert, random_<percent> or structural_<states>"):
        parse_prior(name)


def test_baseline_runs_once_and_the_others_with_every_prior():
    assert runs_of(["er", "none", "aligned"], ["expert", "random_15"]) == [
        ("er", "expert"),
        ("er", "random_15"),
        ("none", ""),
        ("aligned", "expert"),
        ("aligned", "random_15"),
    ]
