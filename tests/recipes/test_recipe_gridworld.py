"""``python -m recipes.gridworld`` as a user runs it: what it writes, what it refuses, and what survives a kill."""

from __future__ import annotations

import shutil
import signal
import subprocess
import sys
import time
from contextlib import redirect_stdout
from io import StringIO
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from composed import with_another_hash_seed
from omegaconf import OmegaConf

from recipes.gridworld.__main__ import main
from recipes.gridworld.run_parts import runs_of
from recipes.gridworld.tabular import LOG_FIELDS
from torchrl_priors.methods import METHODS

ROOT = Path(__file__).parents[2]
PRIORS = ["expert", "random_15", "random_30", "random_50", "structural_3", "structural_5", "structural_10"]
TINY = ["study=small", "workers=1", "teacher.steps=500", "teacher.eval_episodes=2", "bootstrap.reps=50"]
TINY += ["evaluation.points=5", "evaluation.interval=20"]
FIGURES = ["learning_curves", "performance_profiles", "iqm", "world"]


def recipe(*overrides: object) -> int:
    """Run the recipe in this process, from the repository's root; returns the exit status."""
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(ROOT)
        patch.setenv("HYDRA_MAIN_MODULE", "__main__")  # find conf/ as the command does
        patch.setattr(sys, "argv", ["gridworld", *TINY, *map(str, overrides)])
        try:
            main()
        except SystemExit as end:
            if isinstance(end.code, str):  # what Python does at the end of a process
                print(end.code, file=sys.stderr)
                return 1
            return end.code or 0
    return 0


def command(*overrides: object) -> list[str]:
    return [sys.executable, "-m", "recipes.gridworld", *TINY, *map(str, overrides)]


def contents(path: Path) -> dict[str, bytes]:
    return {str(file.relative_to(path)): file.read_bytes() for file in path.rglob("*") if file.is_file()}


def tables(path: Path) -> dict[str, bytes]:
    return {file.name: file.read_bytes() for file in path.glob("*.csv")}


@pytest.fixture(scope="module")
def small(tmp_path_factory) -> Path:
    """Every method of the library with every prior of the paper, on three worlds."""
    out = tmp_path_factory.mktemp("study") / "small"
    with redirect_stdout(StringIO()) as said:
        assert recipe("worlds=3", f"out={out}") == 0
    (out / "stdout.txt").write_text(said.getvalue())
    return out


def episodes(path: Path) -> np.ndarray:
    """The evaluation episodes behind the tables: ``[worlds, pairs, points, fields]``."""
    return np.concatenate([np.load(file)["episodes"] for file in sorted((path / "blocks").iterdir())])


def test_small_study_runs_every_method_with_every_prior(small):
    ratios = pd.read_csv(small / "area_ratio.csv")
    methods = [method for method in METHODS if method != "none"]
    assert list(zip(ratios["prior"], ratios["method"], strict=True)) == [(p, m) for p in PRIORS for m in methods]
    curves = pd.read_csv(small / "curves.csv")
    assert set(zip(curves["prior"], curves["method"], strict=True)) == {(p, m) for p in PRIORS for m in METHODS}
    assert (
        curves.groupby(["prior", "method"])["transitions"].apply(list).map(lambda t: t == [20, 40, 60, 80, 100]).all()
    )


def test_tables_have_the_promised_columns(small):
    columns = {
        name: list(pd.read_csv(small / f"{name}.csv").columns) for name in ("area_ratio", "prior_weights", "worlds")
    }
    assert columns["area_ratio"][:5] == ["prior", "method", "iqm", "ci_low", "ci_high"]
    assert "paper_iqm" in columns["area_ratio"]
    values = [f"{name}{end}" for name in ("degraded", "non_degraded", "gap") for end in ("", "_ci_low", "_ci_high")]
    assert columns["prior_weights"] == ["prior", "method", "average", *values]
    wanted = {"seed", "distinct_states", "teacher_return", "teacher_length", "reachable_goal", "baseline_area"}
    assert wanted <= set(columns["worlds"])


