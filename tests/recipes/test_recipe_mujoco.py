"""The MuJoCo recipe as a user runs it: every method, bad input, interruptions."""

from __future__ import annotations

import shutil
import signal
import subprocess
import sys
from pathlib import Path

import pandas as pd
import pytest
import torch
from composed import with_another_hash_seed
from mujoco_cases import ROOT, TINY, config, interrupt, run
from sweep_cases import wait_for
from tensordict import TensorDict
from torch import nn
from torchrl.modules import TanhNormal

pytest.importorskip("mujoco")
from recipes.export_best import ExportConfig, export
from recipes.mujoco import agent as agents
from recipes.mujoco.__main__ import main
from recipes.mujoco.task import open_task
from torchrl_priors import ModulePrior
from torchrl_priors.artifacts import save_prior
from torchrl_priors.methods import METHODS


@pytest.fixture(scope="module")
def teacher(tmp_path_factory) -> Path:
    return run(tmp_path_factory.mktemp("teacher")) / "policy.safetensors"


@pytest.mark.parametrize("td_error", ["original", "shaped"])
@pytest.mark.parametrize("method", [method for method in METHODS if method != "none"])
def test_every_method_trains_from_a_teacher_that_the_recipe_made(method, td_error, teacher, tmp_path):
    out = run(tmp_path, f"method={method}", f"prior.path={teacher}", f"td_error={td_error}", "total_frames=128")
    assert len(pd.read_csv(out / "eval.csv")) == 3  # before the first frame, too
    metrics = pd.read_csv(out / "metrics.csv")
    assert ("loss_prior" in metrics) == METHODS[method].auxiliary
    assert ("loss_prior_weight" in metrics) == METHODS[method].adaptive
    assert metrics.filter(like="loss_").notna().all(axis=None)
    assert (out / "policy.safetensors").exists()


@pytest.mark.parametrize(
    "options",
    [
        ["prior.degrade=structural"],
        ["prior.degrade=random"],
        ["weight.trained=rollout"],
        ["weight.trained=oracle", "prior.degrade=structural"],
    ],
)
def test_degraded_teachers_and_late_weights_run(options, teacher, tmp_path):
    out = run(tmp_path, "method=ae2r", f"prior.path={teacher}", "total_frames=128", *options)
    assert pd.read_csv(out / "metrics.csv")["prior_weight"].between(0, 1).all()


def test_a_weight_trained_after_the_rollout_is_the_only_thing_trained_then(teacher, tmp_path):
    cfg = config(tmp_path, "method=ae2r", f"prior.path={teacher}", "weight.trained=rollout", "weight.lr_coeff=0")
    torch.manual_seed(0)
    agent = agents.Agent(cfg, open_task(cfg))
    assert set(agent.networks()) == {"actor", "critic", "weight", "raw_critic"}


def test_the_oracle_trusts_exactly_the_states_whose_advice_is_right(teacher, tmp_path):
    options = ["method=aligned", f"prior.path={teacher}", "weight.trained=oracle", "prior.threshold=0.1"]
    cfg = config(tmp_path, *options, "prior.degrade=structural")
    agent = agents.Agent(cfg, open_task(cfg))
    assert set(agent.networks()) == {"actor", "critic"}
    states = TensorDict(observation=torch.randn(50, 11), batch_size=[50])
    task = open_task(cfg)
    degraded = agents.make_prior(cfg, task).get_dist(states.copy()).mean
    right = task.teachers[str(teacher)].get_dist(states.copy()).mean
    trusted = agent.weight(states)["prior_weight"].squeeze(-1) == 1
    assert 0 < trusted.sum() < 50
    torch.testing.assert_close(degraded[trusted], right[trusted])
    torch.testing.assert_close(degraded[~trusted], -right[~trusted])


