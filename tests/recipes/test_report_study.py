"""A report from the tables of a study: the same numbers as from the runs, without their folders."""

from __future__ import annotations

import shlex
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from matplotlib.figure import Figure

pytest.importorskip("hydra")
from hydra import compose, initialize_config_dir

from recipes.report import figures
from recipes.report.page import report

ROOT = Path(__file__).parents[2]
pytestmark = pytest.mark.usefixtures("without_pictures")


def config(runs: Path, out: Path) -> Any:
    with initialize_config_dir(str(ROOT / "conf"), version_base="1.3"):
        return compose("report", overrides=[f"runs={runs}", f"out={out}", "bootstrap.reps=20"])


@pytest.fixture
def tables(tmp_path) -> Path:
    """Two environments, a good teacher, three seeds; the return of a method is easy to see."""
    rows, means = [], []
    for env in ("hopper", "ant"):
        for teacher, method, level in (
            ("none", "none", 100.0),
            ("good", "e2r", 300.0),
            ("good", "ae2r slow", 200.0),
            ("good", "trial", 250.0),
        ):
            for seed in range(3):
                key = (env, teacher, method, seed)
                rows += [(*key, frames, level * frames / 2 + seed) for frames in (0, 1, 2)]
                rollouts = 5 if method == "trial" else 9
                means += [
                    (*key, "entropy", level + seed, 4.0, rollouts),
                    (*key, "loss_objective", -level, 0.0, rollouts),
                ]
    names = ["env", "teacher", "method", "seed"]
    path = tmp_path / "deep.csv"
    pd.DataFrame(rows, columns=[*names, "frames", "return"]).to_csv(path, index=False)
    pd.DataFrame(means, columns=[*names, "metric", "mean", "std", "rollouts"]).to_csv(
        tmp_path / "deep_training.csv", index=False
    )
    return path


def test_returns_and_differences_come_from_the_tables(tables, tmp_path):
    report(config(tables, tmp_path / "out"))
    returns = pd.read_csv(tmp_path / "out/returns.csv", keep_default_na=False).set_index(["env", "method"])
    assert returns.loc[("Hopper-v5", "e2r"), ["runs", "frames", "final_iqm", "prior"]].tolist() == [
        3,
        2,
        301,
        "good teacher",
    ]
    assert set(returns.index.get_level_values("method")) == {"none", "e2r", "ae2r slow", "trial"}
    dynamics = pd.read_csv(tmp_path / "out/dynamics.csv").set_index(["env", "method", "metric"])
    assert dynamics.loc[("Ant-v5", "e2r", "entropy"), "difference"] == 200
    assert dynamics.loc[("Ant-v5", "ae2r slow", "loss_objective"), "mean"] == -200
    assert dynamics.loc[("Ant-v5", "e2r", "entropy"), "std"] == pytest.approx((4**2 + 2 / 3) ** 0.5)  # within, between
    assert dynamics["difference_std"].isna().all()
    assert dynamics.loc[("Ant-v5", "trial", "entropy"), "mean"] == 251
    assert np.isnan(dynamics.loc[("Ant-v5", "trial", "entropy"), "difference"])  # of other rollouts than the baseline's


def test_changes_of_returns_and_shares_of_runs_are_counted(tables, tmp_path):
    rows = pd.read_csv(tables, keep_default_na=False)
    falls = (rows["method"] == "e2r") & (rows["seed"] == 0) & (rows["env"] == "ant")
    rows.loc[falls & (rows["frames"] == 2), "return"] = 140.0  # it had 150 at frame 1, as the baseline has 50
    rows.loc[(rows["method"] == "ae2r slow") & (rows["seed"] == 1), "return"] -= 500
    rows.to_csv(tables, index=False)
    page = report(config(tables, tmp_path / "out")).read_text()
    returns = pd.read_csv(tmp_path / "out/returns.csv").set_index(["env", "method"])
    assert returns.loc[("Hopper-v5", "none"), "change_mean"] == 50  # from frame 1 of 2 on
    assert returns.loc[("Ant-v5", "e2r"), "change_mean"] == pytest.approx((-10 + 150 + 150) / 3)
    shares = pd.read_csv(tmp_path / "out/shares.csv").set_index(["what", "env", "method"])
    assert shares.loc[("lower_at_the_end", "all", "e2r"), ["runs", "count"]].tolist() == [6, 1]
    assert shares.loc[("below_baseline", "Ant-v5", "ae2r slow"), ["runs", "count"]].tolist() == [3, 1]
    assert shares.loc[("below_baseline", "all", "ae2r slow"), "share"] == pytest.approx(1 / 3)
    assert ("below_baseline", "all", "none") not in shares.index
    assert "| **all** | good teacher | 0.00 (0.00, 0.39), 0 of 6 | 0.33 (0.10, 0.70), 2 of 6 |" in page


def test_the_change_of_a_return_is_counted_from_where_it_is_asked(tables, tmp_path):
    cfg = config(tables, tmp_path / "out")
    cfg.change_from = 0.0
    report(cfg)
    returns = pd.read_csv(tmp_path / "out/returns.csv").set_index(["env", "method"])
    assert returns.loc[("Hopper-v5", "e2r"), "change_mean"] == 300
    cfg.change_from = 0.9  # of two points only the last is left
    report(cfg)
    assert pd.read_csv(tmp_path / "out/returns.csv")["change_mean"].isna().all()
    assert set(pd.read_csv(tmp_path / "out/shares.csv")["what"]) == {"below_baseline"}
    cfg.change_from = 1.0
    with pytest.raises(ValueError, match=r"change_from=1.0: expected a number in \[0, 1\)"):
        report(cfg)


