from __future__ import annotations

import zlib

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from torchrl_priors.random import derive_key, philox, uniform

INT64 = st.integers(-(2**63), 2**63 - 1)
WORD = st.integers(0, 2**32 - 1)


def philox_reference(counter: list[int], key: list[int], rounds: int = 10) -> list[int]:
    """Philox4x32 in Python integers, written from the paper's definition."""
    (c0, c1, c2, c3), (k0, k1) = counter, key
    for _ in range(rounds):
        first, second = 0xD2511F53 * c0, 0xCD9E8D57 * c2
        c0, c1, c2, c3 = (second >> 32) ^ c1 ^ k0, second % 2**32, (first >> 32) ^ c3 ^ k1, first % 2**32
        k0, k1 = (k0 + 0x9E3779B9) % 2**32, (k1 + 0xBB67AE85) % 2**32
    return [c0, c1, c2, c3]


@pytest.mark.parametrize(
    ("counter", "key", "expected"),
    [  # the known-answer tests of Random123
        ("00000000 00000000 00000000 00000000", "00000000 00000000", "6627e8d5 e169c58d bc57ac4c 9b00dbd8"),
        ("ffffffff ffffffff ffffffff ffffffff", "ffffffff ffffffff", "408f276d 41c83b0e a20bc7c6 6d5451fd"),
        ("243f6a88 85a308d3 13198a2e 03707344", "a4093822 299f31d0", "d16cfe09 94fdcceb 5001e420 24126ea1"),
    ],
)
def test_reference_of_these_tests_gives_the_published_answers(counter, key, expected):
    counter, key, expected = ([int(word, 16) for word in words.split()] for words in (counter, key, expected))
    assert philox_reference(counter, key) == expected


@given(key=INT64, first=WORD, second=WORD, rounds=st.sampled_from([1, 7, 10]))
def test_philox_gives_the_words_of_the_published_generator(key, first, second, rounds):
    expected = philox_reference([first, second, 0, 0], [key % 2**32, (key >> 32) % 2**32], rounds)
    words = philox(torch.tensor(key), (torch.tensor(first), torch.tensor(second)), rounds)
    assert [word.item() for word in words] == expected
    assert [word.item() for word in philox(torch.tensor(key), (first, second), rounds)] == expected


def test_every_bit_of_key_and_counter_matters():
    words = torch.stack(philox(torch.tensor(0), (0, 0)))
    for bit in range(64):
        key = (1 << bit) - (1 << 64 if bit == 63 else 0)
        assert not torch.equal(torch.stack(philox(torch.tensor(key), (0, 0))), words)
    for bit in range(32):
        assert not torch.equal(torch.stack(philox(torch.tensor(0), (1 << bit, 0))), words)
        assert not torch.equal(torch.stack(philox(torch.tensor(0), (0, 1 << bit))), words)


@given(keys=st.lists(INT64, min_size=1, max_size=5), step=WORD)
def test_row_draws_the_same_alone_and_in_any_batch(keys, step):
    batch = torch.stack(uniform(torch.tensor(keys), step))
    for row, key in enumerate(keys):
        assert torch.equal(torch.stack(uniform(torch.tensor(key), step)), batch[:, row])
    backwards = torch.stack(uniform(torch.tensor(keys[::-1]), step))
    assert torch.equal(backwards.flip(-1), batch)


def test_steps_broadcast_against_keys():
    keys, steps = torch.arange(3).unsqueeze(1), torch.arange(4)
    draws = uniform(keys, steps)[0]
    assert draws.shape == (3, 4)
    assert draws[2, 3] == uniform(torch.tensor(2), 3)[0]


@given(key=INT64, step=WORD)
def test_uniform_is_the_top_24_bits_of_each_word(key, step):
    words = philox_reference([step, 3, 0, 0], [key % 2**32, (key >> 32) % 2**32])
    draws = uniform(torch.tensor(key), step, 3)
    assert [draw.item() for draw in draws] == [(word >> 8) / 2**24 for word in words]
    assert all(draw.dtype is torch.float32 for draw in draws)


def test_uniform_is_uniform_and_uncorrelated():
    count = 20_000
    keys = derive_key(0, torch.arange(count))
    same_step = torch.stack(uniform(keys, 5))
    later = torch.stack(uniform(keys, 6))
    other_stream = torch.stack(uniform(keys, 5, 1))
    along_time = torch.stack(uniform(derive_key(7), torch.arange(count)))
    draws = torch.cat([same_step, later, other_stream, along_time])
    assert draws.min() >= 0
    assert draws.max() < 1
    assert (draws.mean(1) - 0.5).abs().max() < 5 * (1 / 12 / count) ** 0.5
    histogram = torch.stack([torch.histc(row, 20, 0, 1) for row in draws])
    chi_square = ((histogram - count / 20).square() / (count / 20)).sum(1)
    assert chi_square.max() < 55  # 19 degrees of freedom: exceeded with probability 2e-5
    correlation = torch.corrcoef(draws) - torch.eye(len(draws))
    assert correlation.abs().max() < 5 / count**0.5
    assert torch.corrcoef(torch.stack([along_time[0, 1:], along_time[0, :-1]]))[0, 1].abs() < 5 / count**0.5


def test_keys_tell_words_numbers_order_and_depth_apart():
    paths = [(), (0,), (1,), (0, 0), (0, 1), (1, 0), ("er",), ("aer",), ("er", "aer"), ("aer", "er"), ("",), ("", "")]
    paths += [("er", 1), (1, "er"), ("1",), (2**31,), (2**32,), (2**40,), (2**62,)]
    keys = {derive_key(seed, *path).item() for seed in (0, 1, -1, 2**40) for path in paths}
    assert len(keys) == 4 * len(paths)


def test_word_is_not_the_number_of_its_checksum():
    assert derive_key(3, "student") != derive_key(3, zlib.crc32(b"student"))


def test_keys_of_a_study_are_distinct_and_use_all_bits():
    seeds = torch.arange(1000).unsqueeze(1)
    keys = torch.stack([derive_key(seeds, "student", method, torch.arange(7)) for method in ("er", "e2r", "aer")])
    assert keys.unique().numel() == keys.numel()
    bits = (keys.flatten().unsqueeze(1) >> torch.arange(64)) & 1
    assert (bits.double().mean(0) - 0.5).abs().max() < 5 * 0.5 / keys.numel() ** 0.5


@given(seeds=st.lists(INT64, min_size=1, max_size=4), number=INT64)
def test_key_of_a_row_does_not_depend_on_the_batch(seeds, number):
    together = derive_key(torch.tensor(seeds), "run", number)
    assert together.tolist() == [derive_key(seed, "run", number).item() for seed in seeds]
    assert together.dtype is torch.int64


def test_key_differs_for_seeds_that_differ_in_one_bit():
    seeds = torch.tensor([0, *(1 << bit for bit in range(63))])
    assert derive_key(seeds, "x").unique().numel() == 64
