"""The priors of the study: names, degraded states, and what they advise."""

from __future__ import annotations

from itertools import combinations

import numpy as np
import pytest
import torch
from tensordict import TensorDict

from recipes.gridworld.run_parts import make_advice, parse_prior, runs_of
from torchrl_priors.priors import BoltzmannPrior

MANY = 10_000
Q = np.tile([[2.0, -1.0], [0.5, 0.4], [9.0, 9.0], [1.0, 3.0], [-2.0, -3.0]], (1, 2))  # [5 states, 4 actions]
VISITED = np.array([True, True, False, True, True])


def sampled(count: int, temperature: float = 1.0, seeds: int = MANY) -> np.ndarray:
    prior = parse_prior(f"structural_{count}")
    return np.stack([make_advice(prior, Q, VISITED, temperature, seed).degraded for seed in range(seeds)])


def within_chance(frequency, probability) -> bool:
    return bool((np.abs(frequency - probability) < 5 * np.sqrt(probability * (1 - probability) / MANY) + 1e-9).all())


def visited_softmax(temperature: float) -> np.ndarray:
    exp = np.where(VISITED, np.exp(Q.max(-1) / temperature), 0.0)
    return exp / exp.sum()


@pytest.mark.parametrize("temperature", [0.5, 4.0])
def test_first_degraded_state_is_drawn_from_the_softmax_of_the_visited_values(temperature):
    mask = sampled(1, temperature)
    assert (mask.sum(1) == 1).all()
    assert within_chance(mask.mean(0), visited_softmax(temperature))


def test_degraded_states_are_those_of_drawing_until_enough_are_distinct():
    mask, p = sampled(2, 2.0), visited_softmax(2.0)
    assert (mask.sum(1) == 2).all()
    for one, other in combinations(range(5), 2):
        expected = 0.0 if 2 in (one, other) else p[one] * p[other] / (1 - p[one]) + p[other] * p[one] / (1 - p[other])
        assert within_chance((mask[:, one] & mask[:, other]).mean(), expected)


@pytest.mark.parametrize("count", [4, 5, 50])
def test_world_with_too_few_visited_states_has_them_all_degraded(count):
    assert np.array_equal(sampled(count, seeds=3), np.stack([VISITED] * 3))


def test_degraded_states_depend_on_the_seed_and_on_their_number():
    one, two = (make_advice(parse_prior("structural_2"), Q, VISITED, 9.0, seed).degraded for seed in (0, 0))
    assert np.array_equal(one, two)
    assert len({mask.tobytes() for mask in sampled(2, 9.0, seeds=20)}) > 1


@pytest.mark.parametrize("value", [float("nan"), float("inf"), -float("inf")])
def test_broken_action_values_are_refused_by_the_seed_of_their_world(value):
    q = Q.copy()
    q[2, 0] = value
    with pytest.raises(ValueError, match=r"world 7 .*teacher\.lr"):
        make_advice(parse_prior("expert"), q, VISITED, 1.0, 7)


def test_advice_is_that_of_the_boltzmann_prior_and_its_adversary():
    prior = BoltzmannPrior(torch.from_numpy(Q), 0.5)
    states = TensorDict(state=torch.arange(5), batch_size=[5])
    advice = make_advice(parse_prior("random_30"), Q, VISITED, 0.5, 0)
    for mine, theirs in zip(advice.log_prob, (prior, prior.adversary()), strict=True):
        np.testing.assert_allclose(mine, theirs.get_dist(states).logits.numpy(), rtol=1e-12)
    np.testing.assert_allclose(advice.prob, np.exp(advice.log_prob))
    assert (advice.degrade_prob, advice.degraded.any()) == (0.3, False)
    assert make_advice(parse_prior("structural_2"), Q, VISITED, 0.5, 0).degrade_prob == 0


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
