"""Schedules at points worked out by hand, and coefficients that follow them wherever they are read."""

from __future__ import annotations

import copy
import math

import pytest
import torch
from objectives_cases import make_actor, make_batch, make_critic, make_ppo_prior
from torchrl.objectives import A2CLoss
from torchrl.trainers import Trainer
from trajectories import actor, prior, trajectories

from torchrl_priors import ActionPrior, AE2RLoss, PriorBonus, PriorLogProb
from torchrl_priors.objectives import CompiledStep
from torchrl_priors.schedules import CoeffScheduler, CosineSchedule, LinearSchedule, PiecewiseSchedule

ANNEAL = LinearSchedule(2.0, 0.5, frames=400)  # in steps that floats hold exactly


def kickstart(**kwargs) -> AE2RLoss:
    torch.manual_seed(0)
    return AE2RLoss(make_actor(), ActionPrior(make_actor()), method="kickstart", **kwargs)


@pytest.mark.parametrize(
    ("schedule", "frames", "values"),
    [
        (ANNEAL, [0, 100, 200, 400, 10**9], [2.0, 1.625, 1.25, 0.5, 0.5]),
        (LinearSchedule(0.0, 1.0, frames=4), [-1, 1, 4], [0.0, 0.25, 1.0]),
        (CosineSchedule(2.0, 0.0, frames=4), [0, 1, 2, 4, 9], [2.0, 1 + math.sqrt(0.5), 1.0, 0.0, 0.0]),
        (CosineSchedule(0.1, 0.3, frames=6), [0, 2, 6], [0.1, 0.15, 0.3]),
        (PiecewiseSchedule([(10, 1.0), (20, 3.0), (60, 0.0)]), [0, 10, 15, 20, 40, 99], [1.0, 1.0, 2.0, 3.0, 1.5, 0.0]),
        (PiecewiseSchedule([(5, 0.7)]), [0, 5, 6], [0.7, 0.7, 0.7]),
    ],
)
def test_schedules_go_through_points_worked_out_by_hand(schedule, frames, values):
    assert [schedule(n).item() for n in frames] == pytest.approx(values, abs=1e-12)
    torch.testing.assert_close(schedule(torch.tensor(frames)), torch.tensor(values))


@pytest.mark.parametrize("schedule", [LinearSchedule(0.1, 0.3, frames=7), CosineSchedule(0.1, 0.3, frames=7)])
def test_schedules_start_and_end_exactly(schedule):
    assert schedule(0).item() == 0.1
    assert schedule(7).item() == 0.3


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: LinearSchedule(1.0, 0.0, frames=0), "positive number of frames, got 0"),
        (lambda: CosineSchedule(1.0, math.nan, frames=5), "finite"),
        (lambda: PiecewiseSchedule([]), "at least one point"),
        (lambda: PiecewiseSchedule([(5, 1.0), (5, 0.0)]), "increasing frames, got"),
        (lambda: PiecewiseSchedule([(0, 1.0), (5, math.inf)]), "finite"),
    ],
)
def test_schedules_that_mean_nothing_are_refused(make, message):
    with pytest.raises(ValueError, match=message):
        make()


def test_a_loss_is_scaled_by_the_scheduled_coefficient():
    loss, batch = kickstart(), make_batch()
    full = loss(batch)["loss_prior"]
    scheduler = CoeffScheduler(loss, "aux_coeff", ANNEAL)
    torch.testing.assert_close(loss(batch)["loss_prior"], 2.0 * full)  # set at once
    assert scheduler.step(100) == 1.625
    torch.testing.assert_close(loss(batch)["loss_prior"], 1.625 * full)


def test_the_bonus_and_a_loss_of_torchrl_can_be_scheduled_too():
    batch = PriorLogProb(prior(), actor(), time_dim=0)(trajectories(4))
    bonus = PriorBonus()
    CoeffScheduler(bonus, "bonus_coeff", ANNEAL).step(1000)
    bonus(batch)
    shaping = batch["next", "shaped_reward"] - batch["next", "reward"]
    torch.testing.assert_close(shaping, 0.5 * batch["next", "prior_bonus"])
    a2c = A2CLoss(make_actor(), make_critic(), entropy_coeff=0.1)
    CoeffScheduler(a2c, "entropy_coeff", LinearSchedule(0.1, 0.0, frames=10)).step(5)
    assert a2c.entropy_coeff.item() == pytest.approx(0.05)


