"""``method=trial`` of the MuJoCo recipe: who competes, what is counted, how the winner goes on."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import pandas as pd
import pytest

pytest.importorskip("mujoco")
from mujoco_cases import interrupt, run

from torchrl_priors import TeacherTrial

SHORT = ["trial.max_frames=128", "trial.min_frames=64", "let_go.window=64"]


@pytest.fixture(scope="module")
def teachers(tmp_path_factory) -> Path:
    """A folder of two teachers."""
    folder = tmp_path_factory.mktemp("teachers")
    for seed, name in enumerate(("first", "second")):
        made = run(folder / name, f"seed={seed}", "total_frames=64") / "policy.safetensors"
        shutil.copy(made, folder / f"{name}.safetensors")
    return folder


@pytest.fixture
def trial(teachers) -> list[str]:
    return ["method=trial", f"prior.path={teachers / 'first.safetensors'}", *SHORT]


def winner(out: Path) -> str:
    return json.loads((out / "trial.json").read_text())["winner"]


def always(monkeypatch: pytest.MonkeyPatch, arm: str) -> None:
    """Let an arm win."""
    end = TeacherTrial._end

    def ending(self, recent, confidence):
        self.active = [arm]
        end(self, recent, confidence)

    monkeypatch.setattr(TeacherTrial, "_end", ending)


def test_frames_of_all_students_count_and_each_is_logged(trial, teachers, tmp_path):
    both = f"prior.path=[{teachers / 'first.safetensors'},{teachers / 'second.safetensors'}]"
    out = run(tmp_path, *trial, both, "total_frames=512")
    metrics = pd.read_csv(out / "metrics.csv")
    assert metrics["frames"].tolist() == list(range(64, 513, 64))
    assert metrics["arm"].tolist() == [*["alone", "first", "second"] * 2, *[winner(out)] * 2]
    assert pd.read_csv(out / "eval.csv")["frames"].iloc[-1] == 512
    result = json.loads((out / "trial.json").read_text())
    assert result["frames"] == {"alone": 128, "first": 128, "second": 128}


@pytest.mark.parametrize("arm", ["alone", "first"])
def test_the_winner_goes_on_as_the_run_of_its_method_does(arm, trial, teachers, tmp_path, monkeypatch):
    always(monkeypatch, arm)
    out = run(tmp_path / "trial", *trial, "trial.min_frames=128", "total_frames=384")
    assert winner(out) == arm
    alike = ["method=none"] if arm == "alone" else ["method=kickstart", *trial[1:], "let_go.methods=all"]
    own = run(tmp_path / "own", *alike, "total_frames=256")  # 384 but for the other's 128
    columns = ["loss_objective", "loss_critic", "entropy", "episode_return"]
    rows = pd.read_csv(out / "metrics.csv")
    pd.testing.assert_frame_equal(
        rows.loc[rows["arm"] == arm, columns].reset_index(drop=True),
        pd.read_csv(own / "metrics.csv")[columns],
        check_exact=True,
    )


@pytest.mark.parametrize("stop", [128, 192, 320])  # within a round; between rounds; after the decision
def test_a_trial_that_was_interrupted_gives_the_same_files(stop, trial, tmp_path, monkeypatch):
    options = [*trial, "total_frames=512", "prior.degrade=random"]
    whole = run(tmp_path / "whole", *options)
    interrupt(monkeypatch, tmp_path / "stopped", stop, *options)
    run(tmp_path / "stopped", *options)
    for name in ("eval.csv", "policy.safetensors", "trial.json"):
        assert (tmp_path / "stopped" / name).read_bytes() == (whole / name).read_bytes()


def test_a_teacher_is_let_go_where_returns_do_not_rise(teachers, tmp_path):
    teacher = f"prior.path={teachers / 'first.safetensors'}"
    small = ["let_go.methods=all", "let_go.window=256", "total_frames=1024", "ppo.lr=1e-9"]
    rows = pd.read_csv(run(tmp_path / "let_go", "method=kickstart", teacher, *small) / "metrics.csv")
    assert rows["aux_coeff"].iloc[0] == 1
    assert rows["aux_coeff"].iloc[-1] < 1
    kept = run(tmp_path / "kept", "method=kickstart", teacher, "total_frames=64")
    assert "aux_coeff" not in pd.read_csv(kept / "metrics.csv")


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("prior.path=null", "prior.path=None: expected the files of one or more teachers"),
        ("prior.path=[]", "expected the files of one or more teachers"),
        ("trial.method=none", "trial.method=none: expected a method with a teacher"),
        ("trial.method=foo", "Unknown method 'foo'"),
        ("trial.max_frames=1", "trial.max_frames=1: expected at least one rollout"),
        ("trial.min_frames=200", "trial.min_frames=200"),
        ("trial.alpha=0", "trial.alpha=0"),
        ("trial.recent=2", "trial.recent=2"),
        ("total_frames=192", "total_frames=192: expected at least 256, for a trial of 2 students"),
        ("let_go.methods=some", "let_go.methods=some"),
        ("let_go.window=0", "let_go.window=0"),
    ],
)
def test_bad_input_is_refused_by_name_before_anything_is_written(override, message, trial, tmp_path):
    with pytest.raises(SystemExit) as error:
        run(tmp_path / "out", *trial, override)
    assert message in str(error.value)
    assert not (tmp_path / "out").exists()


def test_several_teachers_are_for_a_trial_and_need_names_of_their_own(trial, teachers, tmp_path):
    path = teachers / "first.safetensors"
    for options, message in (
        (["method=e2r", f"prior.path=[{path},{path}]"], "expected one teacher; method=trial takes several"),
        ([*trial, f"prior.path=[{path},{path}]"], "expected files of different names"),
    ):
        with pytest.raises(SystemExit) as error:
            run(tmp_path / "out", *options, "total_frames=512")
        assert message in str(error.value)


def test_a_trial_in_which_no_episode_ends_says_so(trial, tmp_path):
    with pytest.raises(SystemExit, match="finished no episode") as error:
        run(tmp_path, *trial, "trial.max_frames=64", "env.num_envs=64", "total_frames=128")  # one step each
    assert "max_frames" in str(error.value)
