"""Speed of the tabular study, by phase.

    python benchmarks/gridworld.py [--worlds 125] [--device cpu] [--eager]

Trains the teachers and every student of ``study=paper`` in a few worlds, in one process, with the recipe's settings,
and prints transitions per second. "Step" counts every transition of the lock-step batch (training and evaluation),
"study" only those of the training budget, from the first step of the batch to its last: lanes that wait at the end
count against it. Compilation is shown apart. The last line extrapolates to the whole study, one such process a core.
"""

from __future__ import annotations

import argparse
import os
import resource
import time

import torch

from torchrl_priors.envs import GridWorlds, sample_worlds
from torchrl_priors.tabular import (
    Hyper,
    StudentConfig,
    TeacherHyper,
    runs_of,
    sample_degraded,
    train_students,
    train_teachers,
)
from torchrl_priors.tabular.actor_critic import LOG_FIELDS

METHODS = ["none", "er", "e2r", "aer", "ae2r"]
PRIORS = ["expert", "random_15", "random_30", "random_50", "structural_3", "structural_5", "structural_10"]
WORLDS, BUDGET = 1000, 30_000


def students(
    worlds: GridWorlds,
    seeds: torch.Tensor,
    q: torch.Tensor,
    visited: torch.Tensor,
    args: argparse.Namespace,
    points: int,
):
    """Train all students for ``points`` evaluation points; the time, training and all transitions."""
    hyper = Hyper(gamma=0.95, lr=0.1, noise=0.1, end_prob=0.01, eval_interval=300, eval_points=points)
    config = StudentConfig(hyper, {"td": 0.001, "advantage": 0.1}, "original", 1.0, 1.0, 1.0)
    degraded = {n: sample_degraded(q, visited, seeds, n, 1.0) for n in (3, 5, 10)}
    pairs, training = runs_of(METHODS, PRIORS), []
    start = time.perf_counter()
    log = train_students(
        worlds, seeds, q, degraded, pairs, config, lanes=args.lanes, compile=not args.eager, progress=training.append
    )
    elapsed = time.perf_counter() - start
    return elapsed, sum(training), sum(training) + int(log[..., LOG_FIELDS.index("length")].sum())


def main() -> None:
    """Run every phase and print a table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--worlds", type=int, default=125)
    parser.add_argument("--lanes", type=int, default=1024)
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--eager", action="store_true", help="without torch.compile")
    args = parser.parse_args()
    torch.set_num_threads(1)
    cores = len(os.sched_getaffinity(0)) if args.device == "cpu" else 1
    seeds = torch.arange(args.worlds, device=args.device)
    hyper = TeacherHyper(gamma=0.95, lr=0.1, epsilon=0.2, noise=0.1, end_prob=0.01)

    start = time.perf_counter()
    worlds = sample_worlds(seeds)
    print(f"worlds              {args.worlds / (time.perf_counter() - start):12,.0f} worlds/s")
    many = torch.arange(WORLDS, device=args.device)
    batch = sample_worlds(many)
    start = time.perf_counter()
    train_teachers(batch, many, hyper, steps=1, compile=not args.eager)
    print(f"teachers, compiling {time.perf_counter() - start:12.1f} s")
    start = time.perf_counter()
    q, visited = train_teachers(batch, many, hyper, steps=BUDGET, compile=not args.eager)
    teacher_time = time.perf_counter() - start
    print(f"teachers            {WORLDS * BUDGET / teacher_time:12,.0f} transitions/s ({WORLDS} worlds)")

    some = (worlds, seeds, q[: args.worlds], visited[: args.worlds])
    compiling, *_ = students(*some, args, points=1)
    print(f"students, first     {compiling:12.1f} s (compiling and one evaluation point)")
    elapsed, training, everything = students(*some, args, points=100)
    print(f"students, step      {everything / elapsed:12,.0f} transitions/s")
    print(f"students, study     {training / elapsed:12,.0f} transitions/s")
    runs = len(runs_of(METHODS, PRIORS))
    whole = compiling + teacher_time + WORLDS * runs * BUDGET / (training / elapsed) / cores
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20
    print(f"whole study=paper   {whole:12.0f} s expected on {cores} process(es); peak memory here {peak:.2f} GiB")


if __name__ == "__main__":
    main()