def test_the_command_of_a_report_makes_it_again(tables, tmp_path):
    tables.write_text(tables.read_text().replace("ae2r slow", "ae2r Cω=1"))
    cfg = config(tables, tmp_path / "out")
    cfg.out = str(tmp_path / "an 'out', of x=1")
    cfg.change_from, cfg.compare, cfg.envs = 0.0, ["ae2r Cω=1", "none"], ["Hopper-v5"]
    (line,) = (line for line in report(cfg).read_text().splitlines() if line.startswith("python"))
    words = shlex.split(line)
    assert words[:3] == ["python", "-m", "recipes.report"]
    with initialize_config_dir(str(ROOT / "conf"), version_base="1.3"):
        assert compose("report", overrides=words[3:]) == cfg


def test_one_environment_is_not_all_of_them(tables, tmp_path):
    rows = pd.read_csv(tables, keep_default_na=False)
    rows[(rows["env"] == "hopper") | (rows["method"] == "none")].to_csv(tables, index=False)
    report(config(tables, tmp_path / "out"))
    ratios = pd.read_csv(tmp_path / "out/area_ratio.csv")
    assert set(ratios["env"]) == {"Hopper-v5"}


def test_there_is_no_interval_of_three_runs(tables, tmp_path):
    page = report(config(tables, tmp_path / "out")).read_text()
    returns = pd.read_csv(tmp_path / "out/returns.csv")
    assert returns[["final_ci_low", "final_ci_high"]].isna().all(axis=None)
    assert "| Hopper-v5 | good teacher | - | 301 |" in page


def test_the_teachers_return_is_a_line_where_a_table_tells_it(tables, tmp_path, monkeypatch):
    pd.DataFrame({"env": ["hopper"], "teacher": ["good"], "return": [333.0]}).to_csv(
        tables.with_name("deep_teachers.csv"), index=False
    )
    drawn = {}
    monkeypatch.setattr(figures, "curve_panels", lambda *args, **options: drawn.update(options) or Figure())
    report(config(tables, tmp_path / "out"))
    levels = drawn["references"]
    assert list(levels.values()) == [{"Teacher": 333.0}]
    assert next(iter(levels)).startswith("Hopper-v5")
    assert "n = 3" in next(iter(levels))


def test_the_report_of_a_study_is_the_same_every_time(tables, tmp_path):
    for name in ("first", "second"):
        report(config(tables, tmp_path / name))
    for file in (tmp_path / "first").glob("*.csv"):
        assert file.read_bytes() == (tmp_path / "second" / file.name).read_bytes()


def test_a_table_without_means_of_training_is_enough_for_returns(tables, tmp_path):
    tables.with_name("deep_training.csv").unlink()
    report(config(tables, tmp_path / "out"))
    assert (tmp_path / "out/returns.csv").exists()


def test_environments_can_be_chosen(tables, tmp_path):
    cfg = config(tables, tmp_path / "out")
    cfg.envs = ["Hopper-v5"]
    page = report(cfg).read_text()
    assert set(pd.read_csv(tmp_path / "out/returns.csv")["env"]) == {"Hopper-v5"}
    assert " 'envs=[Hopper-v5]' " in page
    cfg.envs = ["Hoper-v5"]
    with pytest.raises(ValueError, match=r"envs=.*there is no run in Hoper-v5, but in \['Ant-v5', 'Hopper-v5'\]"):
        report(cfg)


def test_settings_go_from_the_largest_to_the_smallest(tables, tmp_path):
    text = tables.read_text()
    tables.write_text(text.replace("e2r,", "ae2r x=0.3,").replace("ae2r slow,", "ae2r x=1,").replace("aae2r", "ae2r"))
    page = report(config(tables, tmp_path / "out")).read_text()
    assert "| env | prior | none | ae2r x=1 | ae2r x=0.3 | trial |" in page


def test_many_settings_of_a_method_have_a_figure_of_their_own(tables, tmp_path, monkeypatch):
    rows = pd.read_csv(tables, keep_default_na=False)
    slow = rows[rows["method"] == "ae2r slow"]
    names = ["ae2r slow", "ae2r x=1", "ae2r x=0.3"]
    pd.concat([rows, *(slow.assign(method=name) for name in names[1:])]).to_csv(tables, index=False)
    drawn = []
    monkeypatch.setattr(figures, "curve_panels", lambda panels, *args, **options: drawn.append(panels) or Figure())
    page = report(config(tables, tmp_path / "out")).read_text()
    whole, settings = ({name for panel in panels.values() for name in panel} for panels in drawn)
    assert whole == {"none", "e2r", "ae2r slow", "trial"}
    assert settings == {"e2r", *names}
    assert "(return_curves_ae2r.png)" in page


def test_a_method_that_is_unknown_is_left_out_by_name(tables, tmp_path, capsys):
    tables.write_text(tables.read_text().replace("ae2r slow", "magic"))
    report(config(tables, tmp_path / "out"))
    assert "there is no method 'magic'" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (lambda text: text.replace("return", "reward", 1), "it has no column return"),
        (lambda text: text.replace("300.0", "many"), "values of return are no numbers"),
        (lambda text: "", "is damaged"),
    ],
)
def test_a_damaged_table_is_named(damage, message, tables, tmp_path):
    tables.write_text(damage(tables.read_text()))
    with pytest.raises(ValueError, match=message) as error:
        report(config(tables, tmp_path / "out"))
    assert "deep.csv" in str(error.value)
