"""Folders of runs as ``recipes.mujoco`` leaves them, made up in no time."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from hydra import compose, initialize_config_dir
from omegaconf import OmegaConf

import recipes.report.config  # noqa: F401 (stores the schema)
from torchrl_priors.methods import get_method

ROOT = Path(__file__).parents[2]
POINTS = np.arange(1, 21) * 50_000
#: Return that a method ends with under a good and a bad prior, as a share of the environment's scale.
LEVEL = {"none": (0.55, 0.55), "e2r": (0.95, 0.1), "ae2r": (0.75, 0.4), "kickstart": (0.9, 0.15), "aligned": (0.9, 0.5)}
SCALE = {"HalfCheetah": 2600.0, "Hopper": 2400.0, "Walker2d": 2300.0, "Ant": 1500.0}


def config(*overrides: str) -> Any:
    """The configuration of a report, as the command line makes it."""
    with initialize_config_dir(str(ROOT / "conf"), version_base="1.3"):
        return compose("report", ["bootstrap.reps=50", *overrides])


def spoil(run: Path, file: str, row: int, column: str, value: float) -> None:
    """Change one number of a table."""
    frame = pd.read_csv(run / file)
    frame.loc[row, column] = value
    frame.to_csv(run / file, index=False)


def write_run(
    folder: Path,
    env: str = "Hopper",
    method: str = "none",
    prior: str = "good",
    seed: int = 0,
    *,
    config: dict[str, Any] | None = None,
    status: dict[str, Any] | None = None,
    points: np.ndarray = POINTS,
) -> Path:
    """A finished run, whose numbers depend on its environment, method, prior and seed."""
    folder.mkdir(parents=True)
    rng = np.random.default_rng([seed, *map(ord, env + method + prior)])
    spec = get_method(method)
    settings: dict[str, Any] = {
        "env": {"id": env, "version": "v5", "kwargs": {}},
        "method": method,
        "seed": seed,
        "weight": {"lr_coeff": 1.0, "init_bias": 0.0},
        "td_error": "original",
        "out": str(folder),
        "prior": {
            "path": None if method == "none" else f"teachers/{env}.safetensors",
            "degrade": "structural" if prior == "bad" else "none",
            "feature": 1,
            "prob": 0.5,
        },
    }
    settings |= config or {}
    (folder / "config.yaml").write_text(OmegaConf.to_yaml(settings))
    finished = {"state": "finished", "frames": int(points[-1]), "error": None}
    (folder / "status.json").write_text(json.dumps(status or finished))

    level = LEVEL[method][prior == "bad"] * SCALE[env]
    if spec.adaptive:
        level *= 1 + 0.2 * (1 - settings["weight"]["lr_coeff"]) * (-1 if prior == "bad" else 1)
    progress = points / points[-1]
    returns = level * (1 - np.exp(-4 * progress)) * rng.normal(1, 0.08) + rng.normal(0, 0.03 * SCALE[env], len(points))
    evaluations = pd.DataFrame({"frames": points, "mean_return": returns, "std_return": 50.0})
    evaluations = evaluations.assign(min_return=returns - 100, max_return=returns + 100, mean_length=900, episodes=50)
    evaluations.to_csv(folder / "eval.csv", index=False)

    frames = np.arange(1, 101) * (points[-1] // 100)
    done = frames / frames[-1]
    metrics = pd.DataFrame({"frames": frames, "loss_objective": rng.normal(-0.02, 0.01, 100)})
    metrics["entropy"] = 4 - (6 if spec.auxiliary else 3) * done + rng.normal(0, 0.2, 100)
    metrics["loss_critic"] = rng.uniform(0.1, 1, 100)
    metrics["episode_return"] = np.where(rng.uniform(size=100) < 0.2, np.nan, 1.0)  # none ended in this rollout
    metrics["prior_kl"] = np.nan  # off
    if spec.auxiliary:
        metrics["loss_prior"] = 2 * np.exp(-3 * done) + rng.uniform(0, 0.1, 100)
    if spec.adaptive:
        weight = 0.5 * np.exp(-done * settings["weight"]["lr_coeff"])
        metrics = metrics.assign(prior_weight=weight, prior_weight_q05=0.5 * weight, prior_weight_q50=weight)
        metrics["prior_weight_q95"] = 0.5 + 0.5 * weight
    metrics.to_csv(folder / "metrics.csv", index=False)
    return folder


def write_study(root: Path, envs: tuple[str, ...] = ("HalfCheetah", "Hopper"), seeds: int = 3) -> Path:
    """Every method on every environment, with a good and a bad prior; AE2R in two variants."""
    variants = [(method, 1.0) for method in LEVEL] + [("ae2r", 0.03)]
    for env in envs:
        for method, coeff in variants:
            for prior in ("good",) if method == "none" else ("good", "bad"):
                for seed in range(seeds):
                    name = f"{env}-{method}-{coeff}-{prior}-{seed}"
                    label = method if coeff == 1 else f"{method} Cω={coeff}"
                    settings = {"weight": {"lr_coeff": coeff}, "label": label}
                    write_run(root / name, env, method, prior, seed, config=settings)
    return root
