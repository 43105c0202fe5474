"""The loop of a MuJoCo run."""

from __future__ import annotations

import time

import torch

from recipes.mujoco.config import MujocoConfig
from recipes.mujoco.run import Run
from recipes.mujoco.trial import Students
from torchrl_priors.collectors import evaluate, make_vector_env

__all__ = ["train"]


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
