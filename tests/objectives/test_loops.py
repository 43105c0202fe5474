"""What other people's loops do to these modules: copies, moves, masks, frozen layers, ends without observations."""

from __future__ import annotations

import copy
import math
from typing import Any

import pytest
import torch
from objectives_cases import DISTRIBUTIONS, make_actor, make_batch, make_critic, make_weight, total
from tensordict import TensorDict
from tensordict.nn import NormalParamExtractor, TensorDictModule, TensorDictSequential
from torch import Tensor, nn
from torch import distributions as d
from torchrl.data import Bounded
from torchrl.modules import IndependentNormal, MaskedCategorical, ProbabilisticActor, ValueOperator
from torchrl.objectives import ClipPPOLoss

from torchrl_priors import (
    ActionPrior,
    AVECMixin,
    MixturePrior,
    ModulePrior,
    PriorBonus,
    PriorLogProb,
    PriorWeight,
    UniformPrior,
    prior_transforms,
)
from torchrl_priors.objectives import AE2RLoss, CompiledStep, MultiTeacherLoss, ValueOffset
from torchrl_priors.priors.layers import TeacherInput


class AVECClipPPO(AVECMixin, ClipPPOLoss):
    pass


def actor_of(distribution_class: Any, outputs: int = 4, **kwargs: Any) -> ProbabilisticActor:
    """Of the observations of ``make_batch``, with several independent actions where the distribution is of numbers."""
    discrete = issubclass(distribution_class, d.Categorical)
    keys = ["logits"] if discrete else ["loc", "scale"]
    net = nn.Linear(3, outputs) if discrete else nn.Sequential(nn.Linear(3, 2 * outputs), NormalParamExtractor())
    module = TensorDictModule(net, in_keys=["observation"], out_keys=keys)
    return ProbabilisticActor(module, in_keys=[*keys, *kwargs], distribution_class=distribution_class)


@pytest.mark.parametrize("number", [0, 1])
def test_a_copy_of_a_transform_reads_the_networks_that_learn(number: int) -> None:
    """Asynchronous collectors copy their postproc."""
    loss = AE2RLoss(make_actor(), ActionPrior(make_actor()), make_weight(), make_critic())
    transform = prior_transforms(loss)[number]
    copied = copy.deepcopy(transform)
    for name in ("actor", "prior_weight"):
        assert copied.__dict__.get(name) is transform.__dict__.get(name)
    assert copied.state_dict().keys() == transform.state_dict().keys()
    both = copy.deepcopy(nn.ModuleList([loss.actor_network, transform]))  # what is copied with it stays with it
    assert both[1].__dict__.get("actor") in (None, both[0])


@pytest.mark.parametrize("td_error", ["original", "shaped"])
@pytest.mark.parametrize("method", ["aer", "ae2r", "aligned"])
def test_an_end_without_an_observation_leaves_no_trace(method: str, td_error: str) -> None:
    """Environments that reset themselves may give NaN there."""
    data = make_batch()
    loss = AE2RLoss(make_actor(), make_actor(), make_weight(), make_critic(), method=method, td_error=td_error)
    expected = loss(data)
    data["next", "observation"][data["next", "terminated"].squeeze(-1)] = math.nan
    losses = loss(data)
    for name, value in expected.items():
        torch.testing.assert_close(losses[name], value)
    total(losses).backward()
    assert all(p.grad is None or p.grad.isfinite().all() for p in loss.parameters())


def test_what_a_weight_learns_in_its_buffers_reaches_a_loss_that_was_moved() -> None:
    class Level(nn.Module):
        def __init__(self) -> None:
            super().__init__()
            self.register_buffer("level", torch.tensor(0.5))

        def forward(self, observation: Tensor) -> Tensor:
            return self.level.expand(*observation.shape[:-1], 1)

    weight = TensorDictModule(Level(), in_keys=["observation"], out_keys=["prior_weight"])
    loss = AE2RLoss(make_actor(), make_actor(), weight, method="aligned", weight_target="none").to(torch.float64)
    weight.module.level.fill_(0.25)
    double = make_batch().apply(lambda x: x.double() if x.is_floating_point() else x)
    assert loss(double)["prior_weight"] == 0.25


