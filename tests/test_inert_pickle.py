"""Claims about reading pickles without running them."""

from __future__ import annotations

import pickle
from typing import Any

import numpy as np
import pytest
from gymnasium import spaces

from torchrl_priors.artifacts.inert_pickle import InertPickleError, StandIn, read_pickle


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
