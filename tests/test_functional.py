"""The maths against values worked out by hand, loops over steps, and properties that hold for any input."""

from __future__ import annotations

import math
from collections.abc import Callable

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor
from torch.distributions import Categorical, Normal, kl_divergence

from torchrl_priors.functional import (
    alignment,
    categorical_cross_entropy,
    gaussian_cross_entropy,
    has_next_action,
    joint,
    prior_bonus,
    prior_weight_loss,
    shift_to_next,
    td_residual,
)

NO, YES = False, True


def vector(*values: float) -> Tensor:
    return torch.tensor(values, dtype=torch.float64)


def floats(low: float, high: float, size: int) -> st.SearchStrategy[Tensor]:
    return st.lists(st.floats(low, high), min_size=size, max_size=size).map(lambda values: vector(*values))


logits = floats(-20, 20, 4)


class TestCategorical:
    def test_cross_entropy_of_categoricals_is_that_worked_out_by_hand(self) -> None:
        student, prior = vector(0.5, 0.5).log(), vector(0.25, 0.75).log()
        torch.testing.assert_close(
            categorical_cross_entropy(student, prior), torch.tensor(0.5 * math.log(16 / 3)).double()
        )

    def test_cross_entropy_is_not_symmetric(self) -> None:
        student, prior = vector(0.5, 0.5).log(), vector(0.25, 0.75).log()
        expected = -0.25 * math.log(0.5) - 0.75 * math.log(0.5)
        torch.testing.assert_close(categorical_cross_entropy(prior, student), torch.tensor(expected).double())

    def test_entropy_of_a_certain_action_is_zero(self) -> None:
        certain = torch.log_softmax(vector(1000.0, 0.0, -1000.0), -1)
        assert categorical_cross_entropy(certain, certain) == 0

    @given(logits, logits)
    def test_agrees_with_torch_distributions(self, student: Tensor, prior: Tensor) -> None:
        pi, pi0 = Categorical(logits=student), Categorical(logits=prior)
        torch.testing.assert_close(
            categorical_cross_entropy(pi.logits, pi0.logits), kl_divergence(pi, pi0) + pi.entropy()
        )

    @given(logits, logits)
    def test_cross_entropy_is_least_for_the_student_itself(self, student: Tensor, prior: Tensor) -> None:
        student, prior = student.log_softmax(-1), prior.log_softmax(-1)
        assert categorical_cross_entropy(student, prior) >= categorical_cross_entropy(student, student) - 1e-9

    def test_only_the_last_dimension_is_summed(self) -> None:
        student, prior = torch.randn(2, 3, 4).log_softmax(-1), torch.randn(2, 3, 4).log_softmax(-1)
        result = categorical_cross_entropy(student, prior)
        assert result.shape == (2, 3)
        for i in range(2):
            for j in range(3):
                expected = -sum(student[i, j, a].exp() * prior[i, j, a] for a in range(4))
                torch.testing.assert_close(result[i, j], expected)


class TestGaussian:
    def test_cross_entropy_of_gaussians_is_that_worked_out_by_hand(self) -> None:
        # dimension 0: (2^2 + 1^2) / 2 + log 1; dimension 1: (1 + 3^2) / (2 * 4) + log 2; each + log(2 pi) / 2
        result = gaussian_cross_entropy(vector(1.0, 3.0), vector(2.0, 1.0), vector(0.0, 0.0), vector(1.0, 2.0))
        torch.testing.assert_close(result, torch.tensor(2.5 + 1.25 + math.log(2) + math.log(2 * math.pi)).double())

    def test_cross_entropy_is_the_integral_of_its_definition(self) -> None:
        loc, scale, prior_loc, prior_scale = vector(0.7), vector(0.4), vector(-1.1), vector(1.9)
        x = torch.linspace(-6, 6, 20001, dtype=torch.float64)
        integrand = -Normal(loc, scale).log_prob(x).exp() * Normal(prior_loc, prior_scale).log_prob(x)
        torch.testing.assert_close(
            gaussian_cross_entropy(loc, scale, prior_loc, prior_scale), torch.trapezoid(integrand, x), rtol=1e-6, atol=0
        )

    @given(floats(-5, 5, 3), floats(0.05, 5, 3), floats(-5, 5, 3), floats(0.05, 5, 3))
    def test_agrees_with_torch_distributions(
        self, loc: Tensor, scale: Tensor, prior_loc: Tensor, prior_scale: Tensor
    ) -> None:
        pi, pi0 = Normal(loc, scale), Normal(prior_loc, prior_scale)
        torch.testing.assert_close(
            gaussian_cross_entropy(loc, scale, prior_loc, prior_scale), (kl_divergence(pi, pi0) + pi.entropy()).sum(-1)
        )

    def test_descent_moves_the_student_to_the_prior_mean(self) -> None:
        loc = vector(1.0, -2.0).requires_grad_()
        prior_loc, scale = vector(0.0, 0.0), vector(0.5, 2.0)
        (gradient,) = torch.autograd.grad(gaussian_cross_entropy(loc, scale, prior_loc, scale), loc)
        torch.testing.assert_close(gradient, (loc.detach() - prior_loc) / scale.square())


