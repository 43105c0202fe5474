"""A trial of teachers: what it decides, when, and how sure it is."""

from __future__ import annotations

import json
import math

import pytest
import torch
from tensordict import TensorDict

from torchrl_priors.teacher_trial import TeacherTrial

EPISODES, LENGTH = 8, 10
ROUND = EPISODES * LENGTH


def batch(mean: float, generator: torch.Generator, std: float = 1.0) -> TensorDict:
    """Eight episodes one after the other, of ten steps each; their returns are normal."""
    done = (torch.arange(ROUND) % LENGTH == LENGTH - 1).unsqueeze(-1)
    returns = mean + std * torch.randn(ROUND, 1, generator=generator)
    following = TensorDict(episode_reward=returns, done=done, batch_size=[ROUND])
    return TensorDict(next=following, batch_size=[ROUND])


def trial_of(arms, **options) -> TeacherTrial:
    """One that may decide at any time, from the second half."""
    return TeacherTrial(list(arms), **{"min_frames": 0, "recent": 0.5, **options})


def run(trial: TeacherTrial, means: dict[str, float], seed: int = 0, rounds: int = 1000) -> TeacherTrial:
    generator = torch.Generator().manual_seed(seed)
    for _ in range(rounds):
        for arm in list(trial.active):
            trial.update(arm, batch(means[arm], generator))
        if trial.decide() is not None:
            break
    return trial


@pytest.mark.parametrize(("taught", "winner"), [(3.0, "taught"), (-3.0, "alone")])
def test_a_clear_difference_ends_the_trial_early_in_favour_of_the_better_student(taught, winner):
    trial = run(trial_of(["alone", "taught"], max_frames=100 * ROUND), {"alone": 0.0, "taught": taught})
    result = trial.result
    assert result.winner == winner
    assert sum(result.frames.values()) <= 6 * ROUND
    assert result.margin == pytest.approx(3.0, abs=1.5)
    assert 0.95 < result.confidence <= 1
    assert winner in str(result)


def test_in_doubt_the_student_learns_alone():
    trial = run(trial_of(["alone", "taught"], max_frames=5 * ROUND), {"alone": 0.0, "taught": 0.1})
    returns = trial.result.returns
    assert trial.result.winner == "alone"
    assert trial.result.margin == returns["alone"] - returns["taught"] < 0
    assert trial.result.confidence == 0
    assert trial.result.frames == {"taught": 5 * ROUND, "alone": 5 * ROUND}


def test_in_doubt_the_student_with_the_higher_returns_goes_on_where_that_is_asked_for():
    trial = trial_of(["alone", "taught"], in_doubt="best", max_frames=5 * ROUND)
    result = run(trial, {"alone": 0.0, "taught": 0.1}).result
    assert (result.winner, result.confidence) == ("taught", 0)
    assert result.margin > 0


def test_arms_that_fall_behind_leave_and_the_best_teacher_wins():
    arms = {"alone": 0.0, "bad": -4.0, "good": 4.0, "weak": 1.5}
    trial = run(trial_of((arms), max_frames=200 * ROUND), arms)
    frames = trial.result.frames
    assert trial.result.winner == "good"
    assert trial.active == ["good"]
    assert frames["bad"] <= frames["good"] < 50 * ROUND


def test_an_arm_without_a_difference_is_rarely_dropped():
    dropped = 0
    for seed in range(200):
        trial = trial_of(["alone", "taught"], max_frames=20 * ROUND, alpha=0.1)
        dropped += run(trial, {"alone": 0.0, "taught": 0.0}, seed).result.confidence > 0
    assert dropped <= 0.1 * 200 + 3 * math.sqrt(200 * 0.1 * 0.9)


def test_only_recent_episodes_count():
    trial, generator = trial_of(["alone", "taught"], max_frames=8 * ROUND), torch.Generator().manual_seed(0)
    for frames in range(4):  # the teacher's student begins badly, and is better later on
        trial.update("alone", batch(0.0, generator))
        trial.update("taught", batch(-50.0 if frames < 2 else 5.0, generator))
    assert len(trial.recent_returns("taught")) == 2 * EPISODES
    assert trial.decide().winner == "taught"


