"""An episode of a finished MuJoCo run, with what its prior weight makes of the teacher's advice."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import torch
from omegaconf import OmegaConf
from tensordict import TensorDictBase
from torch import Tensor

from recipes import plots
from recipes.common.checkpoints import Checkpoints
from recipes.common.run_folder import read_json, sha256
from recipes.mujoco.agent import Agent
from recipes.mujoco.config import Source, env_id
from recipes.mujoco.run import identity
from recipes.mujoco.task import Task, open_task
from recipes.plots.video import write_weight_video
from recipes.show_weight.source import read_config, reading
from torchrl_priors import PriorLogProb, StructuralDegradation
from torchrl_priors.collectors import VectorCollector
from torchrl_priors.collectors.vector_env import action_limits, spread_seed
from torchrl_priors.functional import td_residual
from torchrl_priors.methods import get_method

__all__ = ["show_episode"]

#: Keys that older runs lack.
_LATER = {"vecnormalize": None, "outputs": None, "std": None, "temperature": None, "epsilon": 0.1, "trust_code": False}


def load_agent(folder: Path, teacher: str | None) -> tuple[Agent, Task]:
    """The agent of a run as its last checkpoint has it, and the name of its environment.

    A checkpoint holds every network and the normaliser as plain tensors: nothing else needs to be exported.

    Raises:
        ValueError: the run has no learned weight or no checkpoint, one of its files is damaged, the teacher is not that
            of the run, or the environment or the checkpoint could run code.
    """
    cfg = read_config(folder)
    with reading(folder):
        return _load_agent(folder, cfg, teacher)


def _load_agent(folder: Path, cfg: Any, teacher: str | None) -> tuple[Agent, Task]:
    if cfg.method == "trial" or not get_method(cfg.method).adaptive:
        raise ValueError(f"{folder} is a run of method={cfg.method}, which has no learned weight.")
    if teacher is not None:
        cfg.prior.path = teacher
    if Source(str(cfg.prior.path)).kind in ("code", "torchscript"):
        raise ValueError(f"{folder}: its teacher {cfg.prior.path} is a program, and is not run for a figure.")
    cfg = OmegaConf.merge({"prior": _LATER}, cfg)
    matters = read_json(folder / "config.json")
    expected = matters["prior"]["sha256"]
    path = Path(cfg.prior.path)
    if not path.is_file():
        raise ValueError(f"The run's teacher {path} is not there: say where it is by episode.teacher=<file>.")
    if sha256(path) != expected:
        raise ValueError(f"{path} is not the teacher of {folder}: its content is another one.")
    name = env_id(cfg)
    if ":" in name:  # Gymnasium would import what is before it
        raise ValueError(f"{folder} is a run of {name!r}: an environment that names a module to import is not shown.")
    task = open_task(cfg)
    agent = Agent(cfg, task)
    checkpoints = Checkpoints(folder / "checkpoints", cfg.checkpoint.keep, identity(matters))
    if not checkpoints.load({"agent": agent}, dict):
        raise ValueError(f"{folder} has no checkpoint.")
    agent.normalizer.freeze()
    return agent, task


def play(agent: Agent, task: Task, seed: int, steps: int) -> TensorDictBase:
    """The first steps of an episode of the stochastic policy, ``[T]``, scored under the teacher."""
    collector = VectorCollector(
        task.make_env(1), agent.actor, frames_per_batch=steps, total_frames=-1, normalizer=agent.normalizer, seed=seed
    )
    torch.manual_seed(seed)  # what a degradation draws
    rollout = collector.rollout()
    collector.shutdown()
    (score,) = (transform for transform in agent.transforms if isinstance(transform, PriorLogProb))
    rollout = score(rollout)[0]
    ended = rollout["next", "done"].squeeze(-1).nonzero()
    return rollout[: int(ended[0]) + 1] if len(ended) else rollout


@torch.no_grad()
def weigh(agent: Agent, episode: TensorDictBase) -> dict[str, Tensor | None]:
    """The weight, log pi0, the TD error on raw rewards and where the advice is degraded, ``[T]`` each."""
    assert agent.weight is not None
    critic = agent.critic if agent.raw_critic is None else agent.raw_critic
    value, next_value = (critic(part.copy())["state_value"] for part in (episode, episode["next"]))
    delta = td_residual(
        value, episode["next", "reward"], next_value, episode["next", "terminated"], agent.cfg.ppo.gamma
    )
    loss: Any = agent.loss
    degraded, prior = None, loss.prior_loss.prior
    if isinstance(prior, StructuralDegradation):
        degraded = prior.mask(episode).reshape(-1)
    elif agent.cfg.prior.degrade == "random":
        degraded = episode[prior.draw_key].reshape(-1)
    weight = agent.weight(episode.copy())["prior_weight"]
    rows = {"weight": weight, "log_prob": episode["prior_log_prob"], "td_error": delta}
    return {name: row.reshape(-1) for name, row in rows.items()} | {"degraded": degraded}


def render(task: Task, actions: np.ndarray, seed: int) -> tuple[list[np.ndarray], float]:
    """Pictures of the episode, played once more, and how many there are a second.

    Raises:
        ValueError: there is no OpenGL to draw with.
    """
    import gymnasium

    try:
        env = gymnasium.make(task.env_id, render_mode="rgb_array", width=320, height=320, **task.kwargs)
        env.reset(seed=spread_seed(seed, 1, stream=0)[0][0])
        frames = []
        for action in actions:
            frames.append(np.asarray(env.render()))
            env.step(np.clip(action, *action_limits(env.action_space)))
    except Exception as error:  # OpenGL's many ways to fail
        raise ValueError(
            f"{task.env_id} cannot be drawn here ({type(error).__name__}: {error}): for MuJoCo, set MUJOCO_GL=egl or"
            " MUJOCO_GL=osmesa, and install that library, or leave episode.video=false."
        ) from error
    rate = float(env.metadata.get("render_fps", 50))
    env.close()
    return frames, rate


def show_episode(
    folder: Path, out: Path, *, seed: int, steps: int, teacher: str | None = None, video: bool = False
) -> list[Path]:
    """Figure, and video if asked for, of an episode of a run; their files.

    Raises:
        ValueError: see :func:`load_agent` and :func:`render`; fewer than one step.
    """
    if steps < 1:
        raise ValueError(f"episode.steps={steps}: expected a positive number.")
    agent, task = load_agent(folder, teacher)
    episode = play(agent, task, seed, steps)
    seen = weigh(agent, episode)
    figure = plots.episode_weights(**seen, method=agent.cfg.method)
    written = plots.save_figure(figure, out / f"weight_episode_{seed}")
    if video:
        frames, rate = render(task, episode["action"].numpy(), seed)
        written.append(
            write_weight_video(out / f"weight_episode_{seed}.gif", frames, seen["weight"], seen["degraded"], rate=rate)
        )
    return written
