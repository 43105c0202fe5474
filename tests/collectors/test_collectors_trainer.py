"""The collector in the place of one of TorchRL's: in its trainers, and in loops that users write."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from collectors_cases import gaussian, same, scripts
from tensordict import TensorDict
from torch import nn
from torchrl.collectors import Collector
from torchrl.data import LazyTensorStorage, SamplerWithoutReplacement, TensorDictReplayBuffer
from torchrl.modules import ValueOperator
from torchrl.objectives import ClipPPOLoss
from torchrl.trainers import Trainer, UpdateWeights
from torchrl.trainers.algorithms import PPOTrainer

from torchrl_priors import ActionPrior, AE2RLoss, ClipPPOPriorLoss, PriorShaping, PriorWeight
from torchrl_priors.collectors import VectorCollector, make_vector_env


def collector(policy: Any = None, **kwargs: Any) -> VectorCollector:
    env = scripts([3, 2], [4], [5, 1])
    return VectorCollector(
        env, policy or gaussian(3, 2), **{"frames_per_batch": 6, "total_frames": 18, "seed": 0, **kwargs}
    )


def critic(observations: int = 3) -> ValueOperator:
    return ValueOperator(nn.Linear(observations, 1), in_keys=["observation"])


def on_policy(loss: nn.Module, collector: VectorCollector, kind: Callable[..., Trainer], **kwargs: Any) -> Trainer:
    return kind(
        collector=collector,
        total_frames=collector.total_frames,
        frame_skip=1,
        loss_module=loss,
        optimizer=torch.optim.Adam(loss.parameters(), lr=1e-2),
        optim_steps_per_batch=2,
        progress_bar=False,
        seed=3,
        **kwargs,
    )


def buffer(size: int) -> TensorDictReplayBuffer:
    return TensorDictReplayBuffer(
        storage=LazyTensorStorage(size), sampler=SamplerWithoutReplacement(), batch_size=size // 2
    )


class TestTrainers:
    @pytest.mark.parametrize("functional", [True, False])
    @pytest.mark.parametrize("logging", [True, False])
    def test_ppo_trainer_trains_the_actor_of_a_vector_collector(self, functional: bool, logging: bool) -> None:
        actor = gaussian(3, 2)
        parts = ActionPrior(gaussian(3, 2)), PriorWeight(nn.Linear(3, 1)), critic()
        prior_loss = AE2RLoss(actor, *parts, method="ae2r", functional=functional)
        loss = ClipPPOPriorLoss(actor, critic(), prior_loss)
        data = collector(actor)
        before = [parameter.detach().clone() for parameter in actor.parameters()]
        trainer = on_policy(
            loss,
            data,
            PPOTrainer,
            num_epochs=2,
            replay_buffer=buffer(6),
            enable_logging=logging,
            reward_key=loss.tensor_keys.reward,
        )
        PriorShaping().register(trainer)
        trainer.train()
        assert trainer.collected_frames == data.frames == 18
        assert all(parameter.isfinite().all() for parameter in actor.parameters())
        assert not all(torch.equal(old, new) for old, new in zip(before, actor.parameters(), strict=True))
        assert data.env.closed

    def test_the_trainer_itself_with_a_hook_that_sends_weights(self) -> None:
        actor, twin = gaussian(3, 2), gaussian(3, 2)
        data = collector(twin)
        loss = ClipPPOLoss(actor, critic())
        loss.make_value_estimator()
        trainer = on_policy(loss, data, Trainer)
        trainer.register_op("batch_process", loss.value_estimator)
        hook = UpdateWeights(data, 1, policy_weights_getter=lambda: TensorDict.from_module(loss.actor_network))
        trainer.register_op("post_steps", hook)
        trainer.train()
        params = zip(loss.actor_network_params.flatten_keys().values(), twin.parameters(), strict=True)
        assert all(torch.equal(ours, theirs) for ours, theirs in params)

    def test_a_trainer_saves_its_state_and_takes_it_again(self, tmp_path: Path) -> None:
        def make() -> Trainer:
            actor = gaussian(11, 3)
            loss = ClipPPOLoss(actor, critic(11))
            env = make_vector_env("Hopper-v5", 2)
            data = VectorCollector(env, actor, frames_per_batch=8, total_frames=16, seed=0)
            return on_policy(loss, data, PPOTrainer, replay_buffer=buffer(8), num_epochs=1, enable_logging=False)

        trainer, other = make(), make()
        trainer.collector.rollout()
        other.load_state_dict(trainer.state_dict())
        assert other.collector.frames == 8
        first, second = trainer.collector.rollout(), other.collector.rollout()
        assert same(first, second)

    def test_a_vector_collector_does_not_collect_in_the_background(self) -> None:
        with pytest.raises(NotImplementedError, match="async_collection=False"):
            collector().start()


class TestLoops:
    def test_every_public_name_that_a_loop_uses_is_torchrls(self) -> None:
        for name in ("reset", "shutdown", "async_shutdown", "set_seed", "update_policy_weights_"):
            ours = inspect.signature(getattr(VectorCollector, name)).parameters
            theirs = inspect.signature(getattr(Collector, name)).parameters
            shared = [key for key, value in theirs.items() if value.kind is not value.VAR_KEYWORD]
            assert [key for key in ours if key in shared] == shared
        for name in (
            "next",
            "iterator",
            "rollout",
            "start",
            "state_dict",
            "load_state_dict",
            "requested_frames_per_batch",
        ):
            assert hasattr(VectorCollector, name)
            assert hasattr(Collector, name) or name == "requested_frames_per_batch"

    def test_a_loop_over_a_collector_ends_after_its_length(self) -> None:
        data = collector()
        assert len(data) == 3
        for number, batch in enumerate(data):  # noqa: B007
            data.update_policy_weights_()
        assert number + 1 == len(data)
        assert data.next() is None
        assert batch.numel() == data.requested_frames_per_batch
        for _ in range(2):
            data.shutdown(timeout=1.0, close_env=True)
        assert data.env.closed

    def test_without_an_end_it_has_no_length(self) -> None:
        data = collector(total_frames=-1)
        assert data
        with pytest.raises(RuntimeError, match="has no length"):
            len(data)
        assert next(data.iterator()).shape == (3, 2)

    def test_a_seed_leads_to_another(self) -> None:
        policy = gaussian(3, 2)
        data, other = collector(policy, seed=1), collector(policy, seed=2)
        assert data.set_seed(5, static_seed=True) == 5 == other.set_seed(5, static_seed=True)
        assert data.set_seed(5) == 6 == other.set_seed(5)
        assert same(data.rollout(), other.rollout())
        torch.manual_seed(data.set_seed(None))

    def test_a_reset_begins_new_episodes(self) -> None:
        data = collector()
        data.rollout()
        data.reset(1)
        first = data.rollout()
        assert first["observation"][:, 0, 2].tolist() == [2.0, 0.0, 2.0]  # the step in the episode
        assert first["next", "step_count"][:, 0, 0].tolist() == [3, 1, 3]
        assert first["next", "episode_reward"][1, 0].item() == 1
        before = first["collector", "traj_ids"].max()
        data.reset()
        second = data.rollout()
        assert (second["next", "step_count"][:, 0] == 1).all()
        assert (second["collector", "traj_ids"] > before).all()

    def test_weights_of_every_kind_are_copied_into_the_policy(self) -> None:
        source = gaussian(3, 2)
        weights = TensorDict.from_module(source)
        for args, kwargs in (
            ((source,), {}),
            ((weights,), {}),
            ((source.state_dict(),), {}),
            ((), {"weights": weights}),
            ((), {"policy": source, "model_id": "policy"}),
            ((), {"weights_dict": {"policy": weights}}),
        ):
            data = collector()
            data.update_policy_weights_(*args, **kwargs)
            assert all(torch.equal(a, b) for a, b in zip(source.parameters(), data.policy.parameters(), strict=True))
            assert all(parameter.requires_grad for parameter in data.policy.parameters())

    @pytest.mark.parametrize(
        ("error", "args", "kwargs"),
        [
            (TypeError, (3,), {}),
            (TypeError, (gaussian(3, 2),), {"weights": {}}),
            (ValueError, (), {"worker_ids": 0}),
            (ValueError, (), {"weights_dict": {"critic": {}}}),
            (KeyError, (nn.Linear(2, 2),), {}),
            (RuntimeError, ({},), {}),
            (RuntimeError, (gaussian(4, 2),), {}),
        ],
    )
    def test_weights_of_others_are_refused(self, error: Any, args: Any, kwargs: Any) -> None:
        with pytest.raises(error):
            collector().update_policy_weights_(*args, **kwargs)

    def test_an_error_at_the_end_is_raised_unless_it_shall_not(self, monkeypatch: pytest.MonkeyPatch) -> None:
        data = collector()

        def fail() -> None:
            raise OSError("gone")

        monkeypatch.setattr(data.env, "close", fail)
        data.shutdown(close_env=False)
        data.shutdown(raise_on_error=False)
        with pytest.raises(OSError, match="gone"):
            data.shutdown()