def shift_by_loop(
    value: Tensor, boundary: Tensor, done: Tensor, terminated: Tensor, traj_ids: Tensor
) -> tuple[list[bool], list[float]]:
    """The definition for one row of time steps, step by step."""
    has_next, shifted = [], []
    for t in range(len(value)):
        follows = t + 1 < len(value) and not done[t] and traj_ids[t] == traj_ids[t + 1]
        has_next.append(bool(follows))
        if terminated[t]:
            shifted.append(0.0)
        else:
            shifted.append((value[t + 1] if follows else boundary[t]).item())
    return has_next, shifted


class TestShift:
    def test_every_way_a_step_can_end(self) -> None:
        # steps:        inside   terminated  truncated  seam between workers  inside   end of the batch
        done = torch.tensor([NO, YES, YES, NO, NO, NO])
        terminated = torch.tensor([NO, YES, NO, NO, NO, NO])
        traj_ids = torch.tensor([0, 0, 1, 2, 3, 3])
        value = vector(-1, -2, -3, -4, -5, -6)
        boundary = vector(-10, -20, -30, -40, -50, -60)
        has_next = has_next_action(done, traj_ids, time_dim=0)
        assert has_next.tolist() == [YES, NO, NO, NO, YES, NO]
        shifted = shift_to_next(value, boundary, has_next, terminated, time_dim=0)
        assert shifted.tolist() == [-2, 0, -30, -40, -6, -60]

    def test_without_ids_a_seam_cannot_be_told_from_a_step(self) -> None:
        done = torch.tensor([NO, NO])
        assert has_next_action(done, time_dim=0).tolist() == [YES, NO]
        assert has_next_action(done, torch.tensor([0, 1]), time_dim=0).tolist() == [NO, NO]

    @given(st.data(), st.integers(1, 8), st.integers(1, 3))
    def test_equals_a_loop_over_steps(self, data: st.DataObject, steps: int, rows: int) -> None:
        def grid(elements: st.SearchStrategy[float]) -> Tensor:
            row = st.lists(elements, min_size=steps, max_size=steps)
            return torch.tensor(data.draw(st.lists(row, min_size=rows, max_size=rows)))

        value, boundary = grid(st.floats(-9, 0, width=32)), grid(st.floats(-9, 0, width=32))
        done, ids = grid(st.booleans()), grid(st.integers(0, 1))
        terminated = done & grid(st.booleans())
        for time_dim, shape in ((1, (rows, steps, 1)), (-2, (rows, steps, 1)), (1, (rows, steps))):
            has_next = has_next_action(done.reshape(shape), ids.reshape(shape), time_dim=time_dim)
            shifted = shift_to_next(
                value.reshape(shape), boundary.reshape(shape), has_next, terminated.reshape(shape), time_dim=time_dim
            )
            assert has_next.shape == shifted.shape == shape
            for r in range(rows):
                expected = shift_by_loop(value[r], boundary[r], done[r], terminated[r], ids[r])
                assert (has_next.reshape(rows, steps)[r].tolist(), shifted.reshape(rows, steps)[r].tolist()) == expected

    def test_time_may_be_any_dimension(self) -> None:
        value, done = torch.randn(5, 3), torch.rand(5, 3) < 0.4
        has_next = has_next_action(done, time_dim=0)
        torch.testing.assert_close(has_next_action(done.T, time_dim=1), has_next.T)
        torch.testing.assert_close(
            shift_to_next(value.T, -7.0, has_next.T, done.T, time_dim=1),
            shift_to_next(value, -7.0, has_next, done, time_dim=0).T,
        )

    def test_the_first_step_is_shifted_to_nowhere(self) -> None:
        has_next = has_next_action(torch.tensor([NO, NO, NO]), time_dim=0)
        no_end = torch.zeros(3, dtype=torch.bool)
        first, other = vector(float("nan"), -2, -3), vector(-1, -2, -3)
        torch.testing.assert_close(
            shift_to_next(first, -9.0, has_next, no_end, time_dim=0),
            shift_to_next(other, -9.0, has_next, no_end, time_dim=0),
        )

    def test_advice_on_the_next_episode_is_never_credited(self) -> None:
        value = vector(-1, -2, -3, -4)
        done = torch.tensor([NO, YES, NO, YES])
        before = shift_to_next(value, -9.0, has_next_action(done, time_dim=0), done, time_dim=0)
        value[2:] = -100
        after = shift_to_next(value, -9.0, has_next_action(done, time_dim=0), done, time_dim=0)
        assert before[:2].tolist() == after[:2].tolist() == [-2, 0]


