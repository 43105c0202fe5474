"""Files of teachers of every kind, and a module with bots, for the tests of ``prior.path``."""

from __future__ import annotations

from pathlib import Path

import gymnasium
import torch
from stable_baselines3 import DQN, PPO, SAC, TD3
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize
from torch import nn

SHORT = ["trial.max_frames=128", "trial.min_frames=64", "total_frames=256"]
CARTPOLE = ["env=any", "env.id=CartPole-v1", *SHORT]
PENDULUM = ["env=any", "env.id=Pendulum-v1", "+env.kwargs.max_episode_steps=16", *SHORT]
BOT = """
import numpy as np

def brake(observation):
    return -observation[2:]

def push(observation):
    return int(observation[2] > 0)

def flat(observation):
    return -float(observation[2])

def whole(observation):
    return 7

def broken(observation):
    raise KeyError("no such joint")

angle = 3.0
"""
TRUSTED = "prior.trust_code=true"


class Greedy(nn.Module):
    def forward(self, observation: torch.Tensor) -> torch.Tensor:
        return (observation[:, 2] > 0).long()


class Gaussian(nn.Module):
    def forward(self, observation: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        loc = -observation[:, 2:]
        return loc, torch.full_like(loc, 0.5)


def write_teachers(folder: Path) -> None:
    """Files of every kind."""
    (folder / "bot_of_a_test.py").write_text(BOT)

    def small(kind, env, **options):
        return kind("MlpPolicy", env, policy_kwargs={"net_arch": [8]}, device="cpu", seed=0, **options)

    env = VecNormalize(DummyVecEnv([lambda: gymnasium.make("Pendulum-v1")]))
    small(PPO, env).save(folder / "normalised")
    env.save(folder / "vec.pkl")
    small(PPO, "Pendulum-v1").save(folder / "ppo")
    small(PPO, "CartPole-v1").save(folder / "cartpole")
    small(SAC, "Pendulum-v1", buffer_size=10).save(folder / "sac")
    small(TD3, "Pendulum-v1", buffer_size=10).save(folder / "td3")
    small(DQN, "CartPole-v1", buffer_size=10).save(folder / "dqn")
    for name, network in {
        "logits": nn.Linear(4, 2),
        "action": nn.Linear(3, 1),
        "index": Greedy(),
        "gaussian": Gaussian(),
    }.items():
        torch.jit.script(network).save(folder / f"{name}.pt")


def given_to(name: str, folder: Path, env: list[str], options: list[str]) -> list[str]:
    path = name if ":" in name else folder / name
    return [*env, f"prior.path={path}", *(option.format(folder=folder) for option in options)]
