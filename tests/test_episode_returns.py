"""``Plateau`` and the returns it reads: what counts as a rise, and that it continues where it was."""

from __future__ import annotations

import json

import pytest
import torch
from tensordict import TensorDict

from torchrl_priors import Plateau
from torchrl_priors.episode_returns import EpisodeReturns

WINDOW = 100


def batch(returns: torch.Tensor) -> TensorDict:
    """Ten frames an episode."""
    steps = 10 * len(returns)
    done = (torch.arange(steps) % 10 == 9).unsqueeze(-1)
    values = returns.repeat_interleave(10).unsqueeze(-1)
    return TensorDict(next=TensorDict(episode_reward=values, done=done, batch_size=[steps]), batch_size=[steps])


def around(mean: float, spread: float = 1.0) -> torch.Tensor:
    """Returns of a window."""
    return mean + spread * torch.tensor([-1.0, 1.0]).repeat(5)


def reached(*windows: torch.Tensor, **options) -> list[bool]:
    """After each of these windows."""
    plateau, said = Plateau(window=WINDOW, **options), []
    for returns in windows:
        plateau.update(batch(returns))
        said.append(plateau.reached)
    return said


def test_returns_that_rise_have_reached_none() -> None:
    assert reached(*map(around, (10, 20, 30, 40))) == [False, False, False, False]


def test_returns_that_stand_still_or_fall_have_reached_one() -> None:
    assert reached(*map(around, (10, 20, 20, 15))) == [False, False, True, True]


def test_a_rise_of_less_than_a_tenth_is_none() -> None:
    assert reached(*map(around, (50, 54, 60))) == [False, True, False]
    assert reached(*map(around, (-60, -55, -49))) == [False, True, False]
    assert reached(*map(around, (50, 54)), gain=0.05) == [False, False]


def test_a_rise_within_the_noise_is_none() -> None:
    assert reached(around(50, 40), around(62, 40)) == [False, True]
    assert reached(around(50, 4), around(62, 4)) == [False, False]


def test_two_windows_with_enough_episodes_are_needed() -> None:
    assert reached(*[around(50)] * 3, min_episodes=11) == [False, False, False]


def test_a_plateau_continues_from_a_saved_state() -> None:
    first, second = Plateau(window=WINDOW), Plateau(window=WINDOW)
    for mean in (10, 20, 30):
        first.update(batch(around(mean)))
    second.load_state_dict(json.loads(json.dumps(first.state_dict())))
    assert len(second.state_dict()["episodes"]) == 20  # of two windows
    for plateau in (first, second):
        plateau.update(batch(around(30)))
    assert first.reached
    assert second.reached


def test_bad_input_of_a_plateau_is_named() -> None:
    for name, value in (("window", 0), ("min_episodes", 1), ("gain", -1)):
        with pytest.raises(ValueError, match=f"{name} must be at least"):
            Plateau(**{"window": 10, name: value})
    plateau = Plateau(window=10)
    with pytest.raises(KeyError, match="RewardSum"):
        plateau.update(TensorDict(batch_size=[3]))
    with pytest.raises(ValueError, match="window=10 is less than the 20 frames of a batch"):
        plateau.update(TensorDict(batch_size=[4, 5]))
    with pytest.raises(ValueError, match="not finite"):
        plateau.update(batch(torch.tensor([float("nan")])))


def test_returns_are_found_by_when_their_episodes_ended() -> None:
    returns = EpisodeReturns()
    for value in (1.0, 2.0, 3.0):
        returns.update(batch(torch.tensor([value])))
    assert returns.within(10).tolist() == [3.0]
    assert returns.within(20, ago=10).tolist() == [1.0, 2.0]
    returns.forget(20)
    assert returns.within(100).tolist() == [2.0, 3.0]
