"""The running normaliser."""

from __future__ import annotations

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from torchrl_priors.collectors import RunningNorm


@given(sizes=st.lists(st.integers(1, 30), min_size=1, max_size=6), offset=st.sampled_from([0.0, 1e3]))
def test_any_split_of_the_data_gives_the_statistics_of_the_whole(sizes: list[int], offset: float) -> None:
    data = torch.randn(sum(sizes), 3, dtype=torch.float64) * torch.tensor([0.1, 1.0, 30.0]) + offset
    norm = RunningNorm(3)
    for part in data.split(sizes):
        norm.update(part)
    torch.testing.assert_close(norm.mean, data.mean(0))
    torch.testing.assert_close(norm.var, data.var(0, correction=0))
    assert norm.count == len(data)


def test_the_first_update_forgets_the_initial_statistics() -> None:
    norm = RunningNorm(1)
    assert norm(torch.tensor([3.0])) == 3
    norm.update(torch.full((4, 1), 5.0))
    assert norm.mean == 5
    assert norm.var == 0


def test_forward_is_the_formula_in_float32_and_clipped() -> None:
    norm = RunningNorm(2, eps=0.5, clip=2.0)
    norm.update(torch.tensor([[0.0, 10.0], [4.0, 10.0]]))
    out = norm(torch.tensor([[3.0, 10.5], [100.0, -100.0]], dtype=torch.float64))
    expected = torch.tensor([[1 / 4.5**0.5, 0.5 / 0.5**0.5], [2.0, -2.0]])
    torch.testing.assert_close(out, expected)


def test_update_takes_all_leading_dimensions() -> None:
    data = torch.randn(4, 5, 2, 3)
    nested, flat = RunningNorm((2, 3)), RunningNorm((2, 3))
    nested.update(data)
    flat.update(data.reshape(20, 2, 3))
    assert nested.count == 20
    assert torch.equal(nested.mean, flat.mean)


def test_forward_never_changes_the_statistics() -> None:
    norm = RunningNorm(3).train()
    before = {key: value.clone() for key, value in norm.state_dict().items()}
    norm(torch.randn(100, 3))
    assert all(torch.equal(value, before[key]) for key, value in norm.state_dict().items())


def test_frozen_statistics_refuse_updates_until_they_are_freed() -> None:
    norm = RunningNorm(3).freeze()
    assert norm.frozen
    with pytest.raises(RuntimeError, match="frozen"):
        norm.update(torch.randn(2, 3))
    norm.freeze(False).update(torch.randn(2, 3))
    assert norm.count == 2


@pytest.mark.parametrize(
    ("data", "message"),
    [
        (torch.zeros(4, 2), "shape"),
        (torch.zeros(0, 3), "at least one"),
        (torch.tensor([[0.0, torch.nan, 0.0]]), "not finite"),
        (torch.tensor([[0.0, torch.inf, 0.0]]), "not finite"),
    ],
)
def test_bad_data_are_refused_and_leave_the_statistics_alone(data: torch.Tensor, message: str) -> None:
    norm = RunningNorm(3)
    norm.update(torch.randn(5, 3))
    before = norm.mean.clone()
    with pytest.raises(ValueError, match=message):
        norm.update(data)
    assert torch.equal(norm.mean, before)


def test_a_state_dict_carries_the_statistics_to_the_bit() -> None:
    norm, other = RunningNorm(3), RunningNorm(3)
    norm.update(torch.randn(50, 3))
    other.load_state_dict(norm.state_dict())
    data = torch.randn(7, 3)
    assert torch.equal(norm(data), other(data))
    norm.update(data)
    other.update(data)
    assert torch.equal(norm.var, other.var)
