"""``recipes.show_weight`` and what it watches: the very run of a study, the very networks of a checkpoint."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest
import torch
from composed import composed as config
from omegaconf import OmegaConf
from tensordict import TensorDict

from recipes.gridworld.study import TaughtWorld, make_learner, run_world
from recipes.show_weight.show import mean_over, show
from torchrl_priors import load_prior

SMALL = ["worlds=2", "teacher.steps=100", "evaluation.points=3", "evaluation.interval=20"]


def test_weights_are_of_the_very_run_of_the_study():
    study = config("gridworld", *SMALL, "methods=[none,aligned]", "priors=[structural_3]", "seed=5")
    study.evaluation.interval = 500  # until something was found
    learner = make_learner(study, "aligned")
    episodes = run_world(study, 6, {"none": make_learner(study, "none"), "aligned": learner}, lambda steps: None)
    taught = TaughtWorld(study, 6)
    log, weights, visits = taught.train("aligned", "structural_3", taught.advice("structural_3"), learner, watch=True)
    assert np.array_equal(log.astype(np.float32), episodes["episodes"][1])
    assert weights.shape == visits.shape == (3, 400)
    assert np.abs(weights[-1] - 0.5).max() > 0


def test_means_are_over_the_states_visited_by_then():
    weights, visits = np.array([[0.2, 0.4, 0.9]]), np.array([[3, 1, 0]])
    assert mean_over(np.array([True, True, True]), weights, visits).item() == pytest.approx(0.3)
    assert np.isnan(mean_over(np.array([False, False, True]), weights, visits)).all()


def test_maps_of_a_study_are_made_from_its_configuration_alone(tmp_path):
    OmegaConf.save(config("gridworld", *SMALL, "methods=[none,ae2r]"), tmp_path / "config.yaml")
    files = show(config("show_weight", f"run={tmp_path}", "gridworld.points=[1,3]", "seed=1"))
    assert [file.name for file in files] == [
        "weight_aligned_structural_10_1.pdf",
        "weight_aligned_structural_10_1.png",
    ]
    assert all(file.stat().st_size > 5000 for file in files)


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("gridworld.method=kickstart", "gridworld.method=kickstart: it has no learned weight"),
        ("gridworld.points=[0]", "gridworld.points=[0]"),
        ("seed=2", "has worlds 0 to 1"),
        ("+foo=1", "foo: there is no such key"),
        ("run=nowhere", "run=nowhere: no run or study is there"),
    ],
)
def test_bad_input_is_refused_by_name(override, message, tmp_path):
    OmegaConf.save(config("gridworld", *SMALL), tmp_path / "config.yaml")
    with pytest.raises(ValueError) as error:  # noqa: PT011
        show(config("show_weight", f"run={tmp_path}", override))
    assert message in str(error.value)


TINY = ["env.num_envs=2", "env.frames_per_batch=64", "env.minibatch_size=32", "total_frames=64", "ppo.epochs=1"]
TINY += ["ppo.hidden=[8]", "evaluation.episodes=2", "compile=false"]


@pytest.fixture(scope="module")
def mujoco_run(tmp_path_factory) -> Path:
    """A run of AE2R with a teacher that is wrong in part of the states."""
    pytest.importorskip("mujoco")
    from mujoco_cases import without_records

    from recipes.mujoco import train

    folder = tmp_path_factory.mktemp("mujoco")
    options = ["method=ae2r", f"prior.path={folder}/teacher/policy.safetensors", "prior.degrade=structural"]
    with without_records():
        train.run(config("mujoco", *TINY, f"out={folder}/teacher"))
        train.run(config("mujoco", *TINY, f"out={folder}/run", *options))
    return folder / "run"


def test_an_episode_is_weighed_by_the_networks_of_the_checkpoint(mujoco_run, tmp_path):
    from recipes.show_weight.episode import load_agent, play, weigh

    agent, env_id = load_agent(mujoco_run, None)
    exported = load_prior(mujoco_run / "policy.safetensors")
    raw = TensorDict(observation=torch.randn(5, 11), batch_size=[5])
    normal = TensorDict(observation_norm=agent.normalizer(raw["observation"]), batch_size=[5])
    torch.testing.assert_close(agent.actor.get_dist(normal).mean, exported.get_dist(raw).mean)
    episode = play(agent, env_id, seed=3, steps=30)
    seen = weigh(agent, episode)
    assert seen["degraded"].tolist() == (episode["observation"][:, 1] > 0).tolist()
    assert seen["weight"].shape == seen["td_error"].shape == seen["log_prob"].shape == episode.shape
    again = play(load_agent(mujoco_run, None)[0], env_id, seed=3, steps=30)
    assert torch.equal(again["observation"], episode["observation"])
    files = show(config("show_weight", f"run={mujoco_run}", f"out={tmp_path}", "seed=3", "episode.steps=30"))
    assert [file.name for file in files] == ["weight_episode_3.pdf", "weight_episode_3.png"]


def test_another_teacher_is_refused(mujoco_run, tmp_path):
    from recipes.show_weight.episode import load_agent

    with pytest.raises(ValueError, match="is not the teacher of"):
        load_agent(mujoco_run, str(mujoco_run / "policy.safetensors"))
    with pytest.raises(ValueError, match=r"absent\.safetensors is not there"):
        load_agent(mujoco_run, str(tmp_path / "absent.safetensors"))


def refused(folder: Path) -> str:
    """Why a run is not shown, in one line."""
    cfg = config("show_weight", "run=.", "gridworld.points=[1]", "episode.steps=3")
    cfg.run = str(folder)
    with pytest.raises((ValueError, OSError)) as error:
        show(cfg)
    message = str(error.value)
    assert "\n" not in message
    return message


@pytest.mark.parametrize(
    "text",
    [
        "worlds: 2\nseed: ${oc.env:SECRET}\n",
        "worlds: 2\nstudent: {lr: ['${oc.env:SECRET}']}\n",
        "method: ae2r\nprior: {path: '${oc.env:SECRET}'}\n",
    ],
)
def test_nothing_is_looked_up_for_a_configuration(text, tmp_path, monkeypatch):
    monkeypatch.setenv("SECRET", "geheim")
    (tmp_path / "config.yaml").write_text(text)
    message = refused(tmp_path)
    assert "refers to something else" in message
    assert "geheim" not in message


@pytest.mark.parametrize(
    "content",
    [
        b"",
        b"- 1\n",
        b"\xff\xfe",
        b"worlds: 2",
        b"worlds: [",
        b"worlds: x\nevaluation: {points: 3}",
        b"worlds: ${",
        b"method: ae2r",
        b"method: [ae2r]",
        b"method: none",
        b"{[1]: 2}",
        b"!!python/object/apply:os.system [x]",
    ],
)
def test_a_damaged_configuration_is_named(content, tmp_path):
    (tmp_path / "config.yaml").write_bytes(content)
    refused(tmp_path)


def test_a_damaged_run_is_named(mujoco_run, tmp_path):
    folder = Path(shutil.copytree(mujoco_run, tmp_path / "run"))
    (checkpoint,) = (path.name for path in (mujoco_run / "checkpoints").iterdir() if path.is_dir())

    def damage(file: str, content: bytes | None) -> str:
        if content is None:
            (folder / file).unlink()
        else:
            (folder / file).write_bytes(content)
        message = refused(folder)
        (folder / file).write_bytes((mujoco_run / file).read_bytes())
        return message

    whole = (mujoco_run / "config.yaml").read_bytes()
    for content in (None, b"", b"[]", b"{}", b'{"prior": null}', b'{"prior": {}}'):
        damage("config.json", content)
    for content in (b"", whole[: len(whole) // 2], whole.replace(b"- 8", b"- 9"), whole.replace(b"v5", b"v99")):
        damage("config.yaml", content)
    for file in sorted((mujoco_run / "checkpoints" / checkpoint).rglob("*.memmap"))[::5]:
        relative = file.relative_to(mujoco_run)
        assert f"{file.name} is damaged" in damage(str(relative), b"")
        assert f"{file.name} is missing" in damage(str(relative), None)