def test_paper_is_quoted_for_its_methods_and_no_others(small):
    quoted = pd.read_csv(small / "area_ratio.csv").dropna(subset="paper_iqm")
    assert set(quoted["method"]) == {"er", "e2r", "aer", "ae2r"}
    assert set(quoted["prior"]) == set(PRIORS)
    cell = quoted.set_index(["prior", "method"])["paper_iqm"]
    assert (cell["expert", "er"], cell["random_50", "e2r"], cell["structural_10", "ae2r"]) == (0.036, -0.203, -0.133)


def test_tables_say_what_the_episodes_say(small):
    pairs, data = runs_of(list(METHODS), PRIORS), episodes(small)
    returns = data[..., LOG_FIELDS.index("return")].astype(float)
    area = returns.mean(-1)
    baseline = area[:, pairs.index(("none", ""))]
    worlds = pd.read_csv(small / "worlds.csv")
    assert worlds["seed"].tolist() == [0, 1, 2]
    np.testing.assert_allclose(worlds["baseline_area"], baseline, rtol=1e-5)
    curves = pd.read_csv(small / "curves.csv").set_index(["prior", "method"])["mean"].sort_index()
    np.testing.assert_allclose(
        curves["random_50", "aer"], returns[:, pairs.index(("aer", "random_50"))].mean(0), rtol=1e-5
    )
    np.testing.assert_allclose(curves["structural_3", "none"], returns[:, 0].mean(0), rtol=1e-5)

    weights = pd.read_csv(small / "prior_weights.csv").set_index(["prior", "method", "average"])
    assert set(weights.index.get_level_values("method")) == {"aer", "ae2r", "aligned"}
    run = data[:, pairs.index(("aligned", "structural_10"))].reshape(-1, len(LOG_FIELDS))
    for group, name in (("degraded", "degraded"), ("other", "non_degraded")):
        total, count = (run[:, LOG_FIELDS.index(f"{kind}_{group}")].astype(float) for kind in ("w", "n"))
        by_visit, by_episode = total.sum() / count.sum(), (total[count > 0] / count[count > 0]).mean()
        assert weights.loc[("structural_10", "aligned", "visit"), name] == pytest.approx(by_visit, rel=1e-5)
        assert weights.loc[("structural_10", "aligned", "episode"), name] == pytest.approx(by_episode, rel=1e-5)
    assert (weights["gap"] - weights["non_degraded"] + weights["degraded"]).abs().max() < 1e-5


def test_figures_are_there_and_the_terminal_names_every_file(small):
    said = (small / "stdout.txt").read_text()
    files = [f"{name}.{kind}" for name in FIGURES for kind in ("png", "pdf")]
    files += [f"{name}.csv" for name in ("area_ratio", "comparisons", "prior_weights", "worlds", "curves")]
    for file in files:
        assert (small / file).stat().st_size > 100
        assert str(small / file) in said
    assert all(prior in said for prior in PRIORS)


def test_resolved_configuration_lies_beside_the_results(small):
    kept = OmegaConf.load(small / "config.yaml")
    assert kept["worlds"] == 3
    assert kept["evaluation"] == {"points": 5, "interval": 20}
    assert kept["methods"] == list(METHODS)


def test_finished_run_only_reports_again(small):
    before = contents(small)
    written = {file: file.stat().st_mtime_ns for file in (small / "blocks").iterdir()}
    assert recipe("worlds=3", f"out={small}") == 0
    assert contents(small) == before
    assert {file: file.stat().st_mtime_ns for file in (small / "blocks").iterdir()} == written


