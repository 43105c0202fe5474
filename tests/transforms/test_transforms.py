"""Claims about PriorLogProb: the shift above all, which is checked against a loop over time."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from typing import Any

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from tensordict import LazyStackedTensorDict, TensorDictBase
from tensordict.nn import NormalParamExtractor
from tensordict.nn import TensorDictModule as Mod
from torch import distributions as d
from torch import nn
from torchrl.envs import Compose
from torchrl.modules import IndependentNormal, ProbabilisticActor, TanhNormal
from trajectories import (
    ACTIONS,
    ACTOR_LOGITS,
    ACTOR_TABLE,
    CROSS_ENTROPY,
    PRIOR_LOGITS,
    PRIOR_TABLE,
    STATES,
    actor,
    prior,
    table,
    tabular_actor,
    trajectories,
)

from torchrl_priors.degradation import RandomDegradation, StructuralDegradation
from torchrl_priors.functional import categorical_cross_entropy, gaussian_cross_entropy
from torchrl_priors.objectives import AE2RLoss
from torchrl_priors.prior_weight import PriorWeight
from torchrl_priors.priors import ActionPrior, BoltzmannPrior
from torchrl_priors.transforms import PriorBonus, PriorLogProb


def loop_over_time(batch: TensorDictBase, time_dim: int, boundary: Callable[[Any], float]) -> torch.Tensor:
    """What E2R rewards, one step at a time: the definition that the transform must meet."""
    out = torch.zeros(*batch.batch_size, 1)
    traj_ids = batch.get(("collector", "traj_ids"), torch.zeros(batch.batch_size))
    for index in itertools.product(*map(range, batch.batch_size)):
        following = list(index)
        following[time_dim] += 1
        step = batch[index]
        if step["next", "terminated"]:
            out[index] = 0.0
        elif (
            not step["next", "done"]
            and following[time_dim] < batch.batch_size[time_dim]
            and traj_ids[index] == traj_ids[tuple(following)]
        ):
            after = batch[tuple(following)]
            out[index] = PRIOR_LOGITS[after["state"], after["action"]]
        else:
            out[index] = boundary(step)
    return out


class TestShift:
    @given(
        shape=st.lists(st.integers(1, 4), min_size=1, max_size=3),
        time_dim=st.integers(0, 2),
        seed=st.integers(0, 10_000),
        ends=st.sampled_from([0.0, 0.3, 0.9]),
        ids=st.booleans(),
        boundary=st.sampled_from(["expected", "zero"]),
    )
    def test_shifted_log_prob_is_that_of_a_loop_over_time(
        self, shape: list[int], time_dim: int, seed: int, ends: float, ids: bool, boundary: Any
    ) -> None:
        time_dim %= len(shape)
        batch = trajectories(*shape, seed=seed, ends=ends, ids=ids, time_dim=time_dim)
        expected = loop_over_time(
            batch, time_dim, lambda step: -CROSS_ENTROPY[step["next", "state"]] if boundary == "expected" else 0.0
        )
        before = batch.clone()
        out = PriorLogProb(prior(), actor(), time_dim=time_dim, boundary=boundary)(batch)
        assert out is batch
        torch.testing.assert_close(batch["next", "prior_log_prob"], expected)
        torch.testing.assert_close(batch["prior_log_prob"], PRIOR_LOGITS[batch["state"], batch["action"]].unsqueeze(-1))
        new = set(batch.keys(True, True)) - set(before.keys(True, True))
        assert new == {"prior_log_prob", ("next", "prior_log_prob")}
        assert (batch.select(*before.keys(True, True)) == before).all()

    def test_shifted_log_prob_is_that_worked_out_by_hand(self) -> None:
        no, yes = False, True
        batch = trajectories(6, ends=0.0)
        batch["state"] = torch.tensor([0, 1, 2, 3, 4, 5])
        batch["next", "state"] = torch.tensor([1, 6, 3, 6, 5, 6])
        batch["action"] = torch.zeros(6, dtype=torch.int64)
        #   goes on, terminated, goes on, truncated, seam between workers, end of the batch
        batch["next", "terminated"] = torch.tensor([no, yes, no, no, no, no]).unsqueeze(-1)
        batch["next", "done"] = torch.tensor([no, yes, no, yes, no, no]).unsqueeze(-1)
        batch["collector", "traj_ids"] = torch.tensor([0, 0, 1, 1, 2, 3])
        PriorLogProb(prior(), actor(), time_dim=0)(batch)
        at, expected = PRIOR_LOGITS[:, 0], -CROSS_ENTROPY
        torch.testing.assert_close(
            batch["next", "prior_log_prob"].squeeze(-1),
            torch.stack([at[1], torch.tensor(0.0), at[3], expected[6], expected[5], expected[6]]),
        )

    def test_boundary_expectation_is_the_mean_of_sampled_boundaries(self) -> None:
        batch = trajectories(20_000, 1, ends=0.0)
        batch["next", "state"] = torch.full((20_000, 1), 2)
        sampled = PriorLogProb(prior(), actor(), time_dim=1, boundary="sample")(batch.clone())["next", "prior_log_prob"]
        actions = (sampled - PRIOR_LOGITS[2]).abs().argmin(-1)
        torch.testing.assert_close(sampled.squeeze(-1), PRIOR_LOGITS[2][actions])
        torch.testing.assert_close(sampled.mean(), -CROSS_ENTROPY[2], atol=0.03, rtol=0)

    def test_worlds_with_tables_of_their_own(self) -> None:
        q, logits = table(4), table(4).flip(0)
        batch = trajectories(4, 6, seed=2)
        whole = PriorLogProb(BoltzmannPrior(q), tabular_actor(logits), time_dim=1)(batch.clone())
        for world in range(4):
            one = PriorLogProb(BoltzmannPrior(q[world]), tabular_actor(logits[world]), time_dim=0)
            alone = one(batch[world].clone())
            for key in ("prior_log_prob", ("next", "prior_log_prob")):
                torch.testing.assert_close(whole[world][key], alone[key])

    def test_padding_is_no_next_step(self) -> None:
        batch = trajectories(2, 5, ends=0.0)
        padded = batch.clone()
        padded["collector", "mask"] = torch.ones(2, 5, dtype=torch.bool)
        padded["collector", "mask"][0, 3:] = False
        transform = PriorLogProb(prior(), actor(), time_dim=1)
        transform(padded)
        torch.testing.assert_close(
            padded["next", "prior_log_prob"][0, :3], transform(batch[:1, :3].clone())["next", "prior_log_prob"][0]
        )
        torch.testing.assert_close(
            padded["next", "prior_log_prob"][1], transform(batch.clone())["next", "prior_log_prob"][1]
        )

    @pytest.mark.filterwarnings("ignore:No step of the batch goes on")  # for they are not
    @pytest.mark.parametrize("fill", [0.0, torch.nan])
    def test_padding_need_not_be_valid(self, fill: float) -> None:
        def bounded() -> ProbabilisticActor:
            net = nn.Sequential(nn.Linear(2, 2), NormalParamExtractor())
            module = Mod(net, in_keys=["observation"], out_keys=["loc", "scale"])
            options = {"distribution_class": TanhNormal, "distribution_kwargs": {"low": 1.0, "high": 2.0}}
            return ProbabilisticActor(module, in_keys=["loc", "scale"], **options)

        student, teacher = bounded(), bounded()
        batch = trajectories(2, 4, ends=0.0)
        batch["action"] = 1.1 + 0.8 * torch.rand(2, 4, 1)
        batch["observation"], batch["next", "observation"] = torch.randn(2, 2, 4, 2)
        padded, mask = batch.clone(), torch.tensor([[True] * 4, [True] * 2 + [False] * 2])
        for key in ("action", "observation", ("next", "observation")):
            padded[key][~mask] = fill
        padded["collector", "mask"] = mask
        transform = PriorLogProb(ActionPrior(teacher), student, time_dim=1, keep_params=True)
        torch.manual_seed(0)
        out = transform(padded)
        for key in ("prior_log_prob", ("next", "prior_log_prob")):
            assert (out[key][~mask] == 0).all()
            assert out[key].isfinite().all()
        torch.testing.assert_close(out["prior_log_prob"][1, :2], transform(batch[:, :2])["prior_log_prob"][1])
        loss = AE2RLoss(student, ActionPrior(teacher), method="kickstart", num_samples=2)
        loss(out)["loss_prior"].backward()
        assert all(p.grad.isfinite().all() for p in loss.actor_network_params.values(True, True))

    @pytest.mark.filterwarnings("ignore:No step of the batch goes on")  # for they are not
    def test_unused_next_states_need_not_be_valid(self) -> None:
        net = nn.Linear(2, ACTIONS)
        observation = torch.randn(3, 2)
        batch = trajectories(3, ends=0.0)
        batch["next", "terminated"][1] = batch["next", "done"][1] = True
        batch["observation"] = observation
        batch["next", "observation"] = torch.randn(3, 2)
        batch["next", "observation"][:2] = torch.nan
        teacher = ProbabilisticActor(
            Mod(net, in_keys=["observation"], out_keys=["logits"]), in_keys=["logits"], distribution_class=d.Categorical
        )
        out = PriorLogProb(ActionPrior(teacher), teacher, time_dim=0)(batch)
        assert out["next", "prior_log_prob"].isfinite().all()

    @pytest.mark.parametrize("distribution_class", [IndependentNormal, d.Normal, TanhNormal])
    def test_continuous_actions_get_their_log_prob(self, distribution_class: type) -> None:
        def policy() -> ProbabilisticActor:
            net = nn.Sequential(nn.Linear(2, 6), NormalParamExtractor())
            module = Mod(net, in_keys=["observation"], out_keys=["loc", "scale"])
            return ProbabilisticActor(module, in_keys=["loc", "scale"], distribution_class=distribution_class)

        student, teacher = policy(), ActionPrior(policy())
        batch = trajectories(2, 5, seed=3)
        observation = torch.randn(2, 6, 2)
        batch["observation"], batch["next", "observation"] = observation[:, :-1], observation[:, 1:]
        batch["action"] = student(batch.clone())["action"].detach()
        keys = set(batch.keys(True, True))
        out = PriorLogProb(teacher, student, time_dim=1, num_samples=4)(batch)
        assert out["prior_log_prob"].shape == out["next", "prior_log_prob"].shape == (2, 5, 1)
        torch.testing.assert_close(out["prior_log_prob"].squeeze(-1), teacher.log_prob(out))
        assert set(out.keys(True, True)) - keys == {"prior_log_prob", ("next", "prior_log_prob")}
        if distribution_class is not TanhNormal:
            mine = student.get_dist(out[:, -1]["next"].copy())
            theirs = teacher.get_dist(out[:, -1]["next"])
            mine, theirs = (getattr(dist, "base_dist", dist) for dist in (mine, theirs))
            expected = -gaussian_cross_entropy(mine.loc, mine.scale, theirs.loc, theirs.scale)
            expected = torch.where(out["next", "terminated"][:, -1, 0], 0.0, expected)
            torch.testing.assert_close(out["next", "prior_log_prob"][:, -1, 0], expected)

    def test_transforms_leave_no_gradient(self) -> None:
        student = tabular_actor(nn.Parameter(ACTOR_TABLE.clone()))
        batch = PriorLogProb(prior(), student, time_dim=1)(trajectories(2, 5))
        PriorBonus(PriorWeight.table(STATES))(batch)
        assert not any(value.requires_grad for value in batch.values(True, True))

    def test_student_of_the_moment_is_used(self) -> None:
        logits = nn.Parameter(ACTOR_TABLE.clone())
        transform = PriorLogProb(prior(), tabular_actor(logits), time_dim=0)
        first = transform(trajectories(3, ends=0.0))["next", "prior_log_prob"]
        logits.data.zero_()
        second = transform(trajectories(3, ends=0.0))["next", "prior_log_prob"]
        assert torch.equal(first[:2], second[:2])
        assert first[2] != second[2]

    def test_moving_or_saving_the_transform_leaves_the_student_alone(self) -> None:
        student, weight = actor(), PriorWeight.table(STATES)
        transform = Compose(PriorLogProb(prior(), student), PriorBonus(weight))
        assert not any(module is student or module is weight for module in transform.modules())
        transform.to(torch.float64)
        assert next(student.buffers()).dtype is torch.float32
        assert {key.rsplit(".", 1)[-1] for key in transform.state_dict()} == {"table", "temperature", "bonus_coeff"}

    def test_lazy_stacks_get_the_log_prob_of_dense_batches(self) -> None:
        batch = trajectories(4, 5, seed=1)
        lazy = LazyStackedTensorDict(*batch.clone().unbind(1), stack_dim=1)
        mixed = RandomDegradation(prior(), 0.5, seed=0)
        out = PriorLogProb(mixed, actor(), time_dim=1)(lazy)
        expected = PriorLogProb(RandomDegradation(prior(), 0.5, seed=0), actor(), time_dim=1)(batch)
        torch.testing.assert_close(out["next", "prior_log_prob"], expected["next", "prior_log_prob"])
        assert torch.equal(out["next", "prior", "degraded"], expected["next", "prior", "degraded"])


class TestRandomDraws:
    def test_draw_of_a_step_is_that_of_the_next_of_the_step_before(self) -> None:
        batch = trajectories(3, 40, ends=0.2, seed=7)
        mixed = RandomDegradation(prior(), 0.5, seed=0)
        PriorLogProb(mixed, actor(), time_dim=1)(batch)
        draw, next_draw = batch["prior", "degraded"], batch["next", "prior", "degraded"]
        goes_on = ~batch["next", "done"][:, :-1]
        assert torch.equal(next_draw[:, :-1][goes_on], draw[:, 1:][goes_on])
        assert not torch.equal(next_draw[:, :-1], draw[:, 1:])  # a new state has a draw of its own

        bad = (-PRIOR_TABLE).log_softmax(-1)
        logits = torch.where(draw, bad[batch["state"]], PRIOR_LOGITS[batch["state"]])
        expected = logits.gather(-1, batch["action"].unsqueeze(-1))
        torch.testing.assert_close(batch["prior_log_prob"], expected)
        next_logits = torch.where(next_draw, bad[batch["next", "state"]], PRIOR_LOGITS[batch["next", "state"]])[:, -1]
        boundary = -categorical_cross_entropy(ACTOR_LOGITS[batch["next", "state"]][:, -1], next_logits).unsqueeze(-1)
        boundary = torch.where(batch["next", "terminated"][:, -1], 0.0, boundary)
        torch.testing.assert_close(batch["next", "prior_log_prob"][:, -1], boundary)
        # and the auxiliary loss of a minibatch sees what the bonus saw
        torch.testing.assert_close(
            mixed.get_dist(batch[:, 3:9].reshape(-1).copy()).logits, logits[:, 3:9].flatten(0, 1)
        )

    def test_second_call_reuses_the_draw(self) -> None:
        batch = trajectories(3, 40, seed=7)
        transform = PriorLogProb(RandomDegradation(prior(), 0.5), actor(), time_dim=1)
        first = transform(batch).clone()
        assert (transform(batch) == first).all()

    def test_a_structural_degradation_scores_bad_states_by_its_adversary(self) -> None:
        mask = torch.arange(STATES) % 2 == 0
        batch = trajectories(3, 9, seed=7)
        PriorLogProb(StructuralDegradation(prior(), mask), actor(), time_dim=1)(batch)
        logits = torch.where(mask.unsqueeze(-1), (-PRIOR_TABLE).log_softmax(-1), PRIOR_LOGITS)
        torch.testing.assert_close(batch["prior_log_prob"], logits[batch["state"], batch["action"]].unsqueeze(-1))


class TestTimeDimension:
    def test_named_by_rollouts_and_collectors(self) -> None:
        batch = trajectories(3, 5)
        expected = PriorLogProb(prior(), actor(), time_dim=-1)(batch.clone())["next", "prior_log_prob"]
        batch.names = [None, "time"]
        assert torch.equal(PriorLogProb(prior(), actor())(batch)["next", "prior_log_prob"], expected)

    @pytest.mark.parametrize("names", [None, ["time_", None]])
    def test_the_time_dimension_is_never_guessed(self, names: list[str | None] | None) -> None:
        batch = trajectories(3, 5)
        if names:
            batch.names = names
        with pytest.raises(ValueError, match="no dimension named 'time'"):
            PriorLogProb(prior(), actor())(batch)

    @pytest.mark.parametrize("time_dim", [2, -3])
    def test_must_be_one_of_the_batch(self, time_dim: int) -> None:
        with pytest.raises(ValueError, match="not a dimension of the batch"):
            PriorLogProb(prior(), actor(), time_dim=time_dim)(trajectories(3, 5))
        with pytest.raises(ValueError, match="not a dimension of the batch"):
            PriorLogProb(prior(), actor(), time_dim=0)(trajectories(3)[0])