@pytest.mark.parametrize(("method", "compiled"), [("none", False), ("ae2r", False), ("ae2r", True)])
def test_an_interrupted_run_gives_the_evaluations_of_an_uninterrupted_one(
    method, compiled, teacher, tmp_path, monkeypatch
):
    if compiled and shutil.which("g++") is None and shutil.which("clang++") is None:
        pytest.skip("no C++ compiler")
    options = [f"method={method}", f"compile={compiled}"]
    options += [] if method == "none" else [f"prior.path={teacher}", "prior.degrade=random"]
    whole = run(tmp_path / "whole", *options)
    if compiled:  # what is compiled is the very step
        plain = pd.read_csv(run(tmp_path / "plain", *options, "compile=false") / "metrics.csv")
        losses = [name for name in plain if name.startswith("loss_")]
        assert {"loss_objective", "loss_critic", "loss_prior", "loss_prior_weight"} <= set(losses)
        pd.testing.assert_frame_equal(pd.read_csv(whole / "metrics.csv")[losses], plain[losses], rtol=1e-3, atol=1e-5)
    for stop in (192,) if compiled else (128, 192):
        out = tmp_path / f"stopped-{stop}"
        interrupt(monkeypatch, out, stop, *options)
        run(out, *options)
        assert (out / "eval.csv").read_bytes() == (whole / "eval.csv").read_bytes()
        assert (out / "policy.safetensors").read_bytes() == (whole / "policy.safetensors").read_bytes()


def test_a_killed_process_continues_where_it_was(tmp_path):
    run(tmp_path / "whole", "total_frames=640", recorded=True)
    out = tmp_path / "killed"
    options = [*TINY, "checkpoint.interval=64", "total_frames=640", f"out={out}"]
    command = [sys.executable, "-m", "recipes.mujoco", *options]
    process = subprocess.Popen(
        command, cwd=ROOT, env=with_another_hash_seed(), stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
    )
    wait_for(lambda: [*out.glob("checkpoints/*.sha256.json")], process)
    process.send_signal(signal.SIGKILL)
    assert process.wait() == -signal.SIGKILL
    run(out, "total_frames=640", recorded=True)
    assert (out / "eval.csv").read_bytes() == (tmp_path / "whole" / "eval.csv").read_bytes()


def test_an_annealed_coefficient_is_logged_and_goes_to_its_end(teacher, tmp_path):
    out = run(tmp_path, "method=annealed_kickstart", f"prior.path={teacher}")
    metrics = pd.read_csv(out / "metrics.csv")
    assert metrics["aux_coeff"].tolist() == pytest.approx([1.0, 0.5, 0.0, 0.0])  # to 0 at half of 256 frames
    assert (metrics["loss_prior"] / metrics["prior_cross_entropy"]).tolist() == pytest.approx([1.0, 0.5, 0.0, 0.0])


def test_any_method_can_be_annealed_bonus_and_loss_alike(teacher, tmp_path):
    schedule = ["schedule.methods=all", "schedule.shape=piecewise", "schedule.points=[[0.25,1],[0.75,0.5]]"]
    out = run(tmp_path, "method=ae2r", f"prior.path={teacher}", "bonus_coeff=0.8", *schedule)
    metrics = pd.read_csv(out / "metrics.csv")
    assert metrics["aux_coeff"].tolist() == pytest.approx([1.0, 1.0, 0.75, 0.5])
    for name in ("bonus_coeff", "loss_bonus_coeff"):
        assert metrics[name].tolist() == pytest.approx([0.8, 0.8, 0.6, 0.4])


def test_an_annealed_run_goes_on_at_the_coefficient_it_stopped_at(teacher, tmp_path, monkeypatch):
    options = ("method=e2r", f"prior.path={teacher}", "schedule.methods=all", "schedule.shape=cosine")
    whole = run(tmp_path / "whole", *options)
    interrupt(monkeypatch, tmp_path / "stopped", 192, *options)
    run(tmp_path / "stopped", *options)
    names = ["eval.csv", "policy.safetensors"]
    assert [(tmp_path / "stopped" / n).read_bytes() for n in names] == [(whole / n).read_bytes() for n in names]


def test_a_schedule_that_is_not_used_is_no_part_of_a_runs_identity(teacher, tmp_path):
    out = run(tmp_path, "method=e2r", f"prior.path={teacher}", "total_frames=64")
    assert '"schedule"' not in (out / "config.json").read_text()
    run(out, "method=e2r", f"prior.path={teacher}", "total_frames=64", "schedule.until=0.3")  # finished already
    with pytest.raises(SystemExit, match="schedule"):
        run(out, "method=e2r", f"prior.path={teacher}", "total_frames=64", "schedule.methods=all")


def test_a_finished_run_is_not_run_again(teacher, capsys, monkeypatch):
    monkeypatch.setattr(agents, "Agent", None)  # would fail if it were
    run(teacher.parent)
    assert "finished already" in capsys.readouterr().out


