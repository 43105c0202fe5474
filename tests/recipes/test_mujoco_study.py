"""Studies of the MuJoCo recipe: what is missing is run, what is finished is in the tables, nothing stops the rest."""

from __future__ import annotations

import itertools
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import pandas as pd
import pytest

pytest.importorskip("mujoco")
from composed import composed
from hydra import compose, initialize_config_dir
from mujoco_cases import ROOT, TINY, without_records
from sweep_cases import alive, wait_for

from recipes.common.run_folder import write_file
from recipes.mujoco import train
from recipes.mujoco_study import __main__, tables, work
from recipes.mujoco_study.__main__ import study
from recipes.mujoco_study.plan import StudyRun, expand
from recipes.mujoco_study.tables import KEY, Tables, own_return


def config(tmp_path: Path, runs: list, **changes: Any) -> Any:
    cfg = composed("mujoco_study", "study_mujoco=trial")
    cfg.set = dict(option.split("=") for option in TINY)
    cfg.out, cfg.work, cfg.name, cfg.runs = str(tmp_path / "tables"), str(tmp_path / "work"), "tiny", runs
    for name, value in changes.items():
        cfg[name] = value
    return cfg


class Here:
    """A run in this process, in the place of one of its own."""

    def __init__(self, run: StudyRun) -> None:
        cfg = composed("mujoco", *run.overrides)
        self.returncode = 0
        try:
            with without_records():
                train.run(cfg)
        except SystemExit as error:
            run.folder.mkdir(parents=True)
            (run.folder / "log.txt").write_text(str(error))
            self.returncode = 1

    def poll(self) -> int:
        """It has ended already."""
        return self.returncode


@pytest.fixture
def here(monkeypatch) -> None:
    """No processes: only their number would differ."""
    monkeypatch.setattr(work, "_start", Here)


ONE = {"environments": ["hopper"], "methods": {"none": None}, "seeds": [0]}


@pytest.mark.parametrize("name", [path.stem for path in (ROOT / "conf/study_mujoco").glob("*.yaml")])
def test_every_study_names_runs_that_differ(name):
    with initialize_config_dir(str(ROOT / "conf"), version_base="1.3"):
        runs = expand(compose("mujoco_study", overrides=[f"study_mujoco={name}"]))
    assert len({run.folder for run in runs}) == len({run.key for run in runs}) == len(runs) > 10
    for run in {run.key[2]: run for run in runs}.values():
        cfg = composed("mujoco", *run.overrides)
        assert (cfg.label or cfg.method, Path(cfg.out)) == (run.key[2], run.folder.resolve())


def test_blocks_stand_for_their_product_seed_by_seed(tmp_path):
    block = {"environments": ["hopper", "ant"], "methods": {"e2r": None, "ae2r slow": {"weight.lr_coeff": 0.1}}}
    runs = expand(config(tmp_path, [block | {"teachers": ["good", "bad"], "seeds": {"first": 3, "number": 2}}, ONE]))
    assert [run.key for run in runs[:4]] == [
        ("hopper", "good", "e2r", 3),
        ("hopper", "bad", "e2r", 3),
        ("hopper", "good", "ae2r slow", 3),
        ("hopper", "bad", "ae2r slow", 3),
    ]
    assert len(runs) == 2 * 2 * 2 * 2 + 1
    slow = runs[3].overrides
    assert {"env=hopper", "seed=3", "method=ae2r", "weight.lr_coeff=0.1", "prior.degrade=structural"} <= set(slow)
    assert "prior.path=results/mujoco/teachers/hopper.safetensors" in slow


@pytest.mark.usefixtures("here")
def test_what_is_missing_is_run_and_what_failed_stops_nothing(tmp_path, capsys):
    broken = {"environments": ["hopper"], "methods": {"none": {"ppo.lr": -1}}, "seeds": [7]}
    cfg = config(tmp_path, [broken, ONE])
    with pytest.raises(ValueError, match=r"Not all runs are done:\nhopper none none seed 7: .*ppo\.lr=-1") as error:
        study(cfg)
    assert "log.txt" in str(error.value)
    kept = {kind: pd.read_csv(tmp_path / f"tables/tiny{kind}.csv") for kind in ("", "_training")}
    assert kept[""]["frames"].tolist() == [0, 64, 128, 192, 256]
    assert set(kept["_training"]["metric"]) == {"loss_objective", "entropy"}
    before = (tmp_path / "tables/tiny.csv").read_bytes()
    (tmp_path / "work").rename(tmp_path / "gone")  # another machine
    capsys.readouterr()
    study(config(tmp_path, [ONE]))
    assert capsys.readouterr().out == "hopper: 1 of 1 runs are in the tables\n"
    assert (tmp_path / "tables/tiny.csv").read_bytes() == before
    assert not (tmp_path / "work").exists()


