"""``method=trial`` of the MuJoCo recipe: who competes, what is counted, how the winner goes on."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import pandas as pd
import pytest
import torch
from safetensors.torch import load_file

pytest.importorskip("mujoco")
from mujoco_cases import interrupt, run

from recipes.report.runs import find, name_priors, read, without_misfits
from recipes.show_weight.episode import load_agent
from torchrl_priors import Plateau, TeacherTrial

SHORT = ["trial.max_frames=128", "trial.min_frames=64"]


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
    return json.loads((out / "trials.json").read_text())[-1]["winner"]


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
    (result,) = json.loads((out / "trials.json").read_text())
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


def test_a_trial_that_was_interrupted_gives_the_same_files(trial, tmp_path, monkeypatch):
    options = [*trial, "total_frames=512", "prior.degrade=random"]
    whole = run(tmp_path / "whole", *options)
    for stop in (128, 192, 320):  # within a round; between rounds; after the decision
        out = tmp_path / f"stopped-{stop}"
        interrupt(monkeypatch, out, stop, *options)
        run(out, *options)
        for name in ("eval.csv", "policy.safetensors", "trials.json"):
            assert (out / name).read_bytes() == (whole / name).read_bytes(), stop


@pytest.fixture
def standing_still(teachers) -> list[str]:
    """A student whose returns do not rise, after 256 frames in a trial with its twin."""
    teacher = f"prior.path={teachers / 'first.safetensors'}"
    return ["method=kickstart", teacher, *SHORT, "let_go.methods=all", "let_go.window=128", "ppo.lr=1e-9"]


def test_a_student_that_stands_still_is_tried_without_its_teacher(standing_still, tmp_path, monkeypatch):
    monkeypatch.setattr(Plateau, "reached", property(lambda self: self.frames >= 256))
    kept, twin = "kickstart", "kickstart, let go"
    always(monkeypatch, twin)
    out = run(tmp_path, *standing_still, "total_frames=640")
    rows = pd.read_csv(out / "metrics.csv")
    assert rows["arm"].tolist() == [*[kept] * 4, *[kept, twin] * 2, *[twin] * 2]
    assert winner(out) == twin
    both = rows.iloc[4:6]
    assert both["episode_return"].nunique(dropna=False) == 1  # the twin begins in the very state of the student
    assert rows.loc[rows["arm"] == twin, "aux_coeff"].tolist() == [1.0, 0.5, 0.0, 0.0]  # its teacher fades in a window
    assert rows["frames"].tolist() == list(range(64, 641, 64))


def test_a_teacher_that_stays_is_tried_again_after_twice_the_frames_for_twice_as_long(
    standing_still, tmp_path, monkeypatch
):
    monkeypatch.setattr(Plateau, "reached", property(lambda self: self.frames >= 128))
    out = run(tmp_path, *standing_still, "trial.alpha=1e-9", "total_frames=1024")
    rows = pd.read_csv(out / "metrics.csv")
    kept, twin = "kickstart", "kickstart, let go"
    # after 2 rollouts a trial of 2; after one more, more than 4 of its own, one of 4
    assert rows["arm"].tolist() == [*[kept] * 2, *[kept, twin] * 2, kept, *[kept, twin] * 4, kept]
    results = json.loads((out / "trials.json").read_text())
    assert [(result["winner"], result["confidence"]) for result in results] == [(kept, 0), (kept, 0)]


def test_a_student_who_let_go_and_fell_behind_gives_way_to_the_one_who_is_kept(standing_still, tmp_path, monkeypatch):
    monkeypatch.setattr(Plateau, "reached", property(lambda self: self.frames >= 256))
    kept, twin = "kickstart", "kickstart, let go"
    options = [*standing_still, "ppo.lr=1e-3", "total_frames=768"]
    with monkeypatch.context() as patch:
        always(patch, twin)
        patch.setattr("recipes.mujoco.trial.welch", lambda before, now: (3e9, 1e9 - 1))
        whole = run(tmp_path / "whole", *options)
        interrupt(patch, tmp_path / "stopped", 704, *options)  # it goes on from 640, after the fall
        run(tmp_path / "stopped", *options)
    assert pd.read_csv(whole / "metrics.csv")["arm"].tolist() == [*[kept] * 4, *[kept, twin] * 2, twin, *[kept] * 3]
    let_go, fell = json.loads((whole / "trials.json").read_text())
    assert (let_go["winner"], fell["winner"]) == (twin, kept)
    assert fell["frames"] == {kept: 384, twin: 448}
    assert fell["confidence"] == pytest.approx(0.99865, abs=1e-5)  # of three standard errors
    for name in ("eval.csv", "policy.safetensors", "trials.json"):
        assert (tmp_path / "stopped" / name).read_bytes() == (whole / name).read_bytes()
    monkeypatch.setattr(Plateau, "reached", False)
    never = run(tmp_path / "never", *options, "total_frames=576")
    torch.testing.assert_close(*(load_file(out / "policy.safetensors") for out in (whole, never)), rtol=0, atol=0)


def test_a_little_less_is_no_fall(standing_still, tmp_path, monkeypatch):
    monkeypatch.setattr(Plateau, "reached", property(lambda self: self.frames >= 256))
    always(monkeypatch, "kickstart, let go")
    for fall in ((2.9, 1.0), (0.0, 0.0)):
        monkeypatch.setattr("recipes.mujoco.trial.welch", lambda before, now, fall=fall: fall)
        out = run(tmp_path / str(fall[0]), *standing_still, "total_frames=640")
        assert winner(out) == "kickstart, let go"


def test_an_interrupted_run_with_a_twin_gives_the_same_files(standing_still, tmp_path, monkeypatch):
    monkeypatch.setattr(Plateau, "reached", property(lambda self: self.frames >= 256))
    options = [*standing_still, "ppo.lr=1e-3", "total_frames=640"]
    whole = run(tmp_path / "whole", *options)
    for stop in (256, 384, 576):  # before, in and after the trial with the twin
        out = tmp_path / f"stopped-{stop}"
        interrupt(monkeypatch, out, stop, *options)
        run(out, *options)
        for name in ("eval.csv", "policy.safetensors", "trials.json"):
            assert (out / name).read_bytes() == (whole / name).read_bytes(), stop


def test_no_trial_begins_that_could_not_be_decided(standing_still, tmp_path, monkeypatch):
    monkeypatch.setattr(Plateau, "reached", True)
    out = run(tmp_path, *standing_still, "total_frames=192", "trial.min_frames=128")
    assert set(pd.read_csv(out / "metrics.csv")["arm"]) == {"kickstart"}


def test_without_it_a_run_has_no_arms(standing_still, tmp_path):
    out = run(tmp_path, *standing_still, "let_go.methods=trial", "total_frames=64")
    assert "arm" not in pd.read_csv(out / "metrics.csv")


def test_a_report_takes_a_trial_as_the_student_who_won_it(trial, tmp_path):
    run(tmp_path / "trial", *trial)
    run(tmp_path / "none")
    runs, left_out = read(find(str(tmp_path)))
    name_priors(runs)
    assert not left_out
    assert sorted(run.label for run in runs) == ["none", "trial"]
    taken = next(run for run in runs if run.method == "trial")
    assert taken.metrics["frames"].tolist() == [64, 192]  # alone, in doubt
    usable, misfits = without_misfits(runs)
    assert [run.label for run in usable] == ["none", "trial"]
    assert not misfits


def test_a_trial_is_no_run_with_a_weight_to_show(trial, tmp_path):
    out = run(tmp_path, *trial)
    with pytest.raises(ValueError, match="no learned weight"):
        load_agent(out, None)


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
        ("let_go.window=32", "let_go.window=32: expected at least one rollout of 64"),
        ("let_go.fall=0", "let_go.fall=0"),
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
