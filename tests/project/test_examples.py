"""Every example runs by the command that it names, with few frames."""

from __future__ import annotations

import math
import re
import runpy
import sys
from pathlib import Path

import pytest

EXAMPLES = Path(__file__).parents[2] / "examples"
PARTS = {"catch.py"}  # imported by another
SCRIPTS = sorted(path.name for path in EXAMPLES.glob("*.py") if path.name not in PARTS)
ONE_WORKER = {"ray_collector.py": ["--workers=1"]}  # a process is seconds of imports
FRAMES = {"a2c.py": 10_240, "ppo.py": 3200, "pixels.py": 1536, "trial.py": 10_240, "from_yaml.py": 2048}


def run(name: str, monkeypatch: pytest.MonkeyPatch, *arguments: str) -> None:
    monkeypatch.syspath_prepend(str(EXAMPLES))
    monkeypatch.setattr(sys, "argv", [str(EXAMPLES / name), *arguments])
    runpy.run_path(str(EXAMPLES / name), run_name="__main__")


@pytest.mark.filterwarnings("ignore::UserWarning", "ignore::FutureWarning")  # the trainers are experimental
@pytest.mark.parametrize("name", SCRIPTS)
def test_example_runs_and_prints_returns(name: str, monkeypatch: pytest.MonkeyPatch, capsys, tmp_path: Path) -> None:
    pytest.importorskip("gymnasium")
    if name == "ray_collector.py":
        pytest.importorskip("ray")
    monkeypatch.chdir(tmp_path)
    option = "frames=" if name == "from_yaml.py" else "--frames="
    run(name, monkeypatch, f"{option}{FRAMES.get(name, 2048)}", *ONE_WORKER.get(name, []))
    lines = [line for line in capsys.readouterr().out.splitlines() if " frames, " in line]
    assert lines
    assert all(math.isfinite(float(re.search(r"(?:return|caught) +(-?[\d.]+|nan)", line)[1])) for line in lines)
    assert list(tmp_path.iterdir()) == []  # an example leaves nothing behind


@pytest.mark.parametrize("name", SCRIPTS)
def test_example_is_short_and_names_its_command(name: str) -> None:
    text = (EXAMPLES / name).read_text(encoding="utf-8")
    assert len(text.splitlines()) < 100
    assert f"    python examples/{name}\n" in text
    assert f"examples/{name}" in (EXAMPLES / "README.md").read_text(encoding="utf-8")


def test_the_example_of_a_trial_says_which_bot_won(monkeypatch: pytest.MonkeyPatch, capsys) -> None:
    pytest.importorskip("gymnasium")
    run("trial.py", monkeypatch, "--frames=10240")
    first = capsys.readouterr().out.splitlines()[0]
    assert re.match(
        r"(alone|good bot|weak bot) wins by .* after 8192 frames: alone .*, good bot .*, weak bot .*, bad bot", first
    )