def test_resume_false_starts_anew_and_forgets_the_old_checkpoints(tmp_path, monkeypatch, capsys):
    run(tmp_path)
    whole = (tmp_path / "eval.csv").read_bytes()
    interrupt(monkeypatch, tmp_path, 128, "resume=false")
    assert [path.name[-3:] for path in (tmp_path / "checkpoints").iterdir() if path.is_dir()] == ["064"]
    run(tmp_path)
    assert (tmp_path / "eval.csv").read_bytes() == whole
    run(tmp_path, "resume=false")
    assert "finished already" not in capsys.readouterr().out


def test_resume_false_replaces_what_is_known_of_the_teacher(teacher, tmp_path):
    options = ("method=e2r", f"prior.path={teacher}", "total_frames=64")
    run(tmp_path, *options)
    kept = (tmp_path / "teacher.json").read_bytes()
    (tmp_path / "teacher.json").write_text(kept.decode().replace("mean_return", "mean_return_of_old"))
    run(tmp_path, *options, "resume=false")
    assert (tmp_path / "teacher.json").read_bytes() == kept


def test_checkpoints_are_in_the_run_folder_wherever_home_is(tmp_path, monkeypatch):
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    monkeypatch.chdir(tmp_path)
    run(Path("~/run"), "total_frames=64")
    assert (tmp_path / "home/run/checkpoints").is_dir()
    assert not (tmp_path / "~").exists()


@pytest.mark.parametrize("content", ["[]", "x{"])
def test_a_damaged_status_is_named_and_kept(content, tmp_path):
    run(tmp_path, "total_frames=64")
    (tmp_path / "status.json").write_text(content)
    with pytest.raises(SystemExit, match=r"status\.json is damaged"):
        run(tmp_path, "total_frames=64")
    assert (tmp_path / "status.json").read_text() == content


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("method=foo", "Unknown method 'foo'"),
        ("method=ae2r", "prior.path=None"),
        ("total_frames=100", "total_frames=100: expected a multiple of env.frames_per_batch=64"),
        ("env.minibatch_size=48", "env.minibatch_size=48"),
        ("td_error=both", "td_error=both"),
        ("ppo.lr=-1", "ppo.lr=-1"),
        ("prior.prob=2", "prior.prob=2"),
        ("weight.init_bias=nan", "weight.init_bias=nan"),
        ("seed=-1", "seed=-1"),
        ("+foo=1", "foo: there is no such key"),
        ("+ppo.foo=1", "ppo.foo: there is no such key"),
        ("env.version=v99", "env=Hopper-v99"),
        ("+env.kwargs.foo=1", "foo=1"),
        ("schedule.shape=square", "schedule.shape=square: expected one of linear, cosine, piecewise"),
        ("schedule.until=0", "schedule.until=0"),
        ("schedule={shape:piecewise}", "schedule.points=[]"),
        ("schedule={shape:piecewise,points:[[0.5,1],[0.5,0]]}", "at increasing shares"),
        ("schedule={shape:piecewise,points:[1,2]}", "expected pairs"),
    ],
)
def test_bad_input_is_refused_by_name_before_anything_is_written(override, message, tmp_path):
    with pytest.raises(SystemExit, match=r"^Error") as error:
        run(tmp_path / "out", override)
    assert message in str(error.value)
    assert not (tmp_path / "out").exists()


def test_missing_foreign_and_mismatching_teachers_are_refused(teacher, tmp_path):
    foreign, empty, cut = (tmp_path / f"{name}.safetensors" for name in ("foreign", "empty", "cut"))
    foreign.write_bytes(b"not a teacher")
    empty.touch()
    cut.write_bytes(teacher.read_bytes()[:-100])
    for path, env, message in (
        (tmp_path, "hopper", "a folder, expected a file"),
        (empty, "hopper", "empty.safetensors can't be used"),
        (cut, "hopper", "cut.safetensors can't be used"),
        (tmp_path / "absent.safetensors", "hopper", "no such file"),
        (foreign, "hopper", "foreign.safetensors"),
        (teacher, "walker2d", "Hopper-v5"),
    ):
        out = tmp_path / f"{path.stem}-{env}"
        with pytest.raises(SystemExit) as error:
            run(out, f"env={env}", "method=e2r", f"prior.path={path}", "total_frames=256")
        assert message in str(error.value)
        assert not out.exists()