def test_the_offset_reaches_the_values_of_the_loop_after_a_move() -> None:
    critic = make_critic()
    critic.module = nn.Sequential(critic.module, ValueOffset())
    loss = AVECClipPPO(make_actor(), critic).to(torch.float64)
    data = make_batch().apply(lambda x: x.double() if x.is_floating_point() else x)
    offset = loss.update_value_offset(data)
    assert offset != 0
    torch.testing.assert_close(critic.module[1].offset, offset)
    torch.testing.assert_close(critic(data.clone())["state_value"].mean(), data["value_target"].mean())


def test_frozen_layers_stay_frozen_in_a_compiled_step() -> None:
    actor, critic = make_actor(hidden=(4,)), make_critic()
    frozen = actor[0].module[0].requires_grad_(False)
    loss = ClipPPOLoss(actor, critic, functional=False)
    optimizer = torch.optim.Adam(loss.parameters(), lr=0.1)
    before, other = frozen.weight.clone(), actor[0].module[2].weight.clone()
    CompiledStep(loss, optimizer, backend="eager")(make_batch(), [torch.arange(6)])
    assert torch.equal(frozen.weight, before)
    assert not torch.equal(actor[0].module[2].weight, other)
    frozen.requires_grad_(True)  # thawed later on
    CompiledStep(loss, optimizer, backend="eager")(make_batch(), [torch.arange(6)])
    assert not torch.equal(frozen.weight, before)


@pytest.mark.parametrize("method", ["e2r", "ae2r", "kickstart", "annealed_kickstart"])
@pytest.mark.parametrize("batch", [(5,), (2, 3)])
def test_independent_actions_are_one_joint_action(method: str, batch: tuple[int, ...]) -> None:
    apart, joint = actor_of(d.Normal), actor_of(IndependentNormal)
    joint.load_state_dict(apart.state_dict())
    teachers = actor_of(d.Normal), actor_of(IndependentNormal)
    teachers[1].load_state_dict(teachers[0].state_dict())
    data, weight, critic = make_batch("normal", batch), make_weight(), make_critic()
    losses = [
        AE2RLoss(actor, ActionPrior(teacher), weight, critic, method=method)(data)
        for actor, teacher in zip((apart, joint), teachers, strict=True)
    ]
    for name, value in losses[0].items():
        torch.testing.assert_close(value, losses[1][name])


def test_what_a_masked_student_can_not_do_costs_it_nothing() -> None:
    net = TensorDictModule(nn.Linear(3, 3), in_keys=["observation"], out_keys=["logits"])
    actor = ProbabilisticActor(net, in_keys=["logits", "mask"], distribution_class=MaskedCategorical)
    prior = ModulePrior(nn.Linear(3, 3), "logits")
    data = TensorDict(observation=torch.randn(5, 3), mask=torch.tensor([[True, True, False]] * 5), batch_size=[5])
    loss = AE2RLoss(actor, prior, method="annealed_kickstart")
    log_probs = net(data.clone())["logits"][:, :2].log_softmax(-1)
    expected = -(prior.get_dist(data).probs[:, :2] * log_probs).sum(-1).mean()
    torch.testing.assert_close(loss(data)["loss_prior"], expected)
    loss.aux_coeff = 0.0  # the end of the schedule: not 0 times infinity
    assert loss(data)["loss_prior"] == 0


@pytest.mark.parametrize("kind", ["categorical", "normal"])
def test_annealed_kickstarting_takes_a_mixture(kind: str) -> None:
    prior = MixturePrior([ActionPrior(make_actor(kind)), ActionPrior(make_actor(kind))], [0.3, 0.7])
    AE2RLoss(make_actor(kind), prior, method="annealed_kickstart")(make_batch(kind))["loss_prior"].backward()


@pytest.mark.parametrize("network", ["prior_weight", "critic_network"])
def test_layers_shared_with_the_student_need_functional_losses(network: str) -> None:
    trunk = TensorDictModule(nn.Linear(3, 4), ["observation"], ["hidden"])
    head = TensorDictModule(nn.Linear(4, 2), ["hidden"], ["logits"])
    student = ProbabilisticActor(
        TensorDictSequential(trunk, head), in_keys=["logits"], distribution_class=DISTRIBUTIONS["categorical"]
    )
    out = "prior_weight" if network == "prior_weight" else "state_value"
    shared = TensorDictSequential(trunk, TensorDictModule(nn.Linear(4, 1), ["hidden"], [out]))
    networks = {"prior_weight": make_weight(), "critic_network": make_critic(), network: shared}
    AE2RLoss(student, make_actor(), **networks)
    with pytest.raises(ValueError, match=f"{network} shares parameters"):
        AE2RLoss(student, make_actor(), **networks, functional=False)