@pytest.mark.usefixtures("here")
def test_who_won_a_trial_is_in_a_table_of_its_own(tmp_path):
    study(config(tmp_path, [ONE]))
    policy = tmp_path / "work/hopper/none-none-0/policy.safetensors"
    short = {"prior.path": str(policy), "trial.max_frames": 64, "trial.min_frames": 64}
    block = {"environments": ["hopper"], "methods": {"trial": short}, "teachers": ["good"], "seeds": [0]}
    study(config(tmp_path, [block]))
    row = pd.read_csv(tmp_path / "tables/tiny_trials.csv").iloc[0]
    assert row[["env", "teacher", "method", "seed", "winner", "frames"]].tolist() == [
        *("hopper", "good", "trial", 0),
        *("alone", 128),
    ]


@pytest.mark.usefixtures("here")
def test_a_finished_run_is_taken_in_when_its_rows_are_lost_or_were_not_all_written(tmp_path, monkeypatch):
    study(config(tmp_path, [ONE]))
    whole = {file: file.read_bytes() for file in (tmp_path / "tables").iterdir()}
    (tmp_path / "tables/tiny.csv").unlink()
    study(config(tmp_path, [ONE]))
    assert {file: file.read_bytes() for file in whole} == whole
    (tmp_path / "tables").rename(tmp_path / "gone")

    def killed(file: Path, content: str) -> None:
        """While it writes the second table."""
        if file.name == "tiny.csv":
            raise KeyboardInterrupt
        write_file(file, content)

    with monkeypatch.context() as patch:
        patch.setattr(tables, "write_file", killed)
        with pytest.raises(KeyboardInterrupt):
            study(config(tmp_path, [ONE]))
    assert {file.name for file in (tmp_path / "tables").glob("*.csv")} == {"tiny_settings.csv", "tiny_training.csv"}
    study(config(tmp_path, [ONE]))
    assert {file: file.read_bytes() for file in whole} == whole


@pytest.mark.usefixtures("here")
def test_the_best_run_becomes_the_teacher_and_who_needs_it_waits(tmp_path, monkeypatch):
    makers = ONE | {"seeds": [0, 1], "makes": "good"}
    taught = {"environments": ["hopper"], "methods": {"e2r": None}, "teachers": ["good"], "seeds": [0]}
    file = tmp_path / "made/hopper.safetensors"
    change = {"teachers": {"good": {"prior.path": str(file).replace("hopper", "{env}")}}}
    broken = makers | {"seeds": [1], "methods": {"none": {"ppo.lr": -1}}}
    with pytest.raises(
        ValueError, match=r"seed 1: .*\nruns that wait for prior.path=.*hopper.*: 1 \(its candidates .*; 1 are missing"
    ):
        study(config(tmp_path, [taught, makers | {"seeds": [0]}, broken], **change))
    (tmp_path / "work").rename(tmp_path / "gone")  # another machine
    study(config(tmp_path, [taught, makers], **change))
    kept = pd.read_csv(tmp_path / "tables/tiny.csv").groupby(["method", "seed"])["return"].last()
    assert kept.index.tolist() == [("e2r", 0), ("none", 0), ("none", 1)]
    assert own_return(file) == pytest.approx(kept["none"].max())
    assert pd.read_csv(tmp_path / "tables/tiny_teachers.csv")["return"].tolist() == [own_return(file)]
    before = file.read_bytes()
    better = itertools.count()  # each policy than the last
    with monkeypatch.context() as patch:
        patch.setattr(work, "own_return", lambda _: next(better))
        patch.setattr(__main__, "check_makers", lambda *_: None)
        study(config(tmp_path, [makers | {"seeds": [2]}, taught], **change))
    assert file.read_bytes() == before  # for it has taught
    worse = f"hopper/none-none-{kept['none'].idxmin()}/policy.safetensors"
    (policy,) = [tmp_path / name / worse for name in ("gone", "work") if (tmp_path / name / worse).exists()]
    file.write_bytes(policy.read_bytes())
    with pytest.raises(ValueError, match="put that file back"):
        study(config(tmp_path, [taught | {"seeds": [1]}], **change))
    file.unlink()
    with pytest.raises(ValueError, match=r"runs that wait for prior\.path=.*: 1 \(no such file\)"):
        study(config(tmp_path, [taught | {"seeds": [1]}], **change))


@pytest.mark.usefixtures("here")
def test_rows_are_in_one_order_whichever_run_ends_first(tmp_path):
    runs = expand(config(tmp_path, [ONE | {"seeds": [0, 1]}]))
    study(config(tmp_path, [ONE | {"seeds": [0, 1]}]))
    forth, back = (Tables(tmp_path / name, "t") for name in ("forth", "back"))
    for kept, order in ((forth, runs), (back, runs[::-1])):
        for run in order:
            kept.add(run)
    assert forth.files[""].read_bytes() == back.files[""].read_bytes()
    assert pd.read_csv(forth.files[""])[KEY].drop_duplicates()["seed"].tolist() == [0, 1]


