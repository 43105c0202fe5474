"""What a report may be configured with: names and types here, defaults in ``conf/report.yaml``."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

from hydra.core.config_store import ConfigStore
from omegaconf import MISSING

from recipes.common.checks import check_keys, one_of, positive, require

__all__ = ["Bootstrap", "ReportConfig", "check"]


@dataclass
class Bootstrap:
    """Confidence intervals."""

    confidence: float = MISSING
    reps: int = positive()
    seed: int = MISSING


@dataclass
class ReportConfig:
    """The whole configuration of ``python -m recipes.report``."""

    runs: Any = MISSING
    out: str = MISSING
    envs: list[str] = MISSING
    baseline: str = MISSING
    compare: list[str] = MISSING
    pairing: str = one_of("seed", "mean")
    change_from: float = MISSING
    bootstrap: Bootstrap = field(default_factory=Bootstrap)


ConfigStore.instance().store(group="schema", name="report", node=ReportConfig, package="_global_")


def check(cfg: ReportConfig) -> None:
    """Refuse what would fail or mean nothing later.

    Raises:
        ValueError: names the key, its value and what was expected.
    """
    check_keys(cfg)
    confidence = cfg.bootstrap.confidence
    require(0 <= cfg.change_from < 1, "change_from", cfg.change_from, "a number in [0, 1)")
    require(0 < confidence < 1, "bootstrap.confidence", confidence, "a number in (0, 1)")
