"""The report of finished runs, on folders made up by ``report_cases``."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from report_cases import POINTS, config, spoil, write_run, write_study

from recipes.metrics import iqm
from recipes.report.__main__ import main
from recipes.report.markdown import number, table
from recipes.report.page import report
from recipes.report.runs import find, name_priors, read, without_misfits
from recipes.report.tables import ALL, Study, dynamics_table, improvement_table, ratio_table, return_table


def study_of(root: Path, *overrides: str) -> Study:
    cfg = config(f"runs={root}", *overrides)
    runs, left_out = read(find(str(root)))
    assert not left_out
    name_priors(runs)
    usable, misfits = without_misfits(runs)
    assert not misfits
    return Study(usable, cfg)


def left_out_of(root: Path) -> dict[str, str]:
    runs, left_out = read(find(str(root)))
    name_priors(runs)
    return {entry.path.name: entry.reason for entry in left_out + without_misfits(runs)[1]}


def test_a_report_has_every_table_and_figure_and_names_what_it_left_out(tmp_path: Path) -> None:
    root = write_study(tmp_path / "runs", seeds=2)
    write_run(root / "dead", status={"state": "failed", "frames": 5, "error": "NaN in loss_objective"}, seed=7)
    page = report(config(f"runs={root}", f"out={tmp_path / 'out'}"))
    text, written = page.read_text(), {file.name for file in page.parent.iterdir()}
    tables = {"returns", "area_ratio", "improvement", "dynamics", "shares", "curves", "left_out"}
    pictures = {"return_curves", "area_ratios", "performance_profiles", "training_prior_weight"}
    pictures |= {"training_loss_objective", "training_entropy", "training_loss_prior"}
    pictures |= {"improvement_over_none", "improvement_over_e2r"}
    expected = {f"{name}.csv" for name in tables}
    expected |= {f"{name}.{suffix}" for name in pictures for suffix in ("pdf", "png")}
    assert written == expected | {"report.md"}
    assert all(f"({name}.png)" in text for name in pictures)
    assert "dead" in text
    assert "NaN in loss_objective" in text
    assert pd.read_csv(page.parent / "left_out.csv")["reason"].tolist() == ["it failed: NaN in loss_objective"]


def test_a_report_is_the_same_every_time(tmp_path: Path) -> None:
    root = tmp_path / "runs"
    for method in ("none", "e2r", "ae2r"):
        for seed in range(2):
            write_run(root / f"{method}{seed}", method=method, seed=seed)
    out = report(config(f"runs={root}", f"out={tmp_path / 'out'}")).parent
    before = {file.name: file.read_bytes() for file in out.iterdir()}
    report(config(f"runs={root}", f"out={out}"))
    assert before == {file.name: file.read_bytes() for file in out.iterdir()}


def test_variants_of_a_method_are_told_apart_and_priors_named_by_their_degradation(tmp_path: Path) -> None:
    study = study_of(write_study(tmp_path, seeds=1))
    assert study.labels == ["none", "e2r", "ae2r", "ae2r Cω=0.03", "kickstart", "aligned"]
    assert study.priors == ["teacher", "degraded teacher (structural)"]
    assert study.envs == ["HalfCheetah-v5", "Hopper-v5"]


def test_settings_without_effect_on_a_method_do_not_split_it(tmp_path: Path) -> None:
    for seed, coeff in enumerate((1.0, 0.03)):
        for method in ("none", "e2r", "kickstart"):
            settings = {"weight": {"lr_coeff": coeff}, "td_error": ("original", "shaped")[seed]}
            write_run(tmp_path / f"{method}{seed}", method=method, seed=seed, config=settings)
    assert study_of(tmp_path).labels == ["none", "e2r", "kickstart"]


def test_runs_that_are_called_alike_but_differ_are_not_averaged(tmp_path: Path) -> None:
    for seed, coeff in enumerate((1.0, 1.0, 0.03)):
        write_run(tmp_path / str(seed), method="ae2r", seed=seed, config={"weight": {"lr_coeff": coeff}})
    reasons = left_out_of(tmp_path)
    assert reasons.keys() == {"2"}
    assert "weight.lr_coeff=0.03" in reasons["2"]
    assert "give it a label" in reasons["2"]


@pytest.mark.parametrize("what", ["env.minibatch_size", "prior.std", "prior.sha256"])
def test_runs_with_another_environment_or_teacher_are_not_averaged(what: str, tmp_path: Path) -> None:
    group, name = what.split(".")
    for seed, value in enumerate((64, 64, 2048)):
        settings = {
            "env": {"id": "Hopper", "version": "v5", "kwargs": {}},
            "prior": {"path": "teacher.safetensors", "degrade": "none"},
        }
        known = {"prior": {"sha256": value}} if name == "sha256" else {}
        settings[group] |= {} if known else {name: value}
        folder = write_run(tmp_path / str(seed), method="e2r", seed=seed, config=settings)
        (folder / "config.json").write_text(json.dumps(known))
    reasons = left_out_of(tmp_path)
    assert reasons.keys() == {"2"}
    assert f"{what}=2048" in reasons["2"]


def test_a_run_that_is_older_than_a_setting_is_like_the_others(tmp_path: Path) -> None:
    for seed, settings in enumerate([{}, {"schedule": {"methods": "annealed", "end": 0.5}}]):
        write_run(tmp_path / f"{seed}", method="e2r", seed=seed, config=settings)
    assert study_of(tmp_path).labels == ["e2r"]


def test_teachers_of_one_environment_are_told_apart_by_their_files(tmp_path: Path) -> None:
    for name in ("hopper-1", "hopper-2"):
        settings = {"prior": {"path": f"runs/{name}/policy.safetensors", "degrade": "none"}}
        write_run(tmp_path / name, method="e2r", config=settings)
    assert study_of(tmp_path).priors == ["teacher, hopper-1/policy", "teacher, hopper-2/policy"]


def test_environments_with_other_versions_or_arguments_are_other_environments(tmp_path: Path) -> None:
    write_run(tmp_path / "a", config={"env": {"id": "Hopper", "version": "v4", "kwargs": {}}})
    write_run(tmp_path / "b", config={"env": {"id": "Hopper", "version": "v5", "kwargs": {"ctrl_cost_weight": 0.001}}})
    assert study_of(tmp_path).envs == ["Hopper-v4", "Hopper-v5 (ctrl_cost_weight=0.001)"]


def test_area_ratios_are_those_of_the_same_seed(tmp_path: Path) -> None:
    for seed in range(4):
        for method in ("none", "e2r"):
            write_run(tmp_path / f"{method}{seed}", method=method, seed=seed)
    areas = {
        method: np.array(
            [pd.read_csv(tmp_path / f"{method}{seed}/eval.csv")["mean_return"].mean() for seed in range(4)]
        )
        for method in ("none", "e2r")
    }
    row = ratio_table(study_of(tmp_path)).set_index("env").loc["Hopper-v5"]
    assert row["iqm"] == pytest.approx(iqm((areas["e2r"] - areas["none"]) / areas["none"]))
    assert row["ci_low"] <= row["iqm"] <= row["ci_high"]
    mean = ratio_table(study_of(tmp_path, "pairing=mean")).set_index("env").loc["Hopper-v5"]
    assert mean["iqm"] == pytest.approx(iqm(areas["e2r"] / areas["none"].mean() - 1))


def test_a_gain_over_a_negative_baseline_is_a_positive_ratio_and_noted(tmp_path: Path) -> None:
    for method, value in (("none", -100.0), ("e2r", 50.0)):
        run = write_run(tmp_path / method, method=method)
        pd.DataFrame({"frames": POINTS, "mean_return": value}).to_csv(run / "eval.csv", index=False)
    study = study_of(tmp_path)
    row = ratio_table(study).set_index("env").loc["Hopper-v5"]
    assert row["iqm"] == pytest.approx(1.5)
    assert row["negative_baseline"]
    assert any("negative" in note for note in study.notes)


def test_aggregates_need_every_environment_and_say_who_is_missing(tmp_path: Path) -> None:
    for env in ("Hopper", "Ant"):
        for method in ("none", "e2r") if env == "Ant" else ("none", "e2r", "ae2r"):
            for seed in (0, 1) if env == "Ant" else (0, 1, 2):
                write_run(tmp_path / f"{env}{method}{seed}", env, method, seed=seed)
    study = study_of(tmp_path)
    table = ratio_table(study)
    total = table[table["env"] == ALL]
    assert total["method"].tolist() == ["e2r"]
    assert total["runs"].tolist() == [2]
    assert any("ae2r" in note and "Ant-v5" in note for note in study.notes)
    improvement = improvement_table(study)
    assert set(improvement[improvement["env"] == ALL]["method"]) == {"e2r"}


@pytest.mark.usefixtures("without_pictures")
def test_without_a_baseline_there_are_returns_but_no_ratios(tmp_path: Path) -> None:
    write_run(tmp_path / "runs" / "a", method="e2r")
    page = report(config(f"runs={tmp_path / 'runs'}", f"out={tmp_path / 'out'}")).read_text()
    assert "no run of the baseline 'none'" in page
    assert "## Returns" in page
    assert "## Area ratios" not in page


def test_differences_to_the_baseline_are_at_the_same_frames(tmp_path: Path) -> None:
    for method, offset in (("none", 0.0), ("e2r", -2.0)):
        for seed in range(2):
            run = write_run(tmp_path / f"{method}{seed}", method=method, seed=seed)
            metrics = pd.read_csv(run / "metrics.csv")
            metrics.assign(entropy=metrics["frames"] / 1e5 + offset + (seed - 0.5)).to_csv(
                run / "metrics.csv", index=False
            )
    rows = dynamics_table(study_of(tmp_path)).set_index(["method", "metric"])
    entropy = rows.loc["e2r", "entropy"]
    assert entropy["difference"] == pytest.approx(-2.0)
    assert entropy["difference_std"] == pytest.approx(0.5)  # of seeds: the trend of training is in both
    assert entropy["paper_mean"] == -6.7
    assert np.isnan(rows.loc[("none", "entropy"), "difference"])
    assert ("e2r", "prior_kl") not in rows.index  # off


def test_the_paper_is_not_quoted_beside_degraded_teachers(tmp_path: Path) -> None:
    write_run(tmp_path / "a", method="e2r", prior="bad")
    assert dynamics_table(study_of(tmp_path))["paper_mean"].isna().all()


def test_returns_are_those_of_the_last_evaluation(tmp_path: Path) -> None:
    last = [
        pd.read_csv(write_run(tmp_path / str(seed), seed=seed) / "eval.csv")["mean_return"].iloc[-1]
        for seed in range(5)
    ]
    (row,) = return_table(study_of(tmp_path)).itertuples()
    assert row.final_iqm == pytest.approx(iqm(last))
    assert row.final_std == pytest.approx(np.std(last, ddof=1))
    assert row.runs == 5


@pytest.mark.parametrize(
    ("file", "column", "value"),
    [
        ("eval.csv", "mean_return", np.nan),
        ("eval.csv", "mean_return", np.inf),
        ("eval.csv", "frames", np.nan),
        ("metrics.csv", "loss_prior", np.nan),
        ("metrics.csv", "entropy", -np.inf),
        ("metrics.csv", "prior_weight", np.nan),
    ],
)
def test_a_run_with_a_hole_in_its_data_is_named_with_the_column(
    tmp_path: Path, file: str, column: str, value: float
) -> None:
    write_run(tmp_path / "whole", method="ae2r")
    spoil(write_run(tmp_path / "broken", method="ae2r", seed=1), file, 3, column, value)
    reasons = left_out_of(tmp_path)
    assert reasons.keys() == {"broken"}
    assert file in reasons["broken"]
    assert column in reasons["broken"]


@pytest.mark.parametrize("file", ["status.json", "config.yaml", "eval.csv", "metrics.csv"])
@pytest.mark.parametrize("content", [None, "", "{a: [", "\x00\x01"])
def test_a_missing_or_damaged_file_is_named(tmp_path: Path, file: str, content: str | None) -> None:
    write_run(tmp_path / "whole")
    run = write_run(tmp_path / "broken", seed=1)
    (run / file).unlink() if content is None else (run / file).write_text(content)
    reasons = left_out_of(tmp_path)
    assert reasons.keys() == {"broken"}
    assert file in reasons["broken"]


def test_runs_under_way_repeated_or_evaluated_elsewhere_are_left_out(tmp_path: Path) -> None:
    for seed in range(2):
        write_run(tmp_path / f"a{seed}", seed=seed)
    write_run(tmp_path / "b-again", seed=1)
    write_run(tmp_path / "c-short", seed=2, points=POINTS[:10])
    write_run(tmp_path / "d-running", seed=3, status={"state": "running", "frames": 1000})
    reasons = left_out_of(tmp_path)
    assert reasons.keys() == {"b-again", "c-short", "d-running"}
    assert "repeats" in reasons["b-again"]
    assert "500000" in reasons["c-short"]
    assert "1000 frames" in reasons["d-running"]


def test_runs_are_found_in_folders_globs_and_lists(tmp_path: Path) -> None:
    for name in ("x/a", "x/b", "y/c", ".hidden/d"):
        write_run(tmp_path / name)
    assert [path.name for path in find(str(tmp_path))] == ["a", "b", "c"]
    assert [path.name for path in find(f"{tmp_path}/x/*")] == ["a", "b"]
    assert [path.name for path in find([f"{tmp_path}/y", f"{tmp_path}/x/b", f"{tmp_path}/y/c"])] == ["c", "b"]
    with pytest.raises(ValueError, match="nowhere"):
        find(str(tmp_path / "nowhere"))


@pytest.mark.parametrize(
    "override",
    ["pairing=none", "bootstrap.reps=0", "bootstrap.confidence=95", "change_from=1", "baseline=nne", "compare=[ppo]"],
)
def test_a_wrong_key_is_refused_by_name(tmp_path: Path, override: str) -> None:
    write_run(tmp_path / "a")
    with pytest.raises(ValueError, match=override.split("=")[0]):
        report(config(f"runs={tmp_path}", f"out={tmp_path / 'out'}", override))


def test_nothing_but_unusable_runs_is_an_error_with_a_message_only(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    write_run(tmp_path / "a", status={"state": "running"})
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("HYDRA_MAIN_MODULE", "__main__")  # find conf/ as the command does
    monkeypatch.setattr(sys, "argv", ["report", f"runs={tmp_path}", f"out={tmp_path / 'out'}"])
    with pytest.raises(SystemExit, match="none of the 1 runs"):  # a text: status 1
        main()
    said = capsys.readouterr().err
    assert "not finished" in said
    assert "Traceback" not in said
    assert not (tmp_path / "out").exists()


def test_a_failed_run_gives_its_reason(tmp_path: Path) -> None:
    write_run(tmp_path / "a")
    run = write_run(tmp_path / "b", seed=1)
    (run / "status.json").write_text(json.dumps({"state": "failed"}))
    assert left_out_of(tmp_path) == {"b": "it failed: no reason given"}


def test_numbers_are_short_and_never_minus_zero() -> None:
    assert [number(value) for value in (1234567.8, -0.004, -1.5, float("nan"))] == ["1 234 568", "0.00", "-1.50", "-"]
    assert table(["a|b"], [["c"]]).splitlines()[0] == "| a\\|b |"


def test_a_cell_of_many_lines_stays_one_row() -> None:
    assert table(["why"], [["a | b\n  c\n"]]).splitlines()[2:] == ["| a \\| b c |"]
