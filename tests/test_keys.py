"""Advice is finite, with finite gradients, or an error names the pair and the cause."""

from __future__ import annotations

import math
from typing import Any

import pytest
import torch
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from tensordict import TensorDict
from tensordict.nn import ProbabilisticTensorDictModule, ProbabilisticTensorDictSequential, TensorDictModuleBase
from torch import distributions as d
from torch import nn
from torchrl.modules import IndependentNormal, MaskedCategorical, OneHotCategorical, TanhNormal, TruncatedNormal

from torchrl_priors import ActionPrior, AE2RLoss, CallablePrior, ModulePrior, PriorLogProb, UniformPrior

BATCH, ACTIONS = 3, 2


def independent(kind: Any) -> Any:
    def build(*, validate_args: bool = False, **params: torch.Tensor) -> d.Distribution:
        return d.Independent(kind(**params, validate_args=validate_args), 1)

    build.__name__ = kind.__name__
    return build


FAMILIES: dict[str, tuple[Any, tuple[str, ...], dict[str, Any]]] = {
    "categorical": (d.Categorical, ("logits",), {}),
    "of_probs": (d.Categorical, ("probs",), {}),
    "one_hot": (OneHotCategorical, ("logits",), {}),
    "masked": (MaskedCategorical, ("logits", "mask"), {}),
    "normal": (IndependentNormal, ("loc", "scale"), {}),
    "tanh": (TanhNormal, ("loc", "scale"), {}),
    "wide_tanh": (TanhNormal, ("loc", "scale"), {"low": -2.0, "high": 2.0}),
    "truncated": (TruncatedNormal, ("loc", "scale"), {}),
    "beta": (independent(d.Beta), ("concentration1", "concentration0"), {}),
    "uniform": (independent(d.Uniform), ("low", "high"), {}),
    "log_normal": (independent(d.LogNormal), ("loc", "scale"), {}),
    "gamma": (independent(d.Gamma), ("concentration", "rate"), {}),
    "laplace": (independent(d.Laplace), ("loc", "scale"), {}),
    "bernoulli": (independent(d.Bernoulli), ("logits",), {}),
}
POSITIVE = {"scale", "concentration", "concentration1", "concentration0", "rate", "probs"}
ODD = [0.0, -1.0, math.nan, math.inf, -math.inf, 1e30, 30.0, -30.0]


class Constant(TensorDictModuleBase):
    """Parameters that are learned, whatever the state."""

    def __init__(self, values: dict[str, torch.Tensor]) -> None:
        super().__init__()
        self.in_keys, self.out_keys = ["observation"], list(values)
        for name, value in values.items():
            setattr(self, name, nn.Parameter(value) if value.is_floating_point() else value)

    def forward(self, tensordict: TensorDict) -> TensorDict:
        for name in self.out_keys:
            tensordict.set(name, getattr(self, name).expand(*tensordict.batch_size, ACTIONS))
        return tensordict


def policy(family: str, odd: dict[int, float] | None = None) -> ProbabilisticTensorDictSequential:
    kind, names, kwargs = FAMILIES[family]
    values: dict[str, torch.Tensor] = {}
    for place, name in enumerate(names):
        value = torch.randn(ACTIONS)
        if name in POSITIVE:
            value = value.abs() + 0.1
        elif name in ("low", "high"):
            value = torch.full((ACTIONS,), -1.0 if name == "low" else 1.0)
        if name == "mask":
            value = torch.tensor([True, bool(torch.rand(()) < 0.5)])
        elif odd and place in odd:
            value[0] = odd[place]
        values[name] = value
    head = ProbabilisticTensorDictModule(
        list(names), ["action"], distribution_class=kind, distribution_kwargs=kwargs, default_interaction_type="random"
    )
    return ProbabilisticTensorDictSequential(Constant(values), head)


def batch() -> TensorDict:
    return TensorDict(observation=torch.zeros(BATCH, 3), batch_size=[BATCH])


def some(values: list[float]) -> Any:
    return st.dictionaries(st.integers(0, 1), st.sampled_from(values), max_size=1)


@settings(max_examples=200)
@given(
    student=st.sampled_from(sorted(FAMILIES)),
    teacher=st.sampled_from(sorted(FAMILIES)),
    odd=some([*ODD, 1e-6]),
    teacher_odd=some([*ODD, 1e-30]),
    method=st.sampled_from(["kickstart", "pull"]),
    seed=st.integers(0, 100),
)
def test_of_any_pair_is_finite_or_refused(
    student: str, teacher: str, odd: Any, teacher_odd: Any, method: str, seed: int
) -> None:
    for place, value in odd.items():  # what torch.distributions refuse themselves, if they validate their arguments
        assume(FAMILIES[student][1][place % len(FAMILIES[student][1])] not in POSITIVE or not value <= 0)
    torch.manual_seed(seed)
    actor, prior = policy(student, odd), ActionPrior(policy(teacher, teacher_odd))
    loss = AE2RLoss(actor, prior, method=method, num_samples=3)
    names = [family[0].__name__ for family in (FAMILIES[student], FAMILIES[teacher])]
    try:
        value = loss(batch())["loss_prior"]
    except (ValueError, NotImplementedError) as error:
        words = str(error)
        alone = "ActionPrior" in words or "student's distribution" in words  # one that is broken by itself
        assert alone or all(name in words or "Independent" in words for name in names)
        return
    assert value.isfinite()
    if value.requires_grad:  # a uniform teacher's advice does not depend on the student
        value.backward()
    gradients = [p.grad for p in loss.actor_network_params.values(True, True) if p.grad is not None]
    assert all(gradient.isfinite().all() for gradient in gradients)