@pytest.mark.usefixtures("without_pictures")
@pytest.mark.parametrize("study", sorted(file.stem for file in (ROOT / "conf" / "study").glob("*.yaml")))
def test_every_study_runs_and_the_shaped_reading_too(study, tmp_path):
    out = tmp_path / study
    assert recipe(f"study={study}", "worlds=2", "td_error=shaped", "priors=[structural_3]", f"out={out}") == 0
    assert set(pd.read_csv(out / "area_ratio.csv")["prior"]) == {"structural_3"}
    assert (out / "learning_curves.png").exists()


FIVE = ["worlds=5", "priors=[expert,structural_3]", "methods=[none,ae2r,aligned]", "world.end_prob=0.05"]
FIVE += ["evaluation.interval=100"]
# Long enough to be killed in the middle.
LONG = ["worlds=8", "priors=[expert]", "methods=[none,ae2r]", "evaluation.interval=200000"]


@pytest.fixture(scope="module")
def five(tmp_path_factory) -> Path:
    """One uninterrupted run, in one block."""
    out = tmp_path_factory.mktemp("study") / "five"
    assert recipe(*FIVE, f"out={out}") == 0
    assert len(list((out / "blocks").iterdir())) == 1
    assert len(tables(out)) == 5
    return out


@pytest.mark.usefixtures("without_pictures")
@pytest.mark.parametrize("how", [("workers=2",), ("workers=3", "block_worlds=2")])
def test_results_do_not_depend_on_how_the_work_is_divided(five, how, tmp_path):
    assert recipe(*FIVE, *how, f"out={tmp_path / 'again'}") == 0
    assert tables(tmp_path / "again") == tables(five)


@pytest.mark.usefixtures("without_pictures")
def test_a_study_goes_on_with_other_blocks(five, tmp_path):
    for size in (2, 3, 1):
        assert recipe(*FIVE, f"block_worlds={size}", f"out={tmp_path / 'again'}") == 0
        assert tables(tmp_path / "again") == tables(five)


def test_a_student_that_diverges_is_named(tmp_path, capfd):
    assert (
        recipe("worlds=1", "priors=[expert]", "methods=[none,e2r]", "student.lr=1e300", f"out={tmp_path / 'out'}") != 0
    )
    said = "".join(capfd.readouterr())
    assert "diverged" in said
    assert "student.lr=1e+300" in said


@pytest.mark.usefixtures("without_pictures")
def test_worlds_are_the_same_in_a_larger_study(small, tmp_path):
    out = tmp_path / "more"
    assert recipe("worlds=4", "seed=1", "priors=[structural_3]", "methods=[none,aer]", f"out={out}") == 0
    one, other = (pd.read_csv(path / "worlds.csv").set_index("seed").astype(float) for path in (small, out))
    pd.testing.assert_frame_equal(one.loc[[1, 2]], other.loc[[1, 2]])


@pytest.mark.parametrize(
    ("override", "named"),
    [
        ("nonsense=1", "nonsense"),
        ("student.lrr=0.1", "lrr"),
        ("study=nonsense", "nonsense"),
        ("worlds=many", "worlds"),
        ("worlds=0", "worlds=0"),
        ("worlds=-3", "worlds=-3"),
        ("worlds=2.5", "worlds"),
        ("methods=[none,nonsense]", "nonsense"),
        ("methods=[er]", "methods"),
        ("methods=[]", "methods"),
        ("methods=[none,er,er]", "methods"),
        ("priors=[nonsense]", "nonsense"),
        ("priors=[random_0]", "random_0"),
        ("priors=[]", "priors"),
        ("td_error=nonsense", "td_error=nonsense"),
        ("student.lr=-0.1", "student.lr=-0.1"),
        ("teacher.lr=0", "teacher.lr=0.0: expected a positive number"),
        ("student.lr=nan", "student.lr=nan"),
        ("student.lr_weight.original=-1", "student.lr_weight.original=-1"),
        ("teacher.lr=-1", "teacher.lr=-1"),
        ("teacher.epsilon=1.5", "teacher.epsilon=1.5"),
        ("teacher.temperature=0", "teacher.temperature=0"),
        ("student.gamma=1.1", "student.gamma=1.1"),
        ("world.noise=2", "world.noise=2"),
        ("world.end_prob=0", "world.end_prob=0"),
        ("world.window=4", "world.window=4"),
        ("world.size=0", "world.size=0"),
        ("evaluation.points=0", "evaluation.points=0"),
        ("evaluation.interval=0", "evaluation.interval=0"),
        ("bootstrap.reps=0", "bootstrap.reps=0"),
        ("bootstrap.seed=-1", "bootstrap.seed=-1"),
        ("block_worlds=0", "block_worlds=0"),
        ("workers=0", "workers=0"),
        ("seed=-1", "seed=-1"),
        (f"seed={2**63 - 1}", "seed="),
        ("teacher.temperature=inf", "teacher.temperature=inf"),
        ("device=cuda", "device"),
    ],
)
def test_bad_input_is_refused_by_name_before_anything_is_written(override, named, tmp_path, capfd):
    out = tmp_path / "out"
    assert recipe(override, f"out={out}") != 0
    said = capfd.readouterr().err
    assert named in said
    assert "Traceback" not in said
    assert not out.exists()


