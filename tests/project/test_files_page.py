"""``docs/guides/files.md`` explains every column and key that is written, and nothing else."""

from __future__ import annotations

import json
import re
from collections import defaultdict
from pathlib import Path

import pandas as pd
import pytest
from composed import composed
from mujoco_cases import run

from recipes.gridworld import study

ROOT = Path(__file__).parents[2]
PAGE = (ROOT / "docs/guides/files.md").read_text(encoding="utf-8")
GRIDWORLD, RUN, STUDY, REPORT, PAPER = (
    "A gridworld study",
    "A MuJoCo run",
    "A study of MuJoCo runs",
    "A report",
    "The paper's numbers",
)
STUDIES = "|".join(sorted((file.stem for file in (ROOT / "conf/study_mujoco").glob("*.yaml")), reverse=True))
SMALL = "worlds=2 teacher.steps=200 teacher.eval_episodes=1 evaluation.points=3 evaluation.interval=20"


def rows(text: str) -> set[str]:
    """The names in the first column of the tables of columns and keys."""
    tables = re.findall(r"^\| (?:column|key) \| meaning \|\n\|[-|]+\|\n((?:\|.*\n?)+)", text, flags=re.MULTILINE)
    cells = [line.split("|")[1] for table in tables for line in table.strip().splitlines()]
    return {name for cell in cells for name in re.findall(r"`([\w.]+)`", cell)}


def explained() -> dict[tuple[str, str], tuple[set[str], set[str]]]:
    """Names explained for a file of a section, and those explained for all files of the section."""
    found = {}
    for section in re.split(r"^## ", PAGE, flags=re.MULTILINE)[1:]:
        title = section.splitlines()[0]
        shared, *files = re.split(r"^### ", section, flags=re.MULTILINE)
        for file in files:
            found[title, file.splitlines()[0].strip("`")] = (rows(file), rows(shared))
    return found


def columns(section: str, folder: Path, rename: str | None = None) -> dict[tuple[str, str], set[str]]:
    """The columns of the tables in a folder, by section and the file's name on the page."""
    found: dict[tuple[str, str], set[str]] = defaultdict(set)
    for file in folder.glob("*.csv"):
        name = file.name if rename is None else re.sub(rename, "<name>", file.name)
        found[section, name] |= set(pd.read_csv(file).columns)
    return found


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory) -> dict[tuple[str, str], set[str]]:
    """The columns and keys of what is committed, and of tiny runs."""
    folder = tmp_path_factory.mktemp("files")
    teacher = f"prior.path={run(folder / 'none', 'method=none') / 'policy.safetensors'}"
    run(folder / "ae2r", "method=ae2r", teacher, "schedule.methods=all")
    run(folder / "trial", "method=trial", teacher, "trial.max_frames=64", "trial.min_frames=64")
    with pytest.raises(SystemExit):
        run(folder / "failed", "method=none", "ppo.lr=1e30")
    cfg = composed("gridworld", "study=small", *SMALL.split(), "bootstrap.reps=20", f"out={folder / 'gridworld'}")
    gridworld = study.open_folder(cfg)
    with pytest.MonkeyPatch.context() as patch:  # of figures there are no columns
        patch.setattr("recipes.plots.style._pictures", lambda figure, formats, dpi: [b"not drawn"] * len(formats))
        study.report(cfg, gridworld, study.run_study(cfg, gridworld))
    gridworld.release()

    found: dict[tuple[str, str], set[str]] = defaultdict(set)
    tables = [columns(RUN, folder / name) for name in ("none", "ae2r", "trial")]
    tables += [columns(GRIDWORLD, folder / "gridworld")]
    tables += [columns(GRIDWORLD, path) for path in (ROOT / "results/gridworld").iterdir() if path.is_dir()]
    tables += [columns(STUDY, ROOT / "results/mujoco", rename=rf"^({STUDIES})(?=[_.])")]
    tables += [columns(REPORT, path) for path in (ROOT / "results/mujoco").iterdir() if path.is_dir()]
    tables += [columns(PAPER, ROOT / "recipes" / name) for name in ("gridworld", "report")]
    for table in tables:
        for key, names in table.items():
            found[key] |= names
    for name in ("none", "trial", "failed"):
        found[RUN, "status.json"] |= set(json.loads((folder / name / "status.json").read_text()))
    kept = json.loads((folder / "trial/teacher.json").read_text())
    parts = [*kept["teachers"].values(), *kept["students"].values(), kept["policy"]]
    found[RUN, "teacher.json"] = set(kept).union(*parts)
    for trial in json.loads((folder / "trial/trials.json").read_text()):
        found[RUN, "trials.json"] |= set(trial)
    return found


def test_the_page_of_files_has_every_file(written: dict[tuple[str, str], set[str]]) -> None:
    assert set(written) == set(explained())


@pytest.mark.parametrize("file", explained(), ids=" ".join)
def test_the_page_has_every_column(file: tuple[str, str], written: dict[tuple[str, str], set[str]]) -> None:
    own, shared = explained()[file]
    assert written[file] - own - shared == set(), "not explained"
    assert own - written[file] == set(), "never written"


def test_shared_columns_are_written_somewhere(written: dict[tuple[str, str], set[str]]) -> None:
    for (section, _), (_, shared) in explained().items():
        names = set().union(*(columns for (other, _), columns in written.items() if other == section))
        assert shared <= names, section