def test_coefficients_of_submodules_have_dotted_names():
    loss = make_ppo_prior(make_actor(), make_critic(), make_actor(), method="kickstart")
    CoeffScheduler(loss, "prior_loss.aux_coeff", ANNEAL).step(400)
    assert loss.prior_loss.aux_coeff == 0.5


def test_a_compiled_step_reads_the_scheduled_value():
    def after(value: float) -> list[torch.Tensor]:
        torch.manual_seed(0)
        loss = kickstart(functional=False)
        step = CompiledStep(loss, torch.optim.Adam(loss.parameters()), backend="eager")
        scheduler = CoeffScheduler(loss, "aux_coeff", LinearSchedule(1.0, value, frames=100))
        torch.manual_seed(1)
        batch = make_batch()
        step(batch, [torch.arange(6)])  # recorded with the first value
        scheduler.step(100)
        return [step(batch, [torch.arange(6)])[0, step.names.index("loss_prior")], loss(batch)["loss_prior"].detach()]

    half, whole = after(0.5)[0], after(1.0)[0]
    torch.testing.assert_close(half, 0.5 * whole)
    assert after(0.0) == [0.0, 0.0]


@pytest.mark.parametrize("scheduler_first", [True, False])
def test_training_resumes_at_the_value_it_stopped_at_whatever_is_loaded_first(scheduler_first):
    loss = kickstart()
    scheduler = CoeffScheduler(loss, "aux_coeff", ANNEAL)
    scheduler.step(100)
    saved = copy.deepcopy((loss.state_dict(), scheduler.state_dict()))
    other = kickstart()
    if scheduler_first:
        again = CoeffScheduler(other, "aux_coeff", ANNEAL)
        again.load_state_dict(saved[1])
        other.load_state_dict(saved[0])
    else:
        other.load_state_dict(saved[0])
        again = CoeffScheduler(other, "aux_coeff", ANNEAL)  # of a coefficient that is annealed already
        again.load_state_dict(saved[1])
    assert other.aux_coeff == 1.625
    assert again.step(200) == scheduler.step(200) == 1.25


def test_the_coefficient_follows_its_module_to_another_dtype():
    loss = kickstart()
    scheduler = CoeffScheduler(loss, "aux_coeff", ANNEAL)
    loss.double()
    scheduler.step(200)
    assert loss.aux_coeff.dtype == torch.float64
    assert loss.aux_coeff == 1.25


def test_integers_which_would_round_are_refused():
    with pytest.raises(TypeError, match=r"'aux_coeff' is of torch\.int64: give it as a float"):
        CoeffScheduler(kickstart(aux_coeff=1), "aux_coeff", ANNEAL)


def test_a_coefficient_that_is_not_there_is_named_beside_those_that_are():
    with pytest.raises(AttributeError, match=r"no coefficient 'beta'; it has .*aux_coeff"):
        CoeffScheduler(kickstart(), "beta", ANNEAL)


def test_a_trainer_steps_and_saves_it():
    loss, seen = kickstart(), []
    loss.register_forward_pre_hook(lambda *_: seen.append(loss.aux_coeff.item()))
    trainer = Trainer(
        collector=_Batches(),
        total_frames=18,
        frame_skip=1,
        optim_steps_per_batch=1,
        loss_module=loss,
        optimizer=torch.optim.Adam(loss.parameters()),
        progress_bar=False,
    )
    CoeffScheduler(loss, "aux_coeff", LinearSchedule(1.0, 0.0, frames=12)).register(trainer, "anneal")
    trainer.train()
    assert seen == [1.0, 0.5, 0.0]
    assert trainer.state_dict()["anneal"] == {"frames": 18}


class _Batches:
    """As much of a collector as a trainer needs."""

    init_random_frames = 0

    def __iter__(self):
        return iter([make_batch() for _ in range(3)])

    def state_dict(self) -> dict:
        return {}

    def set_seed(self, *args, **kwargs) -> None: ...

    def update_policy_weights_(self, *args, **kwargs) -> None: ...

    def shutdown(self, *args, **kwargs) -> None: ...
