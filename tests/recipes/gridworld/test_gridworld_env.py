from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict
from torchrl.collectors import Collector
from torchrl.envs import check_env_specs

from recipes.gridworld.env import GridWorldEnv, transition
from recipes.gridworld.worlds import GridWorlds, sample_worlds, windows

UP, RIGHT, DOWN, LEFT = range(4)
DEVICES = ["cpu", pytest.param("cuda", marks=pytest.mark.skipif(not torch.cuda.is_available(), reason="no GPU"))]


def small_env(count: int = 4, *, seed: int = 0, first: int = 0, **kwargs) -> GridWorldEnv:
    worlds = sample_worlds(torch.arange(first, first + count), size=7, window=3, object_prob=0.03)
    return GridWorldEnv(worlds, seed=seed, **kwargs)


def drawn_env(*lines: str, noise: float = 0.0, end_prob: float = 0.0, copies: int = 1, **kwargs) -> GridWorldEnv:
    """The world drawn in characters (see KINDS), which starts in its middle."""
    kind = torch.tensor([[".#AaBbCc".index(cell) for cell in line] for line in lines])
    size = len(lines)
    start = torch.full((copies,), size // 2 * size + size // 2)
    worlds = GridWorlds.from_kinds(kind.expand(copies, size, size), start, 3)
    return GridWorldEnv(worlds, noise=noise, end_prob=end_prob, seed=0, **kwargs)


def play(env: GridWorldEnv, actions: torch.Tensor) -> TensorDict:
    """Rollout with resets of a given plan of actions, ``[W, T]``."""
    plan = iter(actions.unbind(1))
    return env.rollout(
        actions.shape[1], lambda td: td.set("action", next(plan)), break_when_any_done=False, auto_cast_to_device=True
    )


def plan_for(env: GridWorldEnv, length: int, seed: int = 0) -> torch.Tensor:
    return torch.randint(4, (env.batch_size[0], length), generator=torch.Generator().manual_seed(seed)).to(env.device)


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("count", [1, 3])
def test_env_meets_torchrls_specs(device, count):
    check_env_specs(small_env(count, device=device))


def test_same_seed_gives_the_same_rollout_and_another_seed_another():
    actions = plan_for(small_env(), 200)
    first, again = play(small_env(seed=1), actions), play(small_env(seed=1), actions)
    assert (first == again).all()
    assert not torch.equal(play(small_env(seed=2), actions)["position"], first["position"])
    env = small_env(seed=2)
    env.set_seed(1)
    assert (play(env, actions) == first).all()


def test_setting_the_seed_again_starts_the_random_numbers_anew():
    env = small_env(seed=1)
    actions = plan_for(env, 100)
    first = play(env, actions)
    assert not torch.equal(play(env, actions)["position"], first["position"])
    env.set_seed(1)
    assert (play(env, actions) == first).all()


def test_without_a_seed_two_envs_differ():
    one, other = (GridWorldEnv(sample_worlds(torch.arange(2), size=5, window=3)) for _ in range(2))
    assert not torch.equal(one.generator.get_state(), other.generator.get_state())


def test_copies_of_a_world_have_random_numbers_of_their_own():
    env = drawn_env(".....", ".....", ".....", ".....", ".....", noise=1.0, copies=200)
    position = play(env, torch.zeros(200, 1, dtype=torch.int64))["next", "position"].squeeze(1)
    moved = (position % 25).bincount(minlength=25)[[7, 13, 17, 11]]
    assert moved.sum() == 200
    assert (moved - 50).abs().max() < 5 * (200 * 0.25 * 0.75) ** 0.5


def test_observation_and_state_are_those_of_the_position():
    env = small_env()
    batch = play(env, plan_for(env, 50))
    views = windows(env.worlds.kind, 3).flatten(0, 1)
    for part in (batch, batch["next"]):
        assert torch.equal(part["observation"], views[part["position"]])
        assert torch.equal(part["state"], env.worlds.state.flatten()[part["position"]])
    world = torch.arange(4).unsqueeze(1)
    assert torch.equal(batch["next", "position"] // 49, world.expand(4, 50))


def test_done_world_starts_anew_while_the_others_go_on():
    env = small_env(6, end_prob=0.2)
    batch = play(env, plan_for(env, 60))
    done, arrived, root = batch["next", "done"].squeeze(-1), batch["next", "position"], batch["position"]
    start = env.worlds.start + torch.arange(6) * 49
    assert torch.equal(root[:, 0], start)
    assert torch.equal(root[:, 1:], torch.where(done[:, :-1], start.unsqueeze(1), arrived[:, :-1]))
    assert (done.any(0) & ~done.all(0)).any()  # some steps ended for a part of the worlds only
    assert ((arrived != start.unsqueeze(1)) & ~done).any()


def test_reset_by_hand_of_one_world_leaves_the_others():
    env = drawn_env(".....", ".....", ".....", ".....", ".....", copies=3)
    step = env.step(env.reset().set("action", torch.tensor([UP, RIGHT, DOWN])))["next"]
    assert (step["position"] - torch.arange(3) * 25).tolist() == [7, 13, 17]
    step["_reset"] = torch.tensor([[False], [True], [False]])
    root = env.reset(step.clone())
    assert (root["position"] - torch.arange(3) * 25).tolist() == [7, 12, 17]
    assert torch.equal(root["state"], env.worlds.state.flatten()[root["position"]])
    assert not root["done"].any()


def test_reset_does_not_share_memory_with_the_start():
    env = small_env()
    env.reset()["position"].zero_()
    assert torch.equal(env.reset()["position"] % 49, env.worlds.start)


def test_step_is_the_pure_transition_of_the_same_draws():
    env = small_env(noise=0.5, end_prob=0.1)
    root = env.reset()
    for action in plan_for(env, 40).unbind(1):
        slip, end = torch.rand(2, *env.batch_size, generator=env.generator.clone_state())
        position, reward, done = transition(env.maps, root["position"], action, slip, end, noise=0.5, end_prob=0.1)
        stepped = env.step(root.set("action", action))["next"]
        assert torch.equal(stepped["position"], position)
        assert torch.equal(stepped["reward"], reward.unsqueeze(-1))
        assert torch.equal(stepped["terminated"], done.unsqueeze(-1))
        root = stepped.exclude("reward")


def test_slip_replaces_the_action_by_each_other_one_in_equal_parts():
    env = drawn_env("...", "...", "...")
    position, action = torch.full((8,), 4), torch.full((8,), UP)
    slip = torch.tensor([0.0, 0.0499, 0.05, 0.0999, 0.1, 0.1499, 0.15, 0.1999])
    arrived, _, _ = transition(env.maps, position, action, slip, torch.ones(8), noise=0.2, end_prob=0.0)
    assert arrived.tolist() == [1, 1, 5, 5, 7, 7, 3, 3]
    arrived, _, _ = transition(env.maps, position, action, slip + 0.2, torch.ones(8), noise=0.2, end_prob=0.0)
    assert (arrived == 1).all()


def test_noise_and_end_come_as_often_as_they_should():
    count = 20_000
    env = drawn_env("...", "...", "...", noise=0.1, end_prob=0.3, copies=count)
    batch = play(env, torch.full((count, 1), UP)).squeeze(1)
    cell, done = batch["next", "position"] % 9, batch["next", "done"].squeeze(-1)
    for where, probability in ((1, 0.925), (5, 0.025), (7, 0.025), (3, 0.025)):
        frequency = (cell == where).double().mean()
        assert abs(frequency - probability) < 5 * (probability * (1 - probability) / count) ** 0.5
    assert abs(done.double().mean() - 0.3) < 5 * (0.3 * 0.7 / count) ** 0.5
    together = torch.corrcoef(torch.stack([(cell != 1).double(), done.double()]))[0, 1]
    assert together.abs() < 5 / count**0.5


def test_without_noise_and_end_nothing_is_random():
    env = drawn_env("...", "...", "...", copies=50)
    batch = play(env, torch.full((50, 40), LEFT))
    assert (batch["next", "position"] % 9 == 3).all()
    assert not batch["next", "done"].any()


def test_bumping_into_a_wall_beside_a_paying_cell_pays_again():
    env = drawn_env(".....", ".....", "...C#", ".....", ".....")
    batch = play(env, torch.tensor([[RIGHT, RIGHT, RIGHT, UP, UP, UP, UP]]))
    assert batch["next", "reward"].flatten().tolist() == [1, 1, 1, 0, 0, 0, 0]
    env = drawn_env("...", "..c", "...")  # so does the border of the grid
    assert play(env, torch.tensor([[RIGHT, RIGHT, LEFT]]))["next", "reward"].flatten().tolist() == [-1, -1, 0]


@pytest.mark.parametrize(
    ("cell", "reward", "ends"),
    [("A", 10, True), ("a", -10, True), ("B", 5, True), ("b", -5, True), ("C", 1, False), ("c", -1, False)],
)
def test_arriving_pays_and_ends_by_the_kind_of_cell(cell, reward, ends):
    env = drawn_env("...", f"..{cell}", "...")
    batch = play(env, torch.tensor([[RIGHT, LEFT]]))
    assert batch["next", "reward"][0, 0].item() == reward
    assert batch["next", "terminated"].flatten().tolist() == [ends, False]
    assert torch.equal(batch["next", "done"], batch["next", "terminated"])
    assert batch["position"][0, 1] == (4 if ends else 5)


def test_env_moves_with_its_worlds_to_a_device():
    env = small_env(2).to("cpu")
    assert env.device == torch.device("cpu")
    assert env.rollout(3, break_when_any_done=False)["position"].device.type == "cpu"


@pytest.mark.skipif(not torch.cuda.is_available(), reason="no GPU")
def test_rollout_is_the_same_on_a_gpu():
    actions = plan_for(small_env(), 100)
    expected = play(small_env(), actions)
    built, moved = small_env(device="cuda"), small_env().to("cuda")
    for env in (built, moved):
        assert (play(env, actions.cuda()).cpu() == expected).all()


def test_collector_continues_episodes_over_its_batches():
    env = small_env(3)
    collector = Collector(env, None, frames_per_batch=30, total_frames=90)
    batches = list(collector)
    collector.shutdown()
    whole = torch.cat(batches, 1)
    assert whole.shape == (3, 30)
    done, start = whole["next", "done"].squeeze(-1), env.worlds.start.unsqueeze(1) + torch.arange(3).unsqueeze(1) * 49
    expected = torch.where(done[:, :-1], start, whole["next", "position"][:, :-1])
    assert torch.equal(whole["position"][:, 1:], expected)


def test_state_dict_carries_the_random_numbers_on():
    env = small_env(seed=1)
    actions = plan_for(env, 40)
    play(env, actions)
    saved = {name: value.clone() for name, value in env.state_dict().items()}
    other = small_env(seed=9)
    other.load_state_dict(saved)
    assert (play(other, actions) == play(env, actions)).all()


@pytest.mark.parametrize(
    ("kwargs", "message"),
    [({"noise": 1.5}, "noise"), ({"end_prob": -0.1}, "end_prob"), ({"noise": float("nan")}, "noise")],
)
def test_bad_settings_are_refused_by_name(kwargs, message):
    with pytest.raises(ValueError, match=message):
        small_env(2, **kwargs)


@pytest.mark.parametrize("window", [1, 5])
def test_agent_sees_the_window_that_the_worlds_are_numbered_by(window):
    worlds = sample_worlds(torch.arange(3), size=5, window=window)
    for some in (worlds, worlds[1:], torch.cat([worlds, worlds]), worlds.to("cpu")):
        seen = GridWorldEnv(some).reset()["observation"]
        assert seen.shape == (len(some), window, window)


@pytest.mark.parametrize("action", [-1, 4])
def test_an_action_that_there_is_not_is_refused(action: int) -> None:
    env = GridWorldEnv(sample_worlds(torch.arange(2)))
    state = env.reset().set("action", torch.tensor([0, action]))
    with pytest.raises(ValueError, match=rf"Actions are 0 to 3 .*, got {min(0, action)} to {max(0, action)}\."):
        env.step(state)