def test_nothing_is_decided_before_the_frames_and_episodes_that_were_asked_for():
    means = {"alone": 0.0, "taught": 9.0}
    trial = run(trial_of((means), max_frames=50 * ROUND, min_frames=7 * ROUND), means)
    assert trial.result.frames["alone"] == 7 * ROUND
    trial = run(trial_of((means), max_frames=50 * ROUND, min_episodes=5 * EPISODES), means)
    assert trial.result.frames["alone"] == 9 * ROUND  # five of nine rounds are recent


def test_a_saved_trial_goes_on_as_if_it_had_not_stopped():
    means = {"alone": 0.0, "taught": 0.6, "other": 0.3}
    whole = run(trial_of((means), max_frames=60 * ROUND), means).result
    first, generator = trial_of((means), max_frames=60 * ROUND), torch.Generator().manual_seed(0)
    while first.decide() is None:
        again = trial_of((means), max_frames=60 * ROUND)
        again.load_state_dict(json.loads(json.dumps(first.state_dict())))
        for arm in list(again.active):
            again.update(arm, batch(means[arm], generator))
        first = again
    assert first.result == whole
    again.load_state_dict(json.loads(json.dumps(first.state_dict())))
    assert again.decide() == whole


@pytest.mark.parametrize(
    ("arms", "options", "message"),
    [
        (["alone"], {}, "at least two arms"),
        (["a", "a"], {}, "different names"),
        (["a", "b"], {"in_doubt": "a"}, "first"),
        (["a", "b"], {"alpha": 0.0}, "alpha"),
        (["a", "b"], {"max_frames": 0}, "max_frames"),
        (["a", "b"], {"min_episodes": 1}, "min_episodes"),
        (["a", "b"], {"min_frames": 101}, "min_frames"),
        (["a", "b"], {"recent": 0.0}, "recent"),
    ],
)
def test_bad_settings_are_refused_by_name(arms, options, message):
    with pytest.raises(ValueError, match=message):
        TeacherTrial(arms, **{"max_frames": 100, **options})


def test_bad_batches_are_refused_by_the_arm_and_the_key():
    trial, generator = TeacherTrial(["alone", "taught"], max_frames=ROUND), torch.Generator().manual_seed(0)
    with pytest.raises(KeyError, match="nobody"):
        trial.update("nobody", batch(0.0, generator))
    with pytest.raises(ValueError, match=r"'taught' has an episode whose return.*not finite"):
        trial.update("taught", batch(float("nan"), generator))
    with pytest.raises(KeyError, match=r"episode_reward.*RewardSum"):
        trial.update("taught", batch(0.0, generator).exclude(("next", "episode_reward")))
    trial.update("alone", batch(0.0, generator))
    with pytest.raises(ValueError, match="same number of frames"):
        trial.decide()
    endless = batch(0.0, generator)
    endless["next", "done"].zero_()
    trial.update("taught", endless)
    with pytest.raises(ValueError, match=r"\['taught'\] finished no episode.*raise max_frames"):
        trial.decide()


def test_other_keys_are_read_where_the_user_says():
    trial = trial_of(["a", "b"], max_frames=4, return_key=("agent", "return"), done_key="over", min_episodes=2)
    for arm, value in (("a", 0.0), ("b", 1.0)):
        data = {"over": torch.ones(4, 1, dtype=torch.bool), "agent": {"return": value + torch.arange(4.0).view(4, 1)}}
        trial.update(arm, TensorDict(data, [4]))
    assert trial.decide().winner == "a"  # in doubt


def test_a_saved_trial_of_other_arms_is_refused():
    with pytest.raises(ValueError, match="'b'"):
        TeacherTrial(["a", "c"], max_frames=1).load_state_dict(TeacherTrial(["a", "b"], max_frames=1).state_dict())


def test_by_default_it_waits_for_half_of_the_frames_and_looks_at_the_last_quarter():
    trial, generator = TeacherTrial(["alone", "taught"], max_frames=16 * ROUND), torch.Generator().manual_seed(0)
    for rounds in range(1, 9):
        trial.update("alone", batch(0.0, generator))
        trial.update("taught", batch(9.0 if rounds < 7 else -9.0, generator))
        assert (trial.decide() is None) == (rounds < 8)
    assert trial.result.winner == "alone"
