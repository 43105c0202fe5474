"""Speed of collection on MuJoCo's walking tasks, against the simulator alone.

    pip install torchrl-priors[benchmarks]
    python benchmarks/collect.py [--tasks HalfCheetah,Humanoid] [--rounds 8] [--steps 128]

One process and one thread; frames per second of CPU time. The contenders take turns, so that whatever else the machine
does hits them alike: ``mj_step`` alone on the models of the environments (resets and all else are not timed), the
vector of environments of this library and Gymnasium's, and ``VectorCollector`` with the recipe's actor, untrained, and
a normaliser. All take standard normal actions, clipped, which are about what such an actor draws: episodes are short,
and resets as frequent as they get. A ratio is the median over rounds of a ratio within a round.
"""

from __future__ import annotations

import argparse
import sys
import time
import warnings
from collections.abc import Callable
from pathlib import Path
from statistics import median
from typing import Any

ROOT = Path(__file__).parents[1]
sys.path[:] = [entry for entry in sys.path if entry != str(ROOT / "benchmarks")]  # whose files are no packages

import gymnasium
import mujoco
import numpy as np
import torch
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from omegaconf import OmegaConf

from torchrl_priors.collectors import RunningNorm, VectorCollector, make_vector_env
from torchrl_priors.networks import make_actor

TASKS = ("HalfCheetah", "Hopper", "Walker2d", "Ant", "Humanoid")
BARE, FAST, GYMNASIUM, COLLECTOR = "mj_step", "make_vector_env", "SyncVectorEnv", "VectorCollector"


def clipped_normal(env: Any, generator: np.random.Generator) -> np.ndarray:
    space = env.single_action_space
    draws = generator.normal(size=(env.num_envs, *space.shape)).astype(np.float32)
    return np.clip(draws, space.low, space.high)


def simulate(env: Any, steps: int) -> float:
    """CPU seconds of the simulator's steps alone; episodes end as those of the others do."""
    generator, seconds = np.random.default_rng(0), 0.0
    bases = [sub.unwrapped for sub in env.envs]
    for _ in range(steps):
        actions = clipped_normal(env, generator)
        start = time.process_time()
        for base, action in zip(bases, actions, strict=True):
            base.data.ctrl[:] = action
            mujoco.mj_step(base.model, base.data, nstep=base.frame_skip)
        seconds += time.process_time() - start
        for base in bases:
            if not getattr(base, "is_healthy", True):
                base.reset()
    return seconds


def step(env: Any, steps: int) -> float:
    """CPU seconds of steps and resets."""
    generator, seconds = np.random.default_rng(0), 0.0
    for _ in range(steps):
        actions = clipped_normal(env, generator)
        start = time.process_time()
        _, _, terminated, truncated, _ = env.step(actions)
        if (done := terminated | truncated).any():
            env.reset(options={"reset_mask": done})
        seconds += time.process_time() - start
    return seconds


def collect(collector: VectorCollector) -> float:
    """CPU seconds of a rollout."""
    start = time.process_time()
    collector.rollout()
    return time.process_time() - start


def measure(task: str, rounds: int, steps: int | None = None) -> tuple[int, dict[str, list[float]]]:
    """The number of environments, and the frames/s of each contender in each round; a first round is not counted.

    Args:
        task (str): one of ``TASKS``.
        rounds (int): number of rounds.
        steps (int, optional): of each environment in a round. Defaults to None: those of the recipe's rollout.
    """
    cfg = OmegaConf.load(ROOT / "conf" / "env" / f"{task.lower()}.yaml")
    env_id, num_envs = f"{cfg.id}-{cfg.version}", cfg.num_envs
    steps = steps or cfg.frames_per_batch // num_envs
    torch.manual_seed(0)
    bare, fast, collected = (make_vector_env(env_id, num_envs) for _ in range(3))
    plain = SyncVectorEnv([lambda: gymnasium.make(env_id)] * num_envs, autoreset_mode=AutoresetMode.DISABLED)
    for env in (bare, fast, plain):
        env.reset(seed=0)
    observations, actions = fast.single_observation_space.shape[0], fast.single_action_space.shape[0]
    collector = VectorCollector(
        collected,
        make_actor(observations, actions),
        frames_per_batch=steps * num_envs,
        normalizer=RunningNorm(observations),
        seed=0,
    )
    contenders: dict[str, Callable[[], float]] = {
        BARE: lambda: simulate(bare, steps),
        FAST: lambda: step(fast, steps),
        GYMNASIUM: lambda: step(plain, steps),
        COLLECTOR: lambda: collect(collector),
    }
    rates: dict[str, list[float]] = {name: [] for name in contenders}
    for _ in range(rounds + 1):
        for name, run in contenders.items():
            rates[name].append(steps * num_envs / run())
    for env in (bare, fast, plain, collected):
        env.close()
    return num_envs, {name: values[1:] for name, values in rates.items()}


def main(arguments: list[str] | None = None) -> None:
    """Measure and print a table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--tasks", default=",".join(TASKS))
    parser.add_argument("--rounds", type=int, default=8)
    parser.add_argument("--steps", type=int, help="of an environment in a round; default: those of a rollout")
    args = parser.parse_args(arguments)
    torch.set_num_threads(1)
    warnings.filterwarnings("ignore", category=DeprecationWarning)
    names = (BARE, FAST, GYMNASIUM, COLLECTOR)
    print("frames/s, medians; at the end VectorCollector / mj_step: median (range)")
    print(f"{'task':13}{'envs':>4}", *(f"{name:>16}" for name in names))
    for task in args.tasks.split(","):
        num_envs, rates = measure(task, args.rounds, args.steps)
        ratios = [one / other for one, other in zip(rates[COLLECTOR], rates[BARE], strict=True)]
        columns = [f"{median(rates[name]):16,.0f}" for name in names]
        print(f"{task:13}{num_envs:4}", *columns, f"{median(ratios):6.2f} ({min(ratios):.2f} to {max(ratios):.2f})")


if __name__ == "__main__":
    main()
