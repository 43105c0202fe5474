"""The presets against the table of methods."""

from __future__ import annotations

from dataclasses import FrozenInstanceError, replace

import pytest

from torchrl_priors.methods import METHODS, MethodSpec, get_method


@pytest.mark.parametrize(
    ("name", "bonus", "auxiliary", "adaptive", "weight_target"),
    [
        ("none", "none", False, False, "td"),
        ("er", "current", False, False, "td"),
        ("e2r", "next", True, False, "td"),
        ("aer", "current", False, True, "td"),
        ("ae2r", "next", True, True, "td"),
        ("kickstart", "none", True, False, "td"),
        ("aligned", "none", True, True, "advantage"),
        ("annealed_kickstart", "none", True, False, "td"),
        ("kl_penalty", "current", False, False, "td"),
    ],
)
def test_a_method_is_its_row_of_the_table(
    name: str, bonus: str, auxiliary: bool, adaptive: bool, weight_target: str
) -> None:
    spec = get_method(name)
    assert (spec.bonus, spec.auxiliary, spec.adaptive, spec.weight_target) == (
        bonus,
        auxiliary,
        adaptive,
        weight_target,
    )


def test_there_is_no_method_outside_the_table() -> None:
    papers_and_ours = {"none", "er", "e2r", "aer", "ae2r", "kickstart", "aligned"}
    assert set(METHODS) == papers_and_ours | {"annealed_kickstart", "kl_penalty", "pull"}


@pytest.mark.parametrize(("fixed", "adaptive"), [("er", "aer"), ("e2r", "ae2r")])
def test_the_adaptive_methods_differ_by_the_weight_alone(fixed: str, adaptive: str) -> None:
    assert replace(get_method(fixed), adaptive=True) == get_method(adaptive)


def test_aligned_is_a_pull_with_a_weight_learned_from_the_advantage() -> None:
    pull = replace(get_method("pull"), aux_coeff=1.0)
    assert replace(pull, adaptive=True, weight_target="advantage") == get_method("aligned")


def test_a_pull_is_a_constant_small_kickstart_that_averages_over_the_teachers_actions() -> None:
    assert replace(get_method("kickstart"), cross_entropy="teacher", aux_coeff=0.3) == get_method("pull")


def test_the_fields_baselines_are_relatives_of_kickstart_and_er() -> None:
    expected = replace(get_method("kickstart"), cross_entropy="teacher", annealed=True)
    assert get_method("annealed_kickstart") == expected
    assert get_method("kl_penalty") == replace(get_method("er"), relative=True)
    assert [name for name in METHODS if METHODS[name].annealed] == ["annealed_kickstart"]


@pytest.mark.parametrize("settings", [("next", False), ("none", False), ("current", True)])
def test_a_relative_bonus_is_the_current_one_without_a_weight(settings: tuple) -> None:
    bonus, adaptive = settings
    with pytest.raises(ValueError, match="relative bonus"):
        MethodSpec(bonus=bonus, auxiliary=False, adaptive=adaptive, relative=True)


@pytest.mark.parametrize("name", ["AE2R", "", "ppo"])
def test_an_unknown_method_is_an_error_that_lists_the_known_ones(name: str) -> None:
    with pytest.raises(ValueError, match="Unknown method") as error:
        get_method(name)
    assert repr(name) in str(error.value)
    assert all(known in str(error.value) for known in METHODS)


def test_a_preset_cannot_be_changed_in_place() -> None:
    with pytest.raises(FrozenInstanceError):
        get_method("er").adaptive = True  # type: ignore[misc]
    assert isinstance(get_method("er"), MethodSpec)
