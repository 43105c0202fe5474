"""Speed of PPO on MuJoCo: the recipe, with and without a prior, against Stable-Baselines3 and TorchRL's collector.

    pip install torchrl-priors[benchmarks]
    python benchmarks/continuous.py [--env halfcheetah] [--rounds 8] [--rollouts 4] [recipe key=value ...]

One process and one thread. The contenders take turns, a few rollouts each, so that whatever else the machine does hits
them alike; a ratio is the median over rounds of a ratio within a round. The teacher is an untrained network: its speed
is that of any. Stable-Baselines3 has the recipe's networks, hyperparameters and number of environments, normalised
observations, and is otherwise as it comes. Training is all but evaluations and files; "whole run" adds the recipe's
evaluations, which cost every method the same. Compilation, once a run, is shown apart.
"""

from __future__ import annotations

import argparse
import os
import sys
import time
from collections.abc import Callable
from pathlib import Path
from statistics import median
from tempfile import TemporaryDirectory
from typing import Any

ROOT = Path(__file__).parents[1]
sys.path.insert(0, str(ROOT))  # also where it is not installed

import torch
from hydra import compose, initialize_config_dir
from stable_baselines3 import PPO
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import VecNormalize
from torchrl.collectors import Collector
from torchrl.envs import DoubleToFloat, GymEnv, SerialEnv, TransformedEnv

from recipes.mujoco.agent import Agent, Optimiser
from recipes.mujoco.task import open_task
from torchrl_priors import policy_prior, save_prior
from torchrl_priors.collectors import RunningNorm, VectorCollector, evaluate
from torchrl_priors.networks import make_actor


class Recipe:
    """What ``recipes.mujoco`` does between two evaluations."""

    def __init__(self, overrides: list[str]) -> None:
        with initialize_config_dir(str(ROOT / "conf"), version_base="1.3"):
            self.cfg = cfg = compose("mujoco", overrides=overrides)
        torch.manual_seed(0)
        self.task = open_task(cfg)
        self.env_id = self.task.env_id
        self.agent = agent = Agent(cfg, self.task)
        self.optimise = Optimiser(agent)
        self.collector = VectorCollector(
            self.task.make_env(cfg.env.num_envs),
            agent.actor,
            frames_per_batch=cfg.env.frames_per_batch,
            normalizer=agent.normalizer,
            seed=0,
        )

    def train(self, rollouts: int) -> None:
        """Collect, prepare, optimise."""
        for _ in range(rollouts):
            self.optimise(self.agent.prepare(self.collector.rollout()))

    def collect(self, rollouts: int) -> None:
        """Collect only."""
        for _ in range(rollouts):
            self.collector.rollout()

    def evaluation_seconds(self) -> float:
        """Of one evaluation, which comes every ``evaluation.interval`` frames."""
        episodes = self.cfg.evaluation.episodes
        env = self.task.make_env(episodes)
        start = time.perf_counter()
        evaluate(env, self.agent.actor, episodes=episodes, normalizer=self.agent.normalizer, seed=0)
        return time.perf_counter() - start


def stable_baselines(cfg: Any, env_id: str) -> Callable[[int], None]:
    """Its PPO with the recipe's settings."""
    env = make_vec_env(env_id, cfg.env.num_envs, seed=0, env_kwargs=dict(cfg.env.kwargs))
    hidden = list(cfg.ppo.hidden)
    model = PPO(
        "MlpPolicy",
        VecNormalize(env, norm_reward=False),
        n_steps=cfg.env.frames_per_batch // cfg.env.num_envs,
        batch_size=cfg.env.minibatch_size,
        n_epochs=cfg.ppo.epochs,
        learning_rate=cfg.ppo.lr,
        gamma=cfg.ppo.gamma,
        gae_lambda=cfg.ppo.gae_lambda,
        clip_range=cfg.ppo.clip_epsilon,
        ent_coef=cfg.ppo.entropy_coeff,
        max_grad_norm=cfg.ppo.max_grad_norm,
        policy_kwargs={
            "net_arch": {"pi": hidden, "vf": hidden},
            "activation_fn": torch.nn.Tanh,
            "optimizer_kwargs": {"eps": cfg.ppo.adam_eps},
        },
        device="cpu",
        seed=0,
    )

    def train(rollouts: int) -> None:
        model.learn(rollouts * cfg.env.frames_per_batch, reset_num_timesteps=False)

    return train


