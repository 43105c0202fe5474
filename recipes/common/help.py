"""What ``--help`` of a recipe says: what it does, what its keys mean, and what there is to choose from."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from omegaconf import OmegaConf

from torchrl_priors.methods import METHODS

__all__ = ["help_text"]

_CONF = Path(__file__).parents[2] / "conf"
_REQUIRED = re.compile(r"^# (\w+): ", re.MULTILINE)  # how a file describes a key that has no default


def help_text(name: str) -> str:
    """The help of the recipe ``conf/<name>.yaml``: its own lines, with their comments, and its groups.

    Examples:
        >>> print(help_text("report").splitlines()[0])
        Tables, figures and a report in Markdown from finished runs.
    """
    file = _CONF / f"{name}.yaml"
    config: Any = OmegaConf.to_container(OmegaConf.load(file), resolve=False)
    _, _, body = file.read_text().partition("\n\n")  # after the list of defaults
    keys = _REQUIRED.sub(r"\1: ???  # ", body.partition("\nhydra:")[0].strip())
    parts = [
        config["hydra"]["help"]["header"],
        f"Keys of conf/{name}.yaml, with what is given (??? is to be given):",
        keys,
    ]
    for entry in config["defaults"]:
        if isinstance(entry, dict):
            for group, chosen in entry.items():
                parts += _group(group, chosen)
    if re.search(r"^ *methods?:", keys, re.MULTILINE) or name == "gridworld":
        parts.append(f"Methods: {', '.join(METHODS)}")
    return "\n\n".join(parts)


def _group(group: str, chosen: str) -> Iterator[str]:
    """The files to choose from, and the keys of the one that is chosen without a word."""
    if group.startswith("override "):
        return
    files = sorted((_CONF / group).glob("*.yaml"))
    choices = [f"  {group}={file.stem}{_says(file)}" for file in files]
    yield "\n".join([f"One of ({chosen} if none is given):" if chosen != "???" else "One of:", *choices])
    if chosen != "???":
        lines = (_CONF / group / f"{chosen}.yaml").read_text().splitlines()
        keys = [f"  {line}" for line in lines if not line.startswith("#")]
        yield "\n".join([f"Keys of conf/{group}/{chosen}.yaml, as it gives them:", *keys])


def _says(file: Path) -> str:
    """What the first line of a file says of it."""
    comments = [line[2:] for line in file.read_text().splitlines() if re.match(r"# (?!@)", line)]
    return f"  {comments[0]}" if comments else ""