def test_a_teacher_of_bounded_actions_is_refused_as_students_are_gaussian(tmp_path):
    teacher = tmp_path / "bounded.safetensors"
    save_prior(
        teacher, ModulePrior(nn.Linear(11, 3), "mean", std=0.5, distribution_class=TanhNormal), env_id="Hopper-v5"
    )
    with pytest.raises(
        SystemExit, match=r"^Error: prior\.path=.*bounded\.safetensors: no student .* can learn from it"
    ):
        run(tmp_path / "out", "method=er", f"prior.path={teacher}")
    assert not (tmp_path / "out").exists()


def test_a_missing_compiler_is_told_of_before_training(tmp_path, monkeypatch):
    monkeypatch.delenv("CXX", raising=False)
    cpp_builder = pytest.importorskip("torch._inductor.cpp_builder")
    cpp_builder.cpp_compiler_search.cache_clear()
    nowhere = torch._inductor.config.patch({"cpp.cxx": (None, "no-such-compiler")})  # monkeypatch can't undo that
    with nowhere, pytest.raises(SystemExit, match=r"compile=true: no C.. compiler .* compile=false"):
        run(tmp_path / "out", "compile=true")
    cpp_builder.cpp_compiler_search.cache_clear()
    assert not (tmp_path / "out").exists()


def test_nan_losses_stop_the_run_and_keep_the_last_checkpoint(tmp_path, monkeypatch):
    def broken(self, rollout, optimise=agents.Optimiser.__call__, calls=[]):  # noqa: B006
        calls.append(None)
        losses = optimise(self, rollout)
        return losses | {"loss_objective": torch.tensor(float("nan"))} if len(calls) == 3 else losses

    with monkeypatch.context() as patch:
        patch.setattr(agents.Optimiser, "__call__", broken)
        with pytest.raises(SystemExit, match="loss_objective became NaN") as error:
            run(tmp_path, "checkpoint.interval=64")
    assert "128" in str(error.value).rsplit("checkpoint", 1)[1]
    assert '"failed"' in (tmp_path / "status.json").read_text()
    run(tmp_path)  # the cause gone, it goes on from there
    assert pd.read_csv(tmp_path / "eval.csv")["frames"].tolist() == [0, 64, 128, 192, 256]


def test_a_sweep_runs_every_combination_although_one_is_broken(tmp_path, monkeypatch, capfd):
    command = ["mujoco", "-m", "hydra/launcher=basic", *TINY, "total_frames=64"]
    command += [
        f"out={tmp_path}/${{method}}-${{seed}}",
        "method=none,e2r",
        "seed=0,1",
        f"hydra.sweep.dir={tmp_path}/sweep",
    ]
    monkeypatch.chdir(ROOT)
    monkeypatch.setenv("HYDRA_MAIN_MODULE", "__main__")  # find conf/ as the command does
    monkeypatch.setattr(sys, "argv", command)
    with pytest.raises(SystemExit) as end:
        main()
    assert end.value.code == 1
    said = capfd.readouterr()
    assert "Sweep: 2 of 4 runs are done, 2 failed." in said.out
    for seed in range(2):
        assert f"Failed: method=e2r seed={seed}: Error: prior.path=None" in said.err
    assert {path.parent.name for path in tmp_path.glob("*/policy.safetensors")} == {"none-0", "none-1"}


def test_the_best_baseline_over_seeds_becomes_the_teacher(teacher, tmp_path):
    out = run(tmp_path / "other", "seed=1", "total_frames=128")
    best = tmp_path / "best.safetensors"
    cfg = ExportConfig([str(teacher.parent), str(out)], "Hopper-v5", str(best), "none")
    export(cfg)
    returns = {folder: pd.read_csv(folder / "eval.csv")["mean_return"].iloc[-1] for folder in (teacher.parent, out)}
    winner = max(returns, key=returns.__getitem__)
    assert best.read_bytes() == (winner / "policy.safetensors").read_bytes()
    cfg.env_id = "Ant-v5"
    with pytest.raises(ValueError, match="No finished run of method=none on env_id=Ant-v5"):
        export(cfg)
    config = out / "config.yaml"
    config.write_text(config.read_text().replace("kwargs: {}", "kwargs: {ctrl_cost_weight: 0.1}"))
    cfg.env_id = "Hopper-v5 (ctrl_cost_weight=0.1)"
    export(cfg)
    assert best.read_bytes() == (out / "policy.safetensors").read_bytes()
