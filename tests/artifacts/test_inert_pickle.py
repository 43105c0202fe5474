"""Claims about reading pickles without running them."""

from __future__ import annotations

import pickle
from typing import Any

import numpy as np
import pytest
from gymnasium import spaces

from torchrl_priors.artifacts.errors import InertPickleError
from torchrl_priors.artifacts.inert_pickle import StandIn, read_pickle
from torchrl_priors.artifacts.pickle_program import check_program


@pytest.mark.parametrize("protocol", range(pickle.HIGHEST_PROTOCOL + 1))
@pytest.mark.parametrize(
    "array",
    [
        np.arange(6.0).reshape(2, 3),
        np.asfortranarray(np.arange(6, dtype=np.int32).reshape(2, 3)),
        np.array([1.5, -2.0], dtype=">f4"),
        np.zeros((0, 3)),
        np.array([True, False]),
        np.float32(0.1),
        np.int64(-7),
    ],
)
def test_arrays_and_numbers_come_out_as_they_were(array: Any, protocol: int) -> None:
    found = read_pickle(pickle.dumps({"value": array, "twice": [array, (array,)]}, protocol=protocol))
    for value in (found["value"], found["twice"][0], found["twice"][1][0]):
        np.testing.assert_array_equal(value, array)
        assert np.asarray(value).shape == np.shape(array)


def test_spaces_are_stand_ins() -> None:
    space = spaces.Box(-1.0, 2.0, (3,))
    space.seed(0)  # a generator of random numbers comes along
    found = read_pickle(pickle.dumps(space))
    assert isinstance(found, StandIn)
    assert found.pickled_name == "gymnasium.spaces.box.Box"
    np.testing.assert_array_equal(found.state["high"], space.high)


@pytest.mark.parametrize(
    ("data", "match"),
    [
        (b"cos\nsystem\n(S'false'\ntR.", r"names os\.system"),
        (pickle.dumps(eval), r"names builtins\.eval"),
        (pickle.dumps(np.load), r"names numpy\.load"),
        (pickle.dumps(np.array([object()])), "names builtins.object"),
        (pickle.dumps(np.array(["text"])), "type 'U4', numbers were expected"),
        (pickle.dumps(np.array([None])), "type 'O8', numbers were expected"),
        (b"\x80\x02]r\xff\xff\xff\x7f.", "memo is out of range"),
        (b"", "no pickle that can be read"),
        (b"\x80\x04K\x01", "no pickle that can be read"),
        (
            b"cnumpy.core.multiarray\n_reconstruct\n(tR(K\x01(K\x05tcnumpy\ndtype\n(S'f8'\ntRI0\nC\x01atb.",
            "with 1 bytes",
        ),
        (b"(" * 10 + b"t" * 10 + b"0.", "no pickle that can be read"),
        (b"cnumpy\ndtype\n}b.", "no pickle that can be read"),
    ],
)
def test_everything_else_is_refused(data: bytes, match: str) -> None:
    with pytest.raises(InertPickleError, match=match):
        read_pickle(data)


# Pickles of one array: what comes before its shape, and what after.
BEFORE = b"\x80\x04cnumpy.core.multiarray\n_reconstruct\n)R(K\x01"
AFTER = b"cnumpy\ndtype\n(\x8c\x02f8K\x00K\x01tR\x89C\x00tb."


def twice(times: int) -> bytes:
    """A tuple with the one before it twice, and so on."""
    return b")" + b"".join(b"\x94h" + bytes([number]) + b"\x86" for number in range(times))


@pytest.mark.parametrize(
    ("data", "match"),
    [
        (b"\x80\x04})" + b"\x85" * 100_000 + b"K\x01s.", "tuples in tuples"),  # hashing one crashes
        (b"\x80\x04}(0)" + b"\x85" * 100_000 + b"K\x01s.", "tuples in tuples"),  # after a mark that is taken back
        (b"\x80\x04}" + twice(60) + b"K\x01s.", "tuples in tuples"),  # hashing one never ends
        (BEFORE + twice(20) + AFTER, "tuples in tuples"),  # writing it into a message needs 100 MB
        (b"\x80\x04(" + b"K\x01" * 2000 + b"t.", "tuples in tuples"),
        (pickle.dumps({(2**61 - 1) * number: 0 for number in range(2000)}), "more than 1000 keys that are no text"),
        (pickle.dumps(dict.fromkeys(range(2000), 0), protocol=0), "more than 1000 keys that are no text"),
        (pickle.dumps(set(range(2000)), protocol=4), "more than 1000 keys that are no text"),
        (pickle.dumps(frozenset(range(2000)), protocol=4), "more than 1000 keys that are no text"),
        (b"\x80\x04]" + b"]a" * 70_000 + b".", "more than 131072 steps"),
        (BEFORE + b"(" + b"\x8a\xff" + b"\x7f" * 255 + b"t" + AFTER, r"array of shape \(\d+\.\.\."),
        (BEFORE + b"(" + b"K\x01" * 40 + b"t" + AFTER, r"array of shape \(1, 1, "),
        (b"\x80\x04]q\xffp1000000\n.", "memo is out of range"),
    ],
)
def test_programs_without_end_are_refused_before_they_run(data: bytes, match: str) -> None:
    with pytest.raises(InertPickleError, match=match) as caught:
        read_pickle(data)
    assert len(str(caught.value)) < 200


class View:
    """Is pickled as an array of bytes that others have too."""

    def __init__(self, data: bytes) -> None:
        self.data = data

    def __reduce__(self) -> Any:
        return np.zeros(1).__reduce_ex__(5)[0], (self.data, np.dtype(np.float64), (len(self.data) // 8,), "C")


def test_arrays_of_one_buffer_do_not_fill_the_memory() -> None:
    data = bytes(8000)
    assert read_pickle(pickle.dumps(View(data))).shape == (1000,)
    with pytest.raises(InertPickleError, match="its arrays are larger than it is"):
        read_pickle(pickle.dumps([View(data), View(data)]))


@pytest.mark.parametrize(
    "value",
    [
        {(1, (2, 3)): ((), ((),))},
        {str(n): n for n in range(2000)},
        np.arange(3),
        spaces.Tuple([spaces.Discrete(2)] * 3),
    ],
)
def test_honest_pickles_are_read(value: Any) -> None:
    for protocol in range(pickle.HIGHEST_PROTOCOL + 1):
        check_program(pickle.dumps([value, value], protocol=protocol))
