"""``LetGo``: what lowers a coefficient, what raises it, and that it continues where it was."""

from __future__ import annotations

import json

import pytest
import torch
from tensordict import TensorDict
from torch import nn

from torchrl_priors import LetGo
from torchrl_priors.episode_returns import EpisodeReturns

WINDOW = 100


class Loss(nn.Module):
    def __init__(self, coeff: float = 0.8) -> None:
        super().__init__()
        self.register_buffer("coeff", torch.tensor(coeff))


def batch(returns: torch.Tensor) -> TensorDict:
    """Ten frames an episode."""
    steps = 10 * len(returns)
    done = (torch.arange(steps) % 10 == 9).unsqueeze(-1)
    values = returns.repeat_interleave(10).unsqueeze(-1)
    return TensorDict(next=TensorDict(episode_reward=values, done=done, batch_size=[steps]), batch_size=[steps])


def around(mean: float) -> torch.Tensor:
    """Returns of a window, of standard deviation 1."""
    return mean + torch.tensor([-1.0, 1.0]).repeat(5)


def factors(*means: float) -> list[float]:
    """After a window of returns around each of these."""
    let_go = LetGo(Loss(), "coeff", window=WINDOW, rate=1)
    return [let_go.update(batch(around(mean))) for mean in means]


def test_the_coefficient_is_halved_in_a_window_without_gain() -> None:
    assert factors(50, 50, 50, 50) == [1, 0.5, 0.25, 0.125]


def test_nothing_changes_while_returns_rise() -> None:
    assert factors(10, 20, 30, 40) == [1, 1, 1, 1]


def test_a_gain_of_less_than_a_tenth_is_none() -> None:
    assert factors(50, 54, 58) == [1, 0.5, 0.25]


def test_a_loss_takes_the_teacher_back_and_halves_the_rate() -> None:
    assert factors(50, 50, 50, 20, 20, 20) == pytest.approx([1, 0.5, 0.25, 1, 2**-0.5, 0.5])


def test_a_teacher_that_was_not_half_gone_is_taken_back_at_the_same_rate() -> None:
    assert factors(50, 50, 20, 20, 20) == [1, 0.5, 1, 0.5, 0.25]


def test_what_was_gained_without_the_teacher_may_be_lost_again() -> None:
    assert factors(50, 50, 90, 50, 50) == [1, 0.5, 0.5, 0.25, 0.125]


def test_a_loss_within_a_tenth_is_none() -> None:
    assert factors(50, 50, 46, 46) == [1, 0.5, 0.25, 0.125]
    assert factors(-50, -50, -54, -56) == [1, 0.5, 0.25, 1]


def test_noise_counts_as_neither_gain_nor_loss() -> None:
    noisy = torch.tensor([-40.0, 40.0]).repeat(5)
    let_go = LetGo(Loss(), "coeff", window=WINDOW, rate=1)
    assert [let_go.update(batch(50 + shift + noisy)) for shift in (0, 5, -10)] == [1, 0.5, 0.25]


def test_the_rate_is_of_frames_not_of_batches() -> None:
    whole, parts = (LetGo(Loss(), "coeff", window=WINDOW, rate=1) for _ in range(2))
    for _ in range(2):
        whole.update(batch(around(50)))
        parts.update(batch(around(50)))
    whole.update(batch(around(50)))
    for _ in range(5):
        parts.update(batch(around(50)[:2]))
    assert parts.factor == pytest.approx(whole.factor) == 0.25


def test_a_second_coefficient_has_the_rest() -> None:
    loss = Loss()
    loss.register_buffer("share", torch.tensor(0.5))
    let_go = LetGo(loss, "coeff", rest="share", window=WINDOW, rate=1)
    assert loss.share == 0
    for _ in range(3):
        let_go.update(batch(around(50)))
    assert loss.share == 0.75


def test_too_few_episodes_change_nothing() -> None:
    let_go = LetGo(Loss(), "coeff", window=WINDOW, min_episodes=11)
    assert [let_go.update(batch(around(50))) for _ in range(4)] == [1, 1, 1, 1]


def test_it_multiplies_the_coefficient_as_it_was() -> None:
    loss = Loss(0.8)
    let_go = LetGo(loss, "coeff", window=WINDOW, rate=1)
    for _ in range(3):
        let_go.update(batch(around(50)))
    torch.testing.assert_close(loss.coeff, torch.tensor(0.2))


def test_a_saved_state_continues_in_another_loss() -> None:
    means = (10, 10, 10, 5, 20, 20, 3)
    expected = factors(*means)
    first = LetGo(Loss(), "coeff", window=WINDOW, rate=1)
    for mean in means[:4]:
        first.update(batch(around(mean)))
    loss = Loss(0.8)
    second = LetGo(loss, "coeff", window=WINDOW)
    second.load_state_dict(json.loads(json.dumps(first.state_dict())))
    torch.testing.assert_close(loss.coeff, torch.tensor(0.8 * expected[3]))
    assert [second.update(batch(around(mean))) for mean in means[4:]] == expected[4:]
    assert len(second.state_dict()["returns"]["episodes"]) <= 20  # of two windows


def test_bad_input_is_named() -> None:
    with pytest.raises(AttributeError, match="nothing"):
        LetGo(Loss(), "nothing", window=10)
    with pytest.raises(ValueError, match="window must be at least 1"):
        LetGo(Loss(), "coeff", window=0)
    with pytest.raises(ValueError, match="rate must be a positive number"):
        LetGo(Loss(), "coeff", window=10, rate=0)
    with pytest.raises(ValueError, match="min_episodes must be at least 2"):
        LetGo(Loss(), "coeff", window=10, min_episodes=1)
    let_go = LetGo(Loss(), "coeff", window=10)
    with pytest.raises(KeyError, match="RewardSum"):
        let_go.update(TensorDict(batch_size=[3]))
    with pytest.raises(ValueError, match="not finite"):
        let_go.update(batch(torch.tensor([float("nan")])))


def test_returns_are_found_by_when_their_episodes_ended() -> None:
    returns = EpisodeReturns()
    for value in (1.0, 2.0, 3.0):
        returns.update(batch(torch.tensor([value])))
    assert returns.within(10).tolist() == [3.0]
    assert returns.within(20, ago=10).tolist() == [1.0, 2.0]
    returns.forget(20)
    assert returns.within(100).tolist() == [2.0, 3.0]
