"""Where the transforms may run: collectors, replay buffers, compositions, plain calls; and where not: environments."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import partial

import pytest
import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import ProbabilisticTensorDictModule, ProbabilisticTensorDictSequential
from torch import distributions as d
from torchrl.collectors import Collector, MultiSyncCollector
from torchrl.data import LazyTensorStorage, ReplayBuffer, TensorDictReplayBuffer
from torchrl.data.replay_buffers import SamplerWithoutReplacement, SliceSampler
from torchrl.envs import (
    Compose,
    EnvBase,
    ParallelEnv,
    RewardScaling,
    SerialEnv,
    Transform,
    TransformedEnv,
    check_env_specs,
)
from trajectories import (
    ACTIONS,
    ACTOR_TABLE,
    PRIOR_TABLE,
    STATES,
    ChainEnv,
    actor,
    chain_with_time_limit,
    prior,
    trajectories,
)

from torchrl_priors.prior_weight import PriorWeight
from torchrl_priors.priors import BoltzmannPrior
from torchrl_priors.state_table import StateTable
from torchrl_priors.transforms import PriorBonus, PriorLogProb

TRANSFORMS: dict[str, Callable[[], Transform]] = {
    "log_prob": lambda: PriorLogProb(prior(), actor()),
    "bonus": lambda: PriorBonus(PriorWeight.table(STATES)),
    "compose": lambda: Compose(RewardScaling(0.0, 1.0), PriorLogProb(prior(), actor())),
}


@pytest.fixture(params=TRANSFORMS)
def transform(request: pytest.FixtureRequest) -> Transform:
    return TRANSFORMS[request.param]()


def bad_env(name: str) -> EnvBase:
    return TransformedEnv(ChainEnv(), TRANSFORMS[name]())


def shaped(time_dim: int | None = None) -> Compose:
    return Compose(PriorLogProb(prior(), actor(), time_dim=time_dim), PriorBonus(PriorWeight.constant(0.5)))


KNOWN = {"auto_register_policy_transforms": False}  # the default of 0.14, which warns that it will change
KEYS = ["prior_log_prob", ("next", "prior_log_prob"), ("next", "prior_bonus"), ("next", "shaped_reward")]


def test_the_environment_of_these_tests_is_sound() -> None:
    check_env_specs(chain_with_time_limit())


class TestEnvironmentsAreRefused:
    MESSAGE = "reads whole trajectories"

    def test_a_single_environment_refuses_the_transform(self, transform: Transform) -> None:
        with pytest.raises(ValueError, match=self.MESSAGE):
            TransformedEnv(ChainEnv(), transform)

    def test_an_environment_refuses_a_transform_that_is_appended(self, transform: Transform) -> None:
        env = TransformedEnv(ChainEnv(), Compose())
        with pytest.raises(ValueError, match=self.MESSAGE):
            env.append_transform(transform)

    def test_a_transformed_serial_env_refuses_the_transform(self, transform: Transform) -> None:
        with pytest.raises(ValueError, match=self.MESSAGE):
            TransformedEnv(SerialEnv(2, ChainEnv), transform)

    def test_a_transformed_parallel_env_refuses_the_transform(self, transform: Transform) -> None:
        with pytest.raises(ValueError, match=self.MESSAGE):
            TransformedEnv(ParallelEnv(2, ChainEnv), transform)

    @pytest.mark.parametrize("name", TRANSFORMS)
    @pytest.mark.parametrize("kind", [SerialEnv, ParallelEnv])
    def test_environments_inside_serial_and_parallel_ones_refuse_the_transform(self, kind: type, name: str) -> None:
        with pytest.raises(ValueError, match=self.MESSAGE):
            kind(2, partial(bad_env, name)).rollout(2)


class TestPlainCalls:
    def test_a_batch_of_no_environment_gets_an_entry_per_step(self) -> None:
        batch = shaped(time_dim=1)(trajectories(2, 5))
        for key in KEYS:
            assert batch[key].shape == (2, 5, 1)

    def test_compose_is_one_after_the_other(self) -> None:
        expected = PriorBonus(PriorWeight.constant(0.5))(PriorLogProb(prior(), actor(), time_dim=1)(trajectories(2, 5)))
        assert (shaped(time_dim=1)(trajectories(2, 5)) == expected).all()

    def test_the_inverse_of_a_transform_does_nothing(self) -> None:
        batch = trajectories(2, 5)
        assert (shaped().inv(batch.clone()) == batch).all()

    def test_a_rollout_is_a_batch_that_transforms_take(self) -> None:
        env = chain_with_time_limit()
        batch = shaped()(env.rollout(10, actor(), break_when_any_done=False))
        assert all(key in batch.keys(True) for key in KEYS)
        assert (batch["next", "prior_bonus"][batch["next", "terminated"]] == 0).all()

    def test_a_rollout_of_several_environments_is_shifted_along_time(self) -> None:
        batch = shaped()(ChainEnv((3,)).rollout(6, actor(), break_when_any_done=False))
        assert batch["next", "prior_log_prob"].shape == (3, 6, 1)


class TestReplayBuffer:
    def test_a_buffer_stores_what_the_transforms_write_to_the_whole_batch(self) -> None:
        buffer = TensorDictReplayBuffer(storage=LazyTensorStorage(100), batch_size=4)
        buffer.append_transform(shaped(time_dim=0), invert=True)
        buffer.extend(trajectories(10))
        expected = shaped(time_dim=0)(trajectories(10))
        stored = buffer[:]
        for key in KEYS:
            assert torch.equal(stored[key], expected[key])
        # random steps have no time to run along: what was written is what is read
        sample = buffer.sample()
        for index, step in zip(sample["index"], sample.unbind(0), strict=True):
            assert torch.equal(step["next", "prior_log_prob"], expected["next", "prior_log_prob"][index])

    def test_extend_with_environments_as_a_dimension(self) -> None:
        buffer = ReplayBuffer(storage=LazyTensorStorage(100, ndim=2), batch_size=4)
        buffer.append_transform(shaped(), invert=True)
        batch = trajectories(2, 10)
        batch.names = [None, "time"]
        buffer.extend(batch)
        expected = shaped(time_dim=1)(trajectories(2, 10))
        assert torch.equal(buffer[:]["next", "shaped_reward"], expected["next", "shaped_reward"])

    def test_sample_of_whole_trajectories(self) -> None:
        buffer = ReplayBuffer(
            storage=LazyTensorStorage(3),
            sampler=SamplerWithoutReplacement(),
            batch_size=3,
            transform=shaped(time_dim=1),
        )
        buffer.extend(trajectories(3, 5))
        sample = buffer.sample()
        expected = shaped(time_dim=1)(sample.exclude(*KEYS))
        for key in KEYS:
            assert sample[key].shape == (3, 5, 1)
            assert torch.equal(sample[key], expected[key])

    def test_slices_of_a_buffer_are_shifted_apart(self) -> None:
        steps = trajectories(40, ends=0.1)
        trajectory = torch.cat([torch.zeros(1), steps["next", "done"].squeeze(-1)[:-1].cumsum(0)]).long()
        steps["collector", "traj_ids"] = trajectory
        buffer = ReplayBuffer(
            storage=LazyTensorStorage(40),
            sampler=SliceSampler(slice_len=3, traj_key=("collector", "traj_ids")),
            batch_size=12,
            transform=lambda batch: batch.reshape(-1, 3),  # slices of one trajectory may follow each other
        )
        buffer.append_transform(shaped(time_dim=1))
        buffer.extend(steps)
        sample = buffer.sample()
        log_probs = PRIOR_TABLE.log_softmax(-1)[sample["state"], sample["action"]]
        torch.testing.assert_close(sample["prior_log_prob"].squeeze(-1), log_probs)
        torch.testing.assert_close(sample["next", "prior_log_prob"][:, :-1, 0], log_probs[:, 1:])
        alone = shaped(time_dim=0)(sample[2].exclude(*KEYS))
        assert torch.equal(alone["next", "prior_log_prob"], sample[2]["next", "prior_log_prob"])

    def test_step_of_a_buffer_without_a_time_dimension_is_refused(self) -> None:
        buffer = ReplayBuffer(storage=LazyTensorStorage(100), batch_size=4, transform=shaped())
        buffer.extend(trajectories(10))
        with pytest.raises(ValueError, match="time"):
            buffer.sample()


class TestCollectors:
    @pytest.mark.parametrize("make_env", [chain_with_time_limit, partial(ChainEnv, (3,))])
    def test_postproc_of_a_collector_writes_what_a_plain_call_does(self, make_env: Callable[[], EnvBase]) -> None:
        collector = Collector(make_env, actor(), frames_per_batch=30, total_frames=90, postproc=shaped(), **KNOWN)
        batches = list(self.closing(collector))
        assert len(batches) == 3
        for batch in batches:
            plain = batch.exclude(*KEYS)
            plain.names = [*[None] * (batch.ndim - 1), "time"]
            expected = shaped()(plain)
            for key in KEYS:
                assert batch[key].shape == (*batch.batch_size, 1)
                assert torch.equal(batch[key], expected[key])
        assert any(batch["next", "done"].any() for batch in batches)

    def test_collected_actions_of_the_student_are_scored(self) -> None:
        collector = Collector(
            chain_with_time_limit, actor(), frames_per_batch=30, total_frames=30, postproc=shaped(), **KNOWN
        )
        (batch,) = self.closing(collector)
        log_probs = PRIOR_TABLE.log_softmax(-1)[batch["state"], batch["action"]]
        torch.testing.assert_close(batch["prior_log_prob"].squeeze(-1), log_probs)
        goes_on = ~batch["next", "done"][:-1, 0]
        assert goes_on.any()
        torch.testing.assert_close(batch["next", "prior_log_prob"][:-1, 0][goes_on], log_probs[1:][goes_on])

    def test_seams_of_a_multi_process_collector(self) -> None:
        collector = MultiSyncCollector(
            [chain_with_time_limit] * 2, actor(), frames_per_batch=10, total_frames=10, cat_results=0, **KNOWN
        )
        (batch,) = self.closing(collector)
        batch = PriorLogProb(prior(), actor(), time_dim=0)(batch)
        seam, ids = 4, batch["collector", "traj_ids"]
        assert ids[seam] != ids[seam + 1]
        for worker in (batch[:5], batch[5:]):
            alone = PriorLogProb(prior(), actor(), time_dim=0)(worker.clone())
            assert torch.equal(alone["next", "prior_log_prob"], worker["next", "prior_log_prob"])

    @staticmethod
    def closing(collector: Collector) -> Iterator[TensorDictBase]:
        try:
            yield from (batch.clone() for batch in collector)
        finally:
            collector.shutdown()


class TestKeysAndErrors:
    def test_transforms_read_and_write_nested_keys(self) -> None:
        def nest(batch: TensorDict, *keys: str) -> TensorDict:
            for key in keys:
                batch["agent", key] = batch.pop(key)
            return batch

        plain = trajectories(2, 5)
        nested = nest(plain.clone(), "state", "action")
        nested["next"] = nest(nested["next"], "state", "reward", "done", "terminated")
        nested["agent", "ids"] = torch.zeros(2, 5)
        teacher = BoltzmannPrior(PRIOR_TABLE, in_keys=[("agent", "state")])
        teacher.set_keys(action=("agent", "action"))
        student = ProbabilisticTensorDictSequential(
            StateTable(ACTOR_TABLE, in_key=("agent", "state"), out_key=("agent", "logits"), feature_dims=1),
            ProbabilisticTensorDictModule(
                {"logits": ("agent", "logits")}, [("agent", "action")], distribution_class=d.Categorical
            ),
        )
        PriorLogProb(
            teacher,
            student,
            time_dim=1,
            out_keys=[("agent", "lp")],
            done_key=("agent", "done"),
            terminated_key=("agent", "terminated"),
            traj_key=("agent", "ids"),
        )(nested)
        PriorBonus(
            PriorWeight.table(STATES, key=("agent", "state"), out_keys=[("agent", "w")]),
            reward_key=("agent", "reward"),
            terminated_key=("agent", "terminated"),
            log_prob_key=("agent", "lp"),
            out_keys=[("next", "agent", "bonus"), ("next", "agent", "shaped")],
        )(nested)
        PriorLogProb(prior(), actor(), time_dim=1)(plain)
        PriorBonus(PriorWeight.table(STATES))(plain)
        assert torch.equal(nested["agent", "lp"], plain["prior_log_prob"])
        assert torch.equal(nested["next", "agent", "lp"], plain["next", "prior_log_prob"])
        assert torch.equal(nested["next", "agent", "bonus"], plain["next", "prior_bonus"])
        assert torch.equal(nested["next", "agent", "shaped"], plain["next", "shaped_reward"])

    def test_boundaries_that_need_the_student_say_so(self) -> None:
        for kwargs in ({}, {"boundary": "sample"}):
            with pytest.raises(ValueError, match="needs the student"):
                PriorLogProb(prior(), **kwargs)
        PriorLogProb(prior(), boundary="zero", time_dim=0)(trajectories(4))

    def test_unknown_settings_are_refused(self) -> None:
        with pytest.raises(ValueError, match=r"boundary must be .*'guess'"):
            PriorLogProb(prior(), actor(), boundary="guess")
        with pytest.raises(ValueError, match="one key"):
            PriorLogProb(prior(), actor(), out_keys=["log_prob", "other"])

    @pytest.mark.parametrize("key", ["state", "action", ("next", "terminated"), ("next", "done"), ("next", "state")])
    def test_missing_entries_are_named(self, key: str | tuple[str, ...]) -> None:
        with pytest.raises(KeyError, match=key if isinstance(key, str) else key[-1]):
            PriorLogProb(prior(), actor(), time_dim=0)(trajectories(4, ends=0.0).exclude(key))

    def test_flags_of_another_shape_are_refused(self) -> None:
        batch = trajectories(4)
        batch["next", "done"] = batch["next", "done"].squeeze(-1)
        with pytest.raises(ValueError, match=r"Expected .*done"):
            PriorLogProb(prior(), actor(), time_dim=0)(batch)

    @pytest.mark.parametrize("actions", [ACTIONS - 1, ACTIONS + 1])
    def test_another_number_of_actions_is_refused(self, actions: int) -> None:
        batch = trajectories(40)
        with pytest.raises(ValueError, match="actions"):
            PriorLogProb(BoltzmannPrior(torch.zeros(STATES, actions)), actor(), time_dim=0)(batch)
        assert set(batch.keys(True, True)) == set(trajectories(40).keys(True, True))

    def test_one_hot_prior_of_a_student_with_indices_is_refused(self) -> None:
        teacher = BoltzmannPrior(PRIOR_TABLE, distribution_class=d.OneHotCategorical)
        with pytest.raises(ValueError, match="action space"):
            PriorLogProb(teacher, actor(), time_dim=0)(trajectories(4))