class TestBonus:
    def test_e2r_and_er_bonuses_of_one_episode_by_hand(self) -> None:
        log_prob, weight = vector(-1, -2, -4), vector(0.5, 0.25, 0.75)
        end = torch.tensor([NO, NO, YES])
        shifted = shift_to_next(log_prob, -9.0, has_next_action(end, time_dim=0), end, time_dim=0)
        weight_next = vector(0.25, 0.75, 1.0)
        assert prior_bonus(weight, log_prob).tolist() == [-0.5, -0.5, -3]
        assert prior_bonus(weight_next, shifted).tolist() == [-0.5, -3, 0]

    @given(logits, logits)
    def test_alignment_ranks_actions_as_the_prior_and_averages_to_zero(self, student: Tensor, prior: Tensor) -> None:
        student, prior = student.log_softmax(-1), prior.log_softmax(-1)
        result = alignment(prior, categorical_cross_entropy(student, prior))
        torch.testing.assert_close((student.exp() * result).sum(), vector(0.0).sum(), rtol=0, atol=1e-9)
        torch.testing.assert_close(result - result[0], prior - prior[0])


class TestTdResidual:
    def test_td_residual_is_that_worked_out_by_hand(self) -> None:
        value, next_value = vector(1, 2), vector(2, 50)
        result = td_residual(value, vector(3, 5), next_value, torch.tensor([NO, YES]), 0.5, bonus=vector(-1, -0.5))
        assert result.tolist() == [3 - 1 + 0.5 * 2 - 1, 5 - 0.5 - 2]

    def test_the_values_of_a_two_state_mdp_leave_no_residual(self) -> None:
        # A -> B pays 1, B -> A pays 3, gamma = 1/2: V_A = 1 + V_B / 2, V_B = 3 + V_A / 2
        value = vector(10 / 3, 14 / 3)
        result = td_residual(value, vector(1, 3), value.flip(0), torch.tensor([NO, NO]), 0.5)
        torch.testing.assert_close(result, vector(0, 0))

    def test_with_a_bonus_the_values_shift_by_the_discounted_bonuses(self) -> None:
        # the same MDP with a bonus of -1 on each step: every value falls by 1 / (1 - gamma) = 2
        value = vector(10 / 3 - 2, 14 / 3 - 2)
        result = td_residual(value, vector(1, 3), value.flip(0), torch.tensor([NO, NO]), 0.5, bonus=-1.0)
        torch.testing.assert_close(result, vector(0, 0))

    @pytest.mark.parametrize("garbage", [math.nan, math.inf, -1e30])
    def test_the_value_after_the_end_is_never_read(self, garbage: float) -> None:
        next_value = vector(2.0, garbage).requires_grad_()
        result = td_residual(vector(1, 2), vector(3, 5), next_value, torch.tensor([NO, YES]), 0.5)
        assert result.tolist() == [3, 3]
        (gradient,) = torch.autograd.grad(result.sum(), next_value)
        assert gradient.tolist() == [0.5, 0]