def torchrl_collector(cfg: Any, env_id: str) -> Callable[[int], None]:
    """TorchRL's collector over a SerialEnv, the policy on raw observations."""
    env = TransformedEnv(SerialEnv(cfg.env.num_envs, lambda: GymEnv(env_id, **cfg.env.kwargs)), DoubleToFloat())
    sizes = env.observation_spec["observation"].shape[-1], env.action_spec.shape[-1]
    actor = make_actor(*sizes, list(cfg.ppo.hidden), in_key="observation")
    batches = iter(Collector(env, actor, frames_per_batch=cfg.env.frames_per_batch, total_frames=-1))

    def collect(rollouts: int) -> None:
        for _ in range(rollouts):
            next(batches)

    return collect


def take_turns(contenders: dict[str, Callable[[int], None]], rounds: int, rollouts: int) -> dict[str, list[float]]:
    """Seconds for so many rollouts, by contender, one for each round; a first round is not counted."""
    seconds: dict[str, list[float]] = {name: [] for name in contenders}
    for _ in range(rounds + 1):
        for name, run in contenders.items():
            start = time.perf_counter()
            run(rollouts)
            seconds[name].append(time.perf_counter() - start)
    return {name: values[1:] for name, values in seconds.items()}


def ratio(seconds: dict[str, list[float]], fast: str, slow: str, extra: float = 0.0) -> str:
    """How many times the speed of ``slow`` is that of ``fast``: the median over rounds, and their range."""
    ratios = [(s + extra) / (f + extra) for f, s in zip(seconds[fast], seconds[slow], strict=True)]
    return f"{median(ratios):6.2f} x  ({min(ratios):.2f} to {max(ratios):.2f})"


def main() -> None:
    """Run all contenders and print a table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--env", default="halfcheetah")
    parser.add_argument("--rounds", type=int, default=8)
    parser.add_argument("--rollouts", type=int, default=4, help="of a contender in a round")
    parser.add_argument("--methods", default="e2r,ae2r", help="besides none")
    args, overrides = parser.parse_known_args()
    torch.set_num_threads(1)
    methods = ["none", *args.methods.split(",")]

    with TemporaryDirectory() as folder:
        overrides.append(f"env={args.env}")
        baseline = Recipe([*overrides, "method=none"])
        cfg, env_id = baseline.cfg, baseline.env_id
        path = os.path.join(folder, "teacher.safetensors")
        norm = RunningNorm(baseline.agent.normalizer.mean.shape)
        save_prior(path, policy_prior(baseline.agent.actor, norm), env_id=env_id)
        recipes = {"none": baseline}
        for method in methods[1:]:
            recipes[method] = Recipe([*overrides, f"method={method}", f"prior.path={path}"])

    for name, recipe in recipes.items():
        start = time.perf_counter()
        recipe.train(1)
        print(f"first rollout of {name:11}{time.perf_counter() - start:9.1f} s")
    frames = args.rollouts * cfg.env.frames_per_batch
    training = {name: recipe.train for name, recipe in recipes.items()}
    training["stable-baselines3"] = stable_baselines(cfg, env_id)
    seconds = take_turns(training, args.rounds, args.rollouts)
    print(f"{env_id}, {cfg.env.num_envs} environments, one thread; frames/s of {args.rounds} rounds: median (range)")
    for name, values in seconds.items():
        rates = [frames / value for value in values]
        print(f"train    {name:20}{median(rates):9,.0f}  ({min(rates):,.0f} to {max(rates):,.0f})")

    collecting = {"VectorCollector": baseline.collect, "TorchRL's Collector": torchrl_collector(cfg, env_id)}
    collected = take_turns(collecting, max(2, args.rounds // 2), 1)
    for name, values in collected.items():
        print(f"collect  {name:20}{median(cfg.env.frames_per_batch / value for value in values):9,.0f}")

    print("ratios of frames/s: median over rounds (range)")
    evaluation = baseline.evaluation_seconds() * frames / cfg.evaluation.interval
    rows = [("none / Stable-Baselines3's PPO, training", ratio(seconds, "none", "stable-baselines3"))]
    for method in methods[1:]:
        rows.append((f"{method} / none, training", ratio(seconds, method, "none")))
        rows.append((f"{method} / none, whole run", ratio(seconds, method, "none", extra=evaluation)))
    rows.append(("VectorCollector / TorchRL's Collector", ratio(collected, *collecting)))
    for name, value in rows:
        print(f"{name:44}{value}")


if __name__ == "__main__":
    main()
