"""What a teacher was worth: its own return beside those of the students without and with it."""

from __future__ import annotations

import json
from collections.abc import Sequence
from typing import Any

from gymnasium.vector import VectorEnv

from recipes.common.run_folder import RunFolder, read_json
from recipes.mujoco.agent import make_prior
from recipes.mujoco.config import ALONE, MujocoConfig, sources
from recipes.mujoco.task import Task
from recipes.mujoco.trial import LET_GO, arms
from torchrl_priors.collectors import evaluate
from torchrl_priors.teacher_trial import TrialResult

__all__ = ["keep_worth", "play_teachers", "worth_of"]

FILE = "teacher.json"


def play_teachers(cfg: MujocoConfig, task: Task, env: VectorEnv, folder: RunFolder) -> None:
    """Evaluate each teacher, as degraded as it is, as the students' policies are; once, for ``teacher.json``."""
    if cfg.method == "none" or (folder.path / FILE).exists():
        return
    played = {}
    for arm in arms(cfg).values():
        for source in sources(arm):
            policy = make_prior(arm, task).policy()
            returns = evaluate(env, policy, episodes=cfg.evaluation.episodes, seed=cfg.seed * 1_000_003).returns
            mean, std = returns.mean().item(), returns.std(correction=0).item()
            played[source.name] = {"mean_return": mean, "std_return": std, "episodes": len(returns)}
    folder.write(FILE, json.dumps({"teachers": played}, indent=1))


def keep_worth(cfg: MujocoConfig, folder: RunFolder, last: dict[str, Any], results: Sequence[TrialResult]) -> None:
    """Add to ``teacher.json`` what became of the students: ``last`` is the last evaluation of the run's policy."""
    if cfg.method == "none":
        return
    kept: dict[str, Any] = {"teachers": read_json(folder.path / FILE)["teachers"], "students": {}}
    if cfg.method == "trial" and results:
        first = results[0]
        kept["students"] = {
            arm: {"recent_return": first.returns[arm], "frames": first.frames[arm]} for arm in first.returns
        }
    policy = {name: last[name] for name in ("mean_return", "std_return", "episodes", "frames")}
    kept |= {"policy": policy, "decision": _decision(cfg, results)}
    folder.write(FILE, json.dumps(kept, indent=1))


def worth_of(folder: RunFolder) -> str:
    """The table in ``teacher.json``, for the console; empty where there is none."""
    if not (folder.path / FILE).exists():
        return ""
    kept = read_json(folder.path / FILE)
    rows = [
        (f"teacher {name}", _plus_minus(row), f"{row['episodes']} episodes of its own")
        for name, row in kept["teachers"].items()
    ]
    for arm, row in kept["students"].items():
        who = "student alone" if arm == ALONE else f"student taught by {arm}"
        rows.append((who, f"{row['recent_return']:.1f}", f"recent training episodes, at {row['frames']} frames"))
    policy = kept["policy"]
    rows.append(
        ("policy.safetensors", _plus_minus(policy), f"{policy['episodes']} episodes, at {policy['frames']} frames")
    )
    first, second = (max(len(row[column]) for row in rows) for column in (0, 1))
    lines = [f"  {who:{first}}  {value:>{second}}  {over}" for who, value, over in rows]
    return "\n".join(["Returns:", *lines, f"Decision: {kept['decision']}"])


def _plus_minus(row: dict[str, Any]) -> str:
    return f"{row['mean_return']:.1f} ± {row['std_return']:.1f}"


def _decision(cfg: MujocoConfig, results: Sequence[TrialResult]) -> str:
    """What the trials made of the teachers, in words."""
    said, last = [], ""
    for result in results:
        sure = f"confidence {min(result.confidence, 0.999):.1%}" if result.confidence else "in doubt"
        if result.winner == ALONE:
            said.append(f"the student went on alone ({sure})")
        elif result.winner.endswith(LET_GO):
            said.append(f"{result.winner.removesuffix(LET_GO)} was let go ({sure})")
        elif any(arm.endswith(LET_GO) for arm in result.frames):
            fell = last.endswith(LET_GO)
            said.append(f"{result.winner} came back (the other fell)" if fell else f"{result.winner} stayed ({sure})")
        else:
            said.append(f"the student went on with {result.winner} ({sure})")
        last = result.winner
    if said:
        return "; ".join(said) + "."
    return f"none was asked for: method={cfg.method} follows its teacher. method=trial finds out whether it helps."
