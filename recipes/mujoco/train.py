"""A MuJoCo run from its configuration to its end."""

from __future__ import annotations

import time

import torch

from recipes.mujoco.config import MujocoConfig
from recipes.mujoco.run import Run, Supervisor
from recipes.mujoco.task import Task, open_task
from recipes.mujoco.trial import Students
from recipes.mujoco.worth import keep_worth, play_teachers, worth_of
from torchrl_priors.collectors import evaluate

__all__ = ["run", "train"]


def run(cfg: MujocoConfig) -> str | None:
    """Check, train, and leave a status whatever happens. The error, in a sweep, whose other runs go on."""
    torch.set_num_threads(1)
    with Supervisor() as supervisor:
        task = open_task(cfg)
        run = Run(cfg)
        if run.is_finished:
            print(f"{run.folder.path}: finished already", flush=True)
        else:
            supervisor.run = run
            train(cfg, task, run)
        print(worth_of(run.folder), end="\n" if cfg.method != "none" else "", flush=True)
        run.folder.release()
    return supervisor.error


def train(cfg: MujocoConfig, task: Task, run: Run) -> None:
    """Train to the end, from the last checkpoint if there is one."""
    test_env = task.make_env(cfg.evaluation.episodes)
    students = Students(cfg, task)
    run.begin(students)
    play_teachers(cfg, task, test_env, run.folder)

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
        run.checkpoint_if_due(students)
    agent = students.by_arm[students.chosen].agent
    keep_worth(cfg, run.folder, run.evaluations[-1], students.results)
    run.finish(agent.actor, agent.normalizer, task.env_id, arm=students.chosen if students.several else None)
