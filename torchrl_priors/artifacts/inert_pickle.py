"""Reading pickles without running them: arrays and numbers come out, everything else stays a stand-in.

A pickle is a program. Here each class or function that it names is replaced by a stand-in of this module, which records
what it was called with and does nothing else; a name that is not known is refused before anything is built.
"""

from __future__ import annotations

import io
import math
import pickle
import re
from typing import Any

import numpy as np

from torchrl_priors.artifacts.errors import InertPickleError, short
from torchrl_priors.artifacts.pickle_program import check_program

_SPACES = r"(gym|gymnasium)\.spaces(\.\w+)?\.(Box|Discrete|MultiDiscrete|MultiBinary|Dict|Tuple|Text)"
_NUMBERS = r"numpy\.(bool_?|u?int(8|16|32|64)|float(16|32|64))"
_NUMBER = re.compile(r"[biuf][1248]|bool_?|u?int(8|16|32|64)|float(16|32|64)")
_RANDOM = (
    r"numpy\.random(\.\w+)*\.(__generator_ctor|__bit_generator_ctor|__randomstate_ctor|Generator|PCG64|MT19937"
    r"|SeedSequence|__pyx_unpickle_SeedSequence)"
)
_KNOWN = re.compile(
    rf"{_SPACES}|{_NUMBERS}|{_RANDOM}"
    r"|collections\.OrderedDict"
    r"|stable_baselines3\.common\.running_mean_std\.RunningMeanStd"
    r"|stable_baselines3\.common\.vec_env\.vec_normalize\.VecNormalize"
)
MAX_BYTES = 1 << 25
"""The longest pickle that is read; statistics of large images have a million."""


class StandIn:
    """What is left of an object of the pickle: the name of its class, and its attributes as a dictionary."""

    pickled_name: str = ""

    def __new__(cls, *args: Any, **kwargs: Any) -> StandIn:
        """Records the arguments, however a pickle makes its objects."""
        self = super().__new__(cls)
        self.args, self.state = args, {}
        return self

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        pass

    args: tuple[Any, ...]
    state: dict[str, Any]

    def __setstate__(self, state: Any) -> None:
        if isinstance(state, tuple) and len(state) == 2 and isinstance(state[1], dict):
            state = {**(state[0] or {}), **state[1]}  # a class with slots
        self.state = state if isinstance(state, dict) else {"state": state}

    def __setitem__(self, key: Any, value: Any) -> None:
        self.state[key if isinstance(key, str) else short(key)] = value


class _DType(StandIn):
    """``numpy.dtype(code, align, copy)`` with the state ``(version, byteorder, ...)``."""

    def resolve(self) -> np.dtype[Any]:
        code: Any = self.args[0] if self.args else None
        if isinstance(code, type) and issubclass(code, StandIn):
            code = code.pickled_name.removeprefix("numpy.")
        order: Any = (self.state.get("state") or (0, "|"))[1]
        if not isinstance(code, str) or not _NUMBER.fullmatch(code) or order not in ("<", ">", "|", "="):
            raise InertPickleError(f"it has an array of type {short(code)}, numbers were expected")
        return np.dtype(code).newbyteorder(order)


class _Array(StandIn):
    """``_reconstruct(ndarray, (0,), b"b")`` with the state ``(version, shape, dtype, fortran_order, bytes)``."""

    def resolve(self) -> np.ndarray[Any, Any]:
        state = self.state.get("state")
        if not isinstance(state, tuple) or len(state) != 5:
            raise InertPickleError("it has an array without content")
        _, shape, dtype, fortran, data = state
        return _array(data, dtype, shape, "F" if fortran else "C")


class _FromBuffer(StandIn):
    """``_frombuffer(bytes, dtype, shape, order)``."""

    def resolve(self) -> np.ndarray[Any, Any]:
        if len(self.args) != 4:
            raise InertPickleError("it has an array without content")
        return _array(*self.args)


class _Scalar(StandIn):
    """``scalar(dtype, bytes)``."""

    def resolve(self) -> Any:
        if len(self.args) != 2:
            raise InertPickleError("it has a number without a value")
        return _array(self.args[1], self.args[0], (), "C").item()