def test_typo_is_an_error_for_the_command_too(capfd):
    assert recipe("world=3") != 0
    assert "world" in "".join(capfd.readouterr())


def test_file_in_the_way_of_the_results_is_named_and_kept(tmp_path, capfd):
    (tmp_path / "out").write_text("precious")
    assert recipe("worlds=2", f"out={tmp_path / 'out'}") != 0
    assert f"out={tmp_path / 'out'}" in "".join(capfd.readouterr())
    assert (tmp_path / "out").read_text() == "precious"


@pytest.mark.parametrize("override", ["student.lr=0.2", "td_error=shaped", "seed=7", "priors=[expert]"])
def test_folder_of_another_configuration_is_refused_and_left_alone(small, override, capfd):
    before = contents(small)
    assert recipe("worlds=3", override, f"out={small}") != 0
    said = "".join(capfd.readouterr())
    assert str(small) in said
    assert override.partition("=")[0] in said
    assert contents(small) == before


@pytest.mark.usefixtures("without_pictures")
def test_damaged_block_is_named_and_nothing_is_lost(five, tmp_path, capfd):
    copy = tmp_path / "copy"
    shutil.copytree(five, copy)
    block = next((copy / "blocks").iterdir())
    block.write_bytes(block.read_bytes()[:1000])
    before = contents(copy)
    assert recipe(*FIVE, f"out={copy}") != 0
    said = "".join(capfd.readouterr())
    assert str(block) in said
    assert "damaged" in said
    after = contents(copy)
    assert [name for name in before if after[name] != before[name]] == ["config.yaml"]  # it says where the copy is
    block.unlink()
    assert recipe(*FIVE, f"out={copy}") == 0
    assert tables(copy) == tables(five)


@pytest.mark.usefixtures("without_pictures")
def test_killed_run_continues_to_the_same_tables(tmp_path):
    whole, out = tmp_path / "whole", tmp_path / "killed"
    assert recipe(*LONG, f"out={whole}") == 0
    with subprocess.Popen(
        command(*LONG, "block_worlds=1", "workers=2", f"out={out}"),
        cwd=ROOT,
        env=with_another_hash_seed(),
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    ) as run:
        deadline = time.monotonic() + 120
        while len(list(out.rglob("[!.]*.npz"))) < 2:
            assert run.poll() is None
            assert time.monotonic() < deadline
            time.sleep(0.005)
        run.send_signal(signal.SIGKILL)
    assert run.returncode == -signal.SIGKILL
    assert not tables(out)
    kept = {file: file.stat().st_mtime_ns for file in out.rglob("[!.]*.npz")}
    assert recipe(*LONG, "block_worlds=1", f"out={out}") == 0
    assert all(file.stat().st_mtime_ns == written for file, written in kept.items())
    assert tables(out) == tables(whole)