def test_several_teachers_obey_the_settings_of_their_loss() -> None:
    priors = [UniformPrior(2, namespace="a"), UniformPrior(2, namespace="b")]
    loss, data = MultiTeacherLoss(make_actor(), priors, method="kickstart"), make_batch()
    data["padded"] = torch.tensor([True, True, False, True, False, True]).unsqueeze(-1)
    loss.loss_mask_key, loss.reduction = "padded", "sum"
    expected = AE2RLoss(loss.losses[0].actor_network, priors[0], method="kickstart", reduction="sum")
    torch.testing.assert_close(loss(data)["loss_prior_a"], expected(data[data["padded"].squeeze(-1)])["loss_prior"])
    with pytest.raises(ValueError, match="namespace of its own"):
        MultiTeacherLoss(
            make_actor(), [*priors, UniformPrior(2, namespace=("a", "b")), UniformPrior(2, namespace="a_b")]
        )


def test_a_bounded_teacher_of_an_unbounded_student_is_refused() -> None:
    loss = AE2RLoss(make_actor("normal"), make_actor("tanh_normal"), method="kickstart")
    with pytest.raises(ValueError, match=r"student's IndependentNormal and the prior's TanhNormal.* std="):
        loss(make_batch("normal"))
    AE2RLoss(make_actor("tanh_normal"), make_actor("normal"), method="kickstart")(make_batch("tanh_normal"))


def test_a_uniform_teacher_leaves_a_gaussian_student_alone() -> None:
    prior = UniformPrior(Bounded(-0.01, 0.01, shape=(2,)))  # most actions are outside
    actor = make_actor("normal")
    data = make_batch("normal").exclude(("next", "prior_log_prob"), "prior_log_prob")
    data = PriorBonus(shift="current")(PriorLogProb(prior, actor, time_dim=0)(data))
    torch.testing.assert_close(data["next", "prior_bonus"], torch.full((6, 1), -2 * math.log(0.02)))
    losses = AE2RLoss(actor, prior, method="kickstart")(data)
    torch.testing.assert_close(losses["loss_prior"], torch.tensor(2 * math.log(0.02)))
    assert not losses["loss_prior"].requires_grad


def test_advice_without_a_finite_log_probability_is_an_error_not_a_nan() -> None:
    sure = nn.Linear(3, 2)
    sure.load_state_dict({"weight": torch.zeros(2, 3), "bias": torch.tensor([0.0, -math.inf])})
    never = ModulePrior(sure, "logits")
    batch = make_batch().exclude("prior_log_prob", ("next", "prior_log_prob"))
    with pytest.raises(ValueError, match="not finite"):
        PriorLogProb(never, make_actor(), time_dim=0)(batch)


def test_a_policy_in_the_place_of_a_prior_is_told_what_to_do() -> None:
    with pytest.raises(TypeError, match=r"must be a Prior, got ProbabilisticActor: try ActionPrior\(policy\)"):
        PriorLogProb(make_actor(), make_actor())


@pytest.mark.parametrize("weight", [PriorWeight(nn.Linear(3, 1)), make_weight()])
def test_a_weight_with_parameters_is_functional_as_before(weight: Any) -> None:
    loss = AE2RLoss(make_actor(), make_actor(), weight, ValueOperator(nn.Linear(3, 1), in_keys=["observation"]))
    assert any(name.startswith("prior_weight_params") for name, _ in loss.named_parameters())


def test_pixels_that_were_scaled_already_are_not_scaled_again() -> None:
    read = TeacherInput((1, 4, 4), pixels=True)
    pixels = torch.randint(0, 256, (3, 1, 4, 4), dtype=torch.uint8)
    torch.testing.assert_close(read(pixels), read(pixels.float()))
    read(torch.zeros(1, 4, 4))  # a black frame
    standard = (pixels.float() - 128) / 60
    for wrong in (pixels / 255, pixels / 255 + 0.03, standard, standard.abs() * 200):
        with pytest.raises(ValueError, match="ToTensorImage"):
            read(wrong)