class _Encode(StandIn):
    """``_codecs.encode(text, "latin1")``, or ``bytes()``: how protocols below 3 keep bytes."""

    def resolve(self) -> bytes:
        if self.pickled_name.endswith(".bytes") and not self.args:
            return b""
        text = self.args[0] if self.args else None
        if not isinstance(text, str) or self.args[1:] != ("latin1",):
            raise InertPickleError("it has text that is no bytes")
        return text.encode("latin1")


_NUMPY: dict[str, type[StandIn]] = {"numpy.dtype": _DType, "numpy.ndarray": StandIn}
_NUMPY |= {"_codecs.encode": _Encode, "builtins.bytes": _Encode, "__builtin__.bytes": _Encode}
for _core in ("numpy.core", "numpy._core"):
    _NUMPY |= {f"{_core}.multiarray._reconstruct": _Array, f"{_core}.multiarray.scalar": _Scalar}
    _NUMPY |= {f"{_core}.numeric._frombuffer": _FromBuffer}


def _array(data: Any, dtype: Any, shape: Any, order: Any) -> np.ndarray[Any, Any]:
    if isinstance(data, _Encode):
        data = data.resolve()
    kind = dtype.resolve() if isinstance(dtype, _DType) else None
    if kind is None or not isinstance(data, (bytes, bytearray)) or order not in ("C", "F"):
        raise InertPickleError("it has an array that is not one of numbers")
    if (
        not isinstance(shape, tuple)
        or len(shape) > 32
        or not all(type(size) is int and 0 <= size < 1 << 31 for size in shape)
    ):
        raise InertPickleError(f"it has an array of shape {short(shape)}")
    if math.prod(shape) * kind.itemsize != len(data):
        raise InertPickleError(f"it has an array of shape {shape} and type {kind} with {len(data)} bytes")
    native = np.frombuffer(bytes(data), dtype=kind).astype(kind.newbyteorder("="))
    return native.reshape(shape, order=order)


class _Unpickler(pickle.Unpickler):
    def find_class(self, module: str, name: str) -> type[StandIn]:
        full = f"{module}.{name}"
        base = _NUMPY.get(full)
        if base is None:
            if not _KNOWN.fullmatch(full):
                raise InertPickleError(
                    f"it names {full}, which is none of the arrays, spaces and statistics that are expected; nothing in"
                    " it was run"
                )
            base = StandIn
        return type(name, (base,), {"pickled_name": full})


def read_pickle(data: bytes) -> Any:
    """What a pickle holds: numbers, strings, containers, arrays, and a :class:`StandIn` for each other object.

    Nothing that it names is run. What is damaged, or names something unknown, is an :class:`InertPickleError`.
    """
    if len(data) > MAX_BYTES:
        raise InertPickleError(f"it is longer than {MAX_BYTES} bytes")
    try:
        check_program(data)
        return _Resolver(len(data)).resolve(_Unpickler(io.BytesIO(data)).load())
    except InertPickleError:
        raise
    except Exception as error:  # a damaged program can fail in any way
        raise InertPickleError(f"it is no pickle that can be read: {type(error).__name__}: {error}") from None


class _Resolver:
    """Puts arrays in place of their stand-ins, at any depth."""

    def __init__(self, room: int) -> None:
        self.room = room  # bytes of all arrays: those of the pickle, for each array of an honest one has its own
        # the original is kept beside its result, lest another object gets its id
        self.seen: dict[int, tuple[Any, Any]] = {}

    def resolve(self, value: Any) -> Any:
        if id(value) in self.seen:
            return self.seen[id(value)][1]
        self.seen[id(value)] = value, value
        if isinstance(value, (_Array, _FromBuffer, _Scalar, _Encode)):
            result = value.resolve()
            self.room -= len(result) if isinstance(result, bytes) else getattr(result, "nbytes", 0)
            if self.room < 0:
                raise InertPickleError("its arrays are larger than it is")
            self.seen[id(value)] = value, result
            return result
        if isinstance(value, dict):
            value.update({key: self.resolve(item) for key, item in value.items()})
        elif isinstance(value, list):
            value[:] = map(self.resolve, value)
        elif isinstance(value, tuple):
            result = tuple(map(self.resolve, value))
            self.seen[id(value)] = value, result
            return result
        elif isinstance(value, StandIn):
            value.state = {key: self.resolve(item) for key, item in value.state.items()}
        return value
