"""PPO with an AVEC critic on MuJoCo, learning from a teacher by any of the methods.

    python -m recipes.mujoco env=hopper method=ae2r prior.path=teacher.safetensors [key=value ...]

A run keeps everything in one folder: ``eval.csv``, ``metrics.csv``, checkpoints and, at the end, the teacher that it
makes, ``policy.safetensors``. An interrupted run continues with the same command; a finished one is not run again. See
``conf/mujoco.yaml`` for the keys.
"""

from __future__ import annotations

import time

import hydra
import torch

from recipes.launchers import start
from recipes.mujoco_config import MujocoConfig, check
from recipes.mujoco_run import Run, supervise
from recipes.mujoco_trial import Students
from torchrl_priors.collectors import evaluate, make_vector_env


def train(cfg: MujocoConfig, run: Run) -> None:
    """Train to the end, from the last checkpoint if there is one."""
    env_id = f"{cfg.env.id}-{cfg.env.version}"
    test_env = make_vector_env(env_id, cfg.evaluation.episodes, **cfg.env.kwargs)
    students = Students(cfg, env_id)
    run.register(students)

    def evaluate_policy() -> None:
        agent = students.by_arm[students.chosen].agent
        result = evaluate(
            test_env,
            agent.actor,
            episodes=cfg.evaluation.episodes,
            normalizer=agent.normalizer,
            seed=cfg.seed * 1_000_003 + students.frames,
        )
        run.log_evaluation(students.frames, result)

    if students.frames == 0:
        evaluate_policy()
    if cfg.compile:
        run.announce("compiling")
    began, first = time.perf_counter(), students.frames
    while students.frames < cfg.total_frames:
        known = len(students.results)
        for arm, metrics, weights in students.round():
            metrics["fps"] = torch.tensor((students.frames - first) / (time.perf_counter() - began))
            run.log(students.frames, metrics, weights, arm=arm if students.several else None)
            if run.evaluation_is_due(students.frames):  # of trials, too, at the same frames as of any other run
                evaluate_policy()
        if len(students.results) > known:
            run.log_trials(students.results)
        run.checkpoint_if_due(students.frames)
    agent = students.by_arm[students.chosen].agent
    run.finish(agent.actor, agent.normalizer, env_id, arm=students.chosen if students.several else None)


@hydra.main(version_base="1.3", config_path="../conf", config_name="mujoco")
def main(cfg: MujocoConfig) -> str | None:
    """Train, or continue training, one agent."""
    return supervise(cfg, check, train)


if __name__ == "__main__":
    start(main)
