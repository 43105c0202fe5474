"""How coefficients change over training: names and types here, defaults in the YAML of the recipe that has them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from omegaconf import MISSING

from recipes.common.checks import at_least_0, one_of, require
from torchrl_priors.methods import get_method
from torchrl_priors.schedules import CosineSchedule, LinearSchedule, PiecewiseSchedule, Schedule

__all__ = ["ScheduleConfig", "applies", "check_schedule", "make_schedule", "without_idle"]


@dataclass
class ScheduleConfig:
    """A factor on the coefficients of bonus and auxiliary loss."""

    methods: str = one_of("annealed", "all")
    shape: str = one_of("linear", "cosine", "piecewise")
    until: float = MISSING
    end: float = at_least_0()
    points: Any = MISSING


def applies(cfg: ScheduleConfig, method: str) -> bool:
    """Whether the schedule is one of this method's coefficients."""
    return method != "none" and (cfg.methods == "all" or get_method(method).annealed)


def without_idle(config: dict[str, Any], cfg: ScheduleConfig, methods: Sequence[str]) -> dict[str, Any]:
    """A configuration without its schedule if no method has one: results do not depend on it then."""
    used = any(applies(cfg, method) for method in methods)
    return {key: value for key, value in config.items() if used or key != "schedule"}


def make_schedule(cfg: ScheduleConfig, frames: int, value: float = 1.0) -> Schedule:
    """The schedule of a coefficient of this value in a run of so many frames."""
    if cfg.shape == "piecewise":
        return PiecewiseSchedule([(part * frames, factor * value) for part, factor in cfg.points])
    shape = {"linear": LinearSchedule, "cosine": CosineSchedule}[cfg.shape]
    return shape(value, cfg.end * value, cfg.until * frames)


def check_schedule(cfg: ScheduleConfig) -> None:
    """Refuse what would fail or mean nothing later, beyond what the schema says.

    Raises:
        ValueError: names the key, its value and what was expected.
    """
    require(0 < cfg.until <= 1, "schedule.until", cfg.until, "a share of the training in (0, 1]")
    if cfg.shape == "piecewise":
        try:
            points = [(float(part), float(factor)) for part, factor in cfg.points]
        except (TypeError, ValueError):
            points = []
        parts = [part for part, factor in points if 0 <= part <= 1 and 0 <= factor < float("inf")]
        if not points or len(parts) < len(points) or sorted(set(parts)) != parts:
            raise ValueError(
                f"schedule.points={cfg.points}: expected pairs [share of the training in [0, 1], factor of at least 0],"
                " at increasing shares."
            )