def test_a_killed_run_stops_no_other_and_is_continued(tmp_path, monkeypatch):
    cfg = config(tmp_path, [ONE | {"seeds": [0, 1]}])
    cfg.set = {**cfg.set, "total_frames": "1280", "checkpoint.interval": "64"}
    of_its_own = work._start

    def start(run: StudyRun) -> subprocess.Popen | Here:
        """The first run is a process, which is killed when there is something to go on from."""
        if run.key[-1] != 0:
            return Here(run)
        process = of_its_own(run)
        wait_for(lambda: [*run.folder.glob("checkpoints/*.sha256.json")], process)
        process.kill()
        return process

    with monkeypatch.context() as patch:
        patch.setattr(work, "_start", start)
        with pytest.raises(ValueError, match="Not all runs are done:\nhopper none none seed 0: "):
            study(cfg)
        assert pd.read_csv(tmp_path / "tables/tiny.csv")["seed"].unique().tolist() == [1]
        patch.setattr(work, "_start", Here)
        study(cfg)
    assert pd.read_csv(tmp_path / "tables/tiny.csv")["seed"].unique().tolist() == [0, 1]


def test_a_second_study_on_the_same_tables_is_refused_while_the_first_is_at_work(tmp_path, monkeypatch):
    cfg, refused = config(tmp_path, [ONE]), r"out=.*name=tiny: another study is at work on these tables"

    def start(run: StudyRun) -> Here:
        with pytest.raises(ValueError, match=refused):
            study(cfg)
        looks = cfg.copy()
        looks.run = False
        study(looks)
        return Here(run)

    monkeypatch.setattr(work, "_start", start)
    study(cfg)
    study(cfg)
    assert pd.read_csv(tmp_path / "tables/tiny.csv")["seed"].unique().tolist() == [0]


@pytest.mark.usefixtures("here")
def test_runs_with_other_settings_are_not_taken_for_those_of_the_study(tmp_path):
    study(config(tmp_path, [ONE]))
    study(config(tmp_path, [ONE | {"seeds": [0, 1]}]))
    kept = pd.read_csv(tmp_path / "tables/tiny_settings.csv")
    assert kept[["env", "teacher", "method"]].to_numpy().tolist() == [["hopper", "none", "none"]]
    with pytest.raises(ValueError, match=r"hopper none none seed 0 has the settings .*ppo\.lr=0\.1.*another name"):
        study(config(tmp_path, [ONE | {"set": {"ppo.lr": 0.1}}]))


@pytest.mark.usefixtures("here")
def test_the_policy_of_another_study_is_neither_taken_nor_overwritten(tmp_path):
    makers = ONE | {"makes": "good"}
    change = {"teachers": {"good": {"prior.path": str(tmp_path / "{env}.safetensors")}}}
    study(config(tmp_path, [makers], **change))
    before = (tmp_path / "hopper.safetensors").read_bytes()
    study(config(tmp_path, [makers], **change))
    (tmp_path / "work").rename(tmp_path / "gone")
    with pytest.raises(ValueError, match=r"hopper\.safetensors is there, and is the policy of no run of this study"):
        study(config(tmp_path, [makers], name="other", **change))
    assert (tmp_path / "hopper.safetensors").read_bytes() == before


STUDY = """
import os, signal, sys
from pathlib import Path
from recipes.mujoco_study.plan import StudyRun
from recipes.mujoco_study.work import _start

out, sys.executable = sys.argv[1:]
print(_start(StudyRun(("hopper", "none", "none", 0), (), Path(out))).pid, flush=True)
os.kill(os.getpid(), signal.SIGKILL)
"""


@pytest.mark.skipif(sys.platform != "linux", reason="only Linux tells a child")
def test_a_study_that_is_killed_takes_its_runs_with_it(tmp_path):
    nothing = tmp_path / "nothing"
    nothing.write_text("#!/bin/sh\nexec sleep 600\n")
    nothing.chmod(0o755)
    command = [sys.executable, "-c", STUDY, str(tmp_path / "run"), str(nothing)]
    killed = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert killed.returncode == -signal.SIGKILL, killed.stderr
    deadline = time.monotonic() + 60
    while alive(int(killed.stdout)):
        assert time.monotonic() < deadline, "it goes on"
        time.sleep(0.01)


@pytest.mark.parametrize(
    ("runs", "message"),
    [
        ([{"environments": ["hopper"], "seeds": [0]}], r"runs\[0\]=.*expected .*methods"),
        ([ONE | {"method": "e2r"}], r"runs\[0\]"),
        ([ONE | {"teachers": ["best"]}], "teachers=best: expected one of good, weak, bad"),
        ([ONE | {"makes": "best"}], "teachers=best: expected one of good, weak, bad"),
        ([ONE | {"environments": "hopper"}], r"runs\[0\].environments=hopper: expected a list"),
        ([ONE | {"methods": ["none"]}], r"runs\[0\].methods=\['none'\]: expected settings by method"),
        ([ONE | {"seeds": {"first": 0}}], r"runs\[0\].seeds=.*: expected a list, or first and number"),
        ([ONE, ONE | {"set": {"ppo.lr": 1}}], r"runs\[1\]: hopper none none seed 0 is there with other settings"),
    ],
)
def test_bad_studies_are_refused_by_name(runs, message, tmp_path):
    with pytest.raises(ValueError, match=message):
        study(config(tmp_path, runs))
