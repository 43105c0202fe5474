"""The bounds of pyproject.toml are those that were tested."""

from __future__ import annotations

import re
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]


def pins(name: str) -> dict[str, str]:
    lines = (ROOT / name).read_text(encoding="utf-8").splitlines()
    return dict(re.match(r"([\w-]+)==([^;\s]+)", line).groups() for line in lines if line and line[0] != "#")  # type: ignore[union-attr, misc]


def lower_bounds() -> dict[str, str]:
    """Of what a user, a test or the documentation needs; the tools of developers are free to be any."""
    if sys.version_info < (3, 11):
        pytest.skip("needs tomllib")
    import tomllib

    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    extras = project["optional-dependencies"]
    needed = [
        *project["dependencies"],
        *(
            line
            for name in ("artifacts", "box2d", "recipes", "mujoco", "sweeps", "test", "docs")
            for line in extras[name]
        ),
    ]
    found = (re.match(r"([\w-]+)(?:\[\w+\])?>=([\w.]+)", line) for line in needed)
    return dict(match.groups() for match in found if match)  # type: ignore[misc]


def release(version: str) -> list[int]:
    numbers = [int(number) for number in version.split(".")]
    return numbers + [0] * (3 - len(numbers))


def test_the_lower_bounds_are_the_oldest_versions_tested() -> None:
    oldest = pins("constraints-min.txt")
    assert {name: release(version) for name, version in lower_bounds().items()} == {
        name: release(version) for name, version in oldest.items()
    }


def test_the_newest_versions_tested_are_not_older() -> None:
    newest = pins("constraints.txt")
    assert [
        name for name, version in pins("constraints-min.txt").items() if release(newest[name]) < release(version)
    ] == []
