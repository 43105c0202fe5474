"""``recipes.show_weight`` and what it watches: the very run of a study, the very networks of a checkpoint."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from hydra import compose, initialize_config_dir
from omegaconf import DictConfig, OmegaConf
from tabular_cases import Study, play, read_tables
from tensordict import TensorDict

from recipes.show_weight import show
from torchrl_priors.tabular import LOG_FIELDS, train_students, weight_history

ROOT = Path(__file__).parents[1]
SMALL = ["worlds=2", "teacher.steps=100", "evaluation.points=3", "evaluation.interval=20", "compile=false"]


def config(name: str, *overrides: object) -> DictConfig:
    with initialize_config_dir(str(ROOT / "conf"), version_base="1.3"):
        return compose(name, overrides=[str(override) for override in overrides])


def test_a_history_is_of_the_very_run_of_the_study():
    study = Study.small([("aligned", "structural_3")], worlds=1, eval_interval=30, eval_points=3)
    args = (study.worlds, study.seeds, study.q, study.degraded, study.pairs, study.config)
    history = weight_history(study.worlds, 0, *args[2:4], study.pairs[0], study.config)
    assert history.weight.shape == history.visits.shape == (3, study.states)
    # the same steps, watched by the tests' own loop
    _, steps, _, runs = play(study, 600)
    ends = [n for n, step in enumerate(steps) if step.after.points[0] > step.before.points[0]]
    for point, end in enumerate(ends):
        tables = read_tables(steps[end].records, len(runs.key))
        torch.testing.assert_close(history.weight[point], tables.weight[0].sigmoid(), rtol=0, atol=1e-6)
        trained = [int(step.state[0]) for step in steps[: end + 1] if not step.before.evaluating[0]]
        assert history.visits[point].tolist() == torch.bincount(torch.tensor(trained), minlength=study.states).tolist()
    assert len(ends) == 3
    assert (history.weight[-1] - 0.5).abs().max() > 0.01
    # and the study's log of the weights that evaluation episodes met is of these weights
    log = train_students(*args)[0, 0]
    met = log[:, LOG_FIELDS.index("w_other")] / log[:, LOG_FIELDS.index("n_other")]
    for point, mean in enumerate(met.tolist()):
        assert history.weight[point].min() - 1e-6 <= mean <= history.weight[point].max() + 1e-6


def test_means_are_over_the_states_visited_by_then():
    study = Study.small([("ae2r", "expert")], worlds=1, eval_interval=10, eval_points=1)
    history = weight_history(study.worlds, 0, study.q, study.degraded, study.pairs[0], study.config)
    history = history._replace(weight=torch.tensor([[0.2, 0.4, 0.9]]), visits=torch.tensor([[3, 1, 0]]))
    everywhere = torch.tensor([True, True, True])
    assert history.mean_over(everywhere).item() == pytest.approx(0.3)
    assert history.mean_over(torch.tensor([False, False, True])).isnan().all()


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
    from recipes.mujoco import train
    from recipes.mujoco_config import check
    from recipes.mujoco_run import supervise

    folder = tmp_path_factory.mktemp("mujoco")
    supervise(config("mujoco", *TINY, f"out={folder}/teacher"), check, train)
    options = ["method=ae2r", f"prior.path={folder}/teacher/policy.safetensors", "prior.degrade=structural"]
    supervise(config("mujoco", *TINY, f"out={folder}/run", *options), check, train)
    return folder / "run"


def test_an_episode_is_weighed_by_the_networks_of_the_checkpoint(mujoco_run, tmp_path):
    from recipes.show_episode import load_agent, play, weigh
    from torchrl_priors.artifacts import load_policy

    agent, env_id = load_agent(mujoco_run, None)
    exported, norm, _ = load_policy(mujoco_run / "policy.safetensors")
    observation = torch.randn(5, 11)
    ours, theirs = (
        actor.get_dist(TensorDict({"observation_norm": normalizer(observation)}, [5])).mean
        for actor, normalizer in ((agent.actor, agent.normalizer), (exported, norm))
    )
    torch.testing.assert_close(ours, theirs)
    episode = play(agent, env_id, seed=3, steps=30)
    seen = weigh(agent, episode)
    assert seen["degraded"].tolist() == (episode["observation"][:, 1] > 0).tolist()
    assert seen["weight"].shape == seen["td_error"].shape == seen["log_prob"].shape == episode.shape
    again = play(load_agent(mujoco_run, None)[0], env_id, seed=3, steps=30)
    assert torch.equal(again["observation"], episode["observation"])
    files = show(config("show_weight", f"run={mujoco_run}", f"out={tmp_path}", "seed=3", "episode.steps=30"))
    assert [file.name for file in files] == ["weight_episode_3.pdf", "weight_episode_3.png"]


def test_another_teacher_is_refused(mujoco_run, tmp_path):
    from recipes.show_episode import load_agent

    with pytest.raises(ValueError, match="is not the teacher of"):
        load_agent(mujoco_run, str(mujoco_run / "policy.safetensors"))
    with pytest.raises(ValueError, match=r"absent\.safetensors is not there"):
        load_agent(mujoco_run, str(tmp_path / "absent.safetensors"))
