"""Speed of the tabular study: transitions per CPU second of one thread, for the teacher and for each method's student.

    python benchmarks/gridworld.py [--worlds 20] [--rounds 3]

Evaluation episodes are counted as time, and training transitions alone as work.
"""

from __future__ import annotations

import argparse
import resource
import sys
import time
from collections.abc import Callable
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1]))

from hydra import compose, initialize_config_dir

from recipes.gridworld.study import TaughtWorld, make_learner, sample_world
from torchrl_priors.methods import METHODS

CONF = str(Path(__file__).parents[1] / "conf")


def rate(work: Callable[[], object], transitions: int, rounds: int) -> float:
    """Millions of transitions per CPU second, in the best of some rounds."""
    seconds = []
    for _ in range(rounds):
        start = time.process_time()
        work()
        seconds.append(time.process_time() - start)
    return transitions / min(seconds) / 1e6


def main() -> None:
    """Measure, and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--worlds", type=int, default=20)
    parser.add_argument("--rounds", type=int, default=3)
    args = parser.parse_args()
    with initialize_config_dir(CONF, version_base="1.3"):
        cfg = compose("gridworld", overrides=["study=small"])
    learners = {method: make_learner(cfg, method) for method in METHODS}
    prior = "structural_3"

    start = time.perf_counter()
    TaughtWorld(cfg, 0).train("ae2r", prior, TaughtWorld(cfg, 0).advice(prior), learners["ae2r"])
    print(f"first world, with compilation or its cache  {time.perf_counter() - start:6.1f} s")

    worlds = [TaughtWorld(cfg, seed) for seed in range(args.worlds)]
    advice = [world.advice(prior) for world in worlds]
    samples = rate(lambda: [sample_world(cfg, world.seed) for world in worlds], args.worlds, args.rounds) * 1e6
    print(f"sampling             {samples:6.0f} worlds per CPU second")
    teachers = rate(lambda: [world.teach() for world in worlds], args.worlds * cfg.teacher.steps, args.rounds)
    print(f"teachers             {teachers:6.1f} M transitions per CPU second")
    budget = args.worlds * cfg.evaluation.points * cfg.evaluation.interval
    students = {}
    for method, learner in learners.items():

        def train(method: str = method, learner: object = learner) -> None:
            for world, said in zip(worlds, advice, strict=True):
                world.train(method, prior, said, learner)  # type: ignore[arg-type]

        students[method] = rate(train, budget, args.rounds)
        print(f"{method:20} {students[method]:6.1f} M transitions per CPU second")
    paper = ["er", "e2r", "aer", "ae2r"]
    seconds = 1000 * (
        cfg.teacher.steps / teachers + 30000 * (1 / students["none"] + sum(7 / students[m] for m in paper))
    )
    print(f"the paper's table of 1000 worlds: {seconds / 1e6:.0f} CPU seconds, tables and figures apart")
    print(f"memory                {resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20:.2f} GiB")


if __name__ == "__main__":
    main()
