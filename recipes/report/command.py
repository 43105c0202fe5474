"""The command line that makes a report again."""

from __future__ import annotations

import re
import shlex
from pathlib import Path
from typing import Any

from omegaconf import OmegaConf

from recipes.common.run_folder import flatten
from recipes.report.config import ReportConfig

__all__ = ["command"]

_DEFAULTS = Path(__file__).parents[2] / "conf" / "report.yaml"
_PLAIN = re.compile(r"[A-Za-z0-9_/+.%*@?|:-]+")  # what Hydra reads without quotes


def command(cfg: ReportConfig) -> str:
    """The command with what it was told, and every setting that is not at its default."""
    given: Any = OmegaConf.to_container(cfg, resolve=True)
    defaults: Any = OmegaConf.to_container(OmegaConf.load(_DEFAULTS))
    runs, out, known = given.pop("runs"), given.pop("out"), flatten(defaults)
    changed = {name: value for name, value in flatten(given).items() if value != known[name]}
    words = [f"{name}={_argument(value)}" for name, value in {"runs": runs, **changed, "out": out}.items()]
    return shlex.join(["python", "-m", "recipes.report", *words])


def _argument(value: Any) -> str:
    """A value as Hydra reads it."""
    if isinstance(value, list):
        return f"[{','.join(map(_argument, value))}]"
    text = str(value)
    return text if _PLAIN.fullmatch(text) else '"' + text.replace('"', '\\"') + '"'