REFUSED = [
    ("normal", "tanh"),
    ("normal", "truncated"),
    ("normal", "beta"),
    ("normal", "uniform"),
    ("normal", "log_normal"),
    ("wide_tanh", "tanh"),
    ("normal", "categorical"),
    ("categorical", "normal"),
]


@pytest.mark.parametrize(("student", "teacher"), REFUSED)
def test_a_student_beyond_the_teachers_support_is_refused(student: str, teacher: str) -> None:
    with pytest.raises(ValueError, match=r"the student's .* and the prior's"):
        AE2RLoss(policy(student), ActionPrior(policy(teacher)), method="kickstart")(batch())
    acted = TensorDict(next=batch().set("terminated", torch.zeros(BATCH, 1, dtype=torch.bool)), batch_size=[BATCH])
    acted.update(batch()).set("action", torch.zeros(BATCH, ACTIONS)).set(("next", "done"), acted["next", "terminated"])
    if "categorical" not in (student, teacher):
        with pytest.raises(ValueError, match=r"the student's .* and the prior's"):
            PriorLogProb(ActionPrior(policy(teacher)), policy(student), time_dim=0)(
                acted.set("action", torch.full((BATCH, ACTIONS), 0.5))
            )


@pytest.mark.parametrize(("student", "teacher"), [("tanh", "wide_tanh"), ("tanh", "normal"), ("beta", "normal")])
def test_a_student_within_the_teachers_support_learns(student: str, teacher: str) -> None:
    assert AE2RLoss(policy(student), ActionPrior(policy(teacher)), method="kickstart")(batch())["loss_prior"].isfinite()


@pytest.mark.parametrize(("student", "teacher"), [("normal", "tanh"), ("wide_tanh", "tanh"), ("normal", "beta")])
def test_a_student_beyond_the_teachers_support_can_be_pulled_to_it(student: str, teacher: str) -> None:
    loss = AE2RLoss(policy(student), ActionPrior(policy(teacher)), method="pull", num_samples=4)
    out = loss(batch())
    out["loss_prior"].backward()
    assert out["loss_prior"].isfinite()
    assert out["prior_kl"] == torch.inf
    assert all(p.grad.isfinite().all() for p in loss.actor_network_params.values(True, True))


def test_a_teacher_that_leaves_the_students_bounds_is_no_target() -> None:
    words = r"the prior's IndependentNormal and the student's TanhNormal.*: squash the prior .*, or make the student a"
    with pytest.raises(ValueError, match=words):
        AE2RLoss(policy("tanh"), ActionPrior(policy("normal")), method="pull")(batch())


def test_actions_beyond_the_teachers_bounds_are_refused() -> None:
    for action in (1.5, -1.5):
        data = batch().set("action", torch.full((BATCH, ACTIONS), action))
        with pytest.raises(ValueError, match=r"\[-?1.5, -?1.5\].*TanhNormal.*std="):
            ActionPrior(policy("tanh")).log_prob(data)
    with pytest.raises(ValueError, match=r"student's action under 'action' has NaN"):
        ActionPrior(policy("normal")).log_prob(batch().set("action", torch.full((BATCH, ACTIONS), math.nan)))


def test_a_masked_teacher_of_an_unmasked_student_is_named() -> None:
    teacher = policy("masked")
    teacher.module[0].mask = torch.tensor([True, False])
    student = policy("categorical")
    with pytest.raises(ValueError, match=r"MaskedCategorical on the student's Categorical .* 3 of 3 .* probability 0"):
        AE2RLoss(student, ActionPrior(teacher), method="kickstart")(batch())


def test_a_teacher_that_rules_actions_out_can_be_pulled_to() -> None:
    teacher = policy("masked")
    teacher.module[0].mask = torch.tensor([True, False])
    loss = AE2RLoss(policy("categorical"), ActionPrior(teacher), method="pull")
    out = loss(batch())
    out["loss_prior"].backward()
    assert out["loss_prior"].isfinite()
    assert all(p.grad.isfinite().all() for p in loss.actor_network_params.values(True, True))


def test_the_students_own_nan_is_named_first() -> None:
    broken = policy("normal", {0: math.nan})
    with pytest.raises(ValueError, match=r"the student's loc has NaN"):
        AE2RLoss(broken, ActionPrior(policy("normal")), method="kickstart")(batch())


@pytest.mark.parametrize(
    ("prior", "message"),
    [
        (lambda: ModulePrior(nn.Linear(3, ACTIONS), "probs"), "are they logits"),
        (lambda: ActionPrior(policy("of_probs", {0: -1.0})), "are they logits"),
        (lambda: ActionPrior(policy("normal", {1: -1.0})), "is it a log-std"),
        (lambda: ActionPrior(policy("truncated", {1: -1.0})), "is it a log-std"),
        (lambda: ActionPrior(policy("normal", {0: math.nan})), "loc has NaN"),
    ],
)
def test_parameters_that_are_something_else_are_named(prior: Any, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        prior().get_dist(batch())


def test_probabilities_of_zero_are_named_by_the_loss() -> None:
    class One(nn.Module):
        def forward(self, observation: torch.Tensor) -> torch.Tensor:
            return torch.tensor([1.0, 0.0]).expand(len(observation), 2)

    with pytest.raises(ValueError, match=r"probability 0 .*AffordancePrior"):
        AE2RLoss(policy("categorical"), ModulePrior(One(), "probs"), method="kickstart")(batch())


def test_ordinary_teachers_are_not_refused() -> None:
    for prior in (
        UniformPrior(ACTIONS),
        CallablePrior(lambda _: 0, num_actions=ACTIONS),
    ):
        assert AE2RLoss(policy("categorical"), prior, method="kickstart")(batch())["loss_prior"].isfinite()