class TestPriorWeightLoss:
    def test_value_and_gradient_by_hand(self) -> None:
        weight = vector(0.5).requires_grad_()
        loss = prior_weight_loss(vector(-1.0), weight, vector(-4.0))
        (gradient,) = torch.autograd.grad(loss.sum(), weight)
        assert loss.item() == (-1 + 0.5 * 4) ** 2
        assert gradient.item() == -2 * -4 * (-1 + 0.5 * 4)

    def test_loss_of_the_weight_is_the_squared_residual_of_the_shaped_return(self) -> None:
        # The paper's form, [V - R - gamma V' - B(w)]^2, is that of td_residual with the bonus in it.
        value, reward, next_value, signal = torch.randn(4, 10)
        weight, end = torch.rand(10), torch.rand(10) < 0.3
        target = -td_residual(value, reward, next_value, end, 0.9)
        with_bonus = value - reward - 0.9 * next_value * ~end - prior_bonus(weight, signal)
        torch.testing.assert_close(prior_weight_loss(target, weight, signal), with_bonus.square())

    @given(st.floats(-5, 5), st.floats(-5, 5).filter(lambda x: abs(x) > 0.1))
    def test_minimiser_of_the_weights_loss_is_target_over_signal(self, target: float, signal: float) -> None:
        best = target / signal
        low, least, high = (
            prior_weight_loss(vector(target), vector(w), vector(signal)).item() for w in (best - 0.1, best, best + 0.1)
        )
        assert least == pytest.approx(0, abs=1e-12)
        assert least < low
        assert least < high

    @pytest.mark.parametrize(("advantage", "grows"), [(1.0, True), (-1.0, False)])
    def test_the_weight_grows_where_preferred_actions_turn_out_well(self, advantage: float, grows: bool) -> None:
        logit = torch.zeros(1, requires_grad=True)
        prefers = alignment(torch.tensor([-0.1]), torch.tensor([1.4]))
        prior_weight_loss(torch.tensor([advantage]), logit.sigmoid(), prefers).sum().backward()
        assert logit.grad is not None
        assert (logit.grad.item() < 0) is grows

    def test_no_advice_leaves_the_weight_alone(self) -> None:
        weight = vector(0.3).requires_grad_()
        (gradient,) = torch.autograd.grad(prior_weight_loss(vector(7.0), weight, vector(0.0)).sum(), weight)
        assert gradient.item() == 0


ONE_STEP = torch.tensor([[NO], [YES]])
CALLS: dict[str, tuple[Callable[..., Tensor], Callable[[], tuple[Tensor | float, ...]], dict[str, int]]] = {
    "alignment": (alignment, lambda: (torch.randn(3), torch.rand(3)), {}),
    "categorical_cross_entropy": (categorical_cross_entropy, lambda: (torch.randn(3, 2), torch.randn(3, 2)), {}),
    "gaussian_cross_entropy": (gaussian_cross_entropy, lambda: tuple(torch.rand(4, 3, 2) + 0.1), {}),
    "has_next_action": (has_next_action, lambda: (ONE_STEP, ONE_STEP.long()), {"time_dim": 0}),
    "joint": (joint, lambda: (torch.randn(3, 2), 1), {}),
    "prior_bonus": (prior_bonus, lambda: (torch.rand(3), torch.randn(3)), {}),
    "prior_weight_loss": (prior_weight_loss, lambda: tuple(torch.randn(3, 3)), {}),
    "shift_to_next": (shift_to_next, lambda: (torch.randn(2, 1), -9.0, ~ONE_STEP, ONE_STEP), {"time_dim": 0}),
    "td_residual": (td_residual, lambda: (*torch.randn(3, 2, 1), ONE_STEP, 0.9), {}),
}


@pytest.mark.parametrize("name", CALLS)
def test_compiles_into_one_graph_with_the_same_result(name: str) -> None:
    function, arguments, options = CALLS[name]
    values = arguments()
    compiled = torch.compile(function, backend="aot_eager", fullgraph=True)
    torch.testing.assert_close(compiled(*values, **options), function(*values, **options), rtol=0, atol=0)


def test_every_public_function_is_compiled_above() -> None:
    from torchrl_priors import functional

    assert set(CALLS) == set(functional.__all__)
