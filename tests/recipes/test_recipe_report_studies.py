"""The report of gridworld studies, beside each other and beside runs of MuJoCo."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from report_cases import ROOT, config, spoil, write_run

from recipes.report.page import report

GRIDWORLD = ROOT / "results" / "gridworld" / "original"


def write_study(folder: Path) -> Path:
    """The tables of a finished study."""
    folder.mkdir(parents=True)
    for name in ("config.yaml", "area_ratio.csv", "curves.csv"):
        (folder / name).write_bytes((GRIDWORLD / name).read_bytes())
    return folder


def test_a_gridworld_study_is_rendered_from_its_tables(tmp_path: Path) -> None:
    page = report(config(f"runs={GRIDWORLD}", f"out={tmp_path}"))
    ratios = pd.read_csv(GRIDWORLD / "area_ratio.csv").set_index(["prior", "method"])
    cell = f"{1000 * ratios.loc[('structural_10', 'ae2r'), 'iqm']:.0f} ("
    (line,) = [line for line in page.read_text().splitlines() if line.startswith("| Structural, 10") and "[" in line]
    assert cell in line
    assert {"iqm.png", "learning_curves.png"} <= {file.name for file in tmp_path.iterdir()}


def test_a_gridworld_table_with_a_hole_is_refused_by_name(tmp_path: Path) -> None:
    folder = write_study(tmp_path / "study")
    spoil(folder, "curves.csv", 5, "mean", np.nan)
    with pytest.raises(ValueError, match=r"curves\.csv.*mean"):
        report(config(f"runs={folder}", f"out={tmp_path / 'out'}"))


@pytest.mark.usefixtures("without_pictures")
def test_studies_and_runs_together_get_a_page_each_and_an_index(tmp_path: Path) -> None:
    write_run(tmp_path / "runs" / "a")
    index = report(config(f"runs=[{tmp_path / 'runs'},{GRIDWORLD}]", f"out={tmp_path / 'out'}")).read_text()
    assert "original/report.md" in index
    assert "(report.md)" in index


@pytest.mark.usefixtures("without_pictures")
def test_studies_of_one_name_are_told_apart_by_their_folders(tmp_path: Path) -> None:
    for name in ("a/study", "b/study"):
        write_study(tmp_path / name)
    index = report(config(f"runs={tmp_path}", f"out={tmp_path / 'out'}"))
    for name in ("a/study", "b/study"):
        assert f"- [{name}]({name}/report.md)" in index.read_text()
        assert str(tmp_path / name) in (index.parent / name / "report.md").read_text()


@pytest.mark.usefixtures("without_pictures")
@pytest.mark.parametrize(
    ("file", "content"),
    [("area_ratio.csv", None), ("curves.csv", b"\xff"), ("config.yaml", b"worlds: \xff"), ("config.yaml", b"a: [")],
)
def test_an_unusable_study_is_named_and_the_others_are_reported(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], file: str, content: bytes | None
) -> None:
    write_study(tmp_path / "runs" / "whole")
    write_run(tmp_path / "runs" / "run")
    broken = write_study(tmp_path / "runs" / "broken")
    (broken / file).unlink() if content is None else (broken / file).write_bytes(content)
    index = report(config(f"runs={tmp_path / 'runs'}", f"out={tmp_path / 'out'}"))
    assert index.name == "README.md"
    for told in (index.read_text(), (index.parent / "report.md").read_text(), capsys.readouterr().err):
        assert str(broken) in told
        assert file in told
    assert (index.parent / "whole" / "report.md").exists()
    assert not (index.parent / "broken").exists()


def test_a_file_that_is_no_text_is_named(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (write_run(tmp_path / "run") / "config.yaml").write_bytes(b"env: \xff")
    with pytest.raises(ValueError, match="none of the 1 runs"):
        report(config(f"runs={tmp_path}", f"out={tmp_path / 'out'}"))
    assert "config.yaml cannot be used" in capsys.readouterr().err
