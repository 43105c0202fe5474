"""Whether a pickle can be read in little time and memory: its program is followed, and nothing of it is built."""

from __future__ import annotations

import pickletools
from typing import IO, Any, NamedTuple

from torchrl_priors.artifacts.errors import InertPickleError

_MAX_STEPS = 1 << 17  # of the program: the statistics of hundreds of environments have fewer
_MAX_DEPTH = 32  # of tuples in tuples, and
_MAX_ENTRIES = 1000  # what they have in all: a shape, or the state of an array, has a few
_MAX_KEYS = 1000  # of dictionaries and sets that are no text: many that have one hash take a time that is quadratic


class _Size(NamedTuple):
    """Of an object that the program would build; only tuples have a depth."""

    depth: int = 0
    entries: int = 1
    is_text: bool = False


def check_program(data: bytes | IO[bytes]) -> None:
    """Refuses a pickle that would crash or never end in the hands of an unpickler that runs nothing.

    The danger is in what is hashed: tuples that are the key of a dictionary, at any depth and each time anew, if they
    are nested by the thousand or have the one before twice; and keys that all have one hash. Other objects are held to
    the number of steps. A file is left where the pickle ends. One that is damaged raises a :class:`ValueError` or
    :class:`LookupError`.
    """
    stack: list[_Size] = []
    marks: list[int] = []
    memo: dict[int, _Size] = {}
    keys = 0
    for step, (opcode, argument, _) in enumerate(pickletools.genops(data)):
        name = opcode.name
        if step >= _MAX_STEPS:
            raise InertPickleError(f"it is a program of more than {_MAX_STEPS} steps")
        if name == "MARK":
            marks.append(len(stack))
        elif name == "POP" and marks and marks[-1] == len(stack):
            marks.pop()
        elif name == "MEMOIZE":
            memo[len(memo)] = stack[-1]
        elif name.endswith("PUT"):
            index: Any = argument
            if not 0 <= index <= step:  # the unpickler makes a list of that length
                raise InertPickleError("it is damaged: its memo is out of range")
            memo[index] = stack[-1]
        elif name.endswith("GET"):
            stack.append(memo[argument])  # type: ignore[index]
        elif name == "DUP":
            stack.append(stack[-1])
        else:
            taken = _take(opcode, stack, marks)
            keys += sum(not key.is_text for key in taken[_KEYS[name]]) if name in _KEYS else 0
            if keys > _MAX_KEYS:
                raise InertPickleError(f"it has more than {_MAX_KEYS} keys that are no text")
            is_tuple, is_text = name in ("TUPLE", "TUPLE1", "TUPLE2", "TUPLE3"), name.endswith(("UNICODE", "STRING"))
            made = _tuple_of(taken) if is_tuple else _Size(is_text=is_text or name == "BINUNICODE8")
            stack += [made] * len(opcode.stack_after)


#: Which of the objects that an instruction takes are keys.
_KEYS = {
    "DICT": slice(0, None, 2),
    "SETITEM": slice(1, None, 2),
    "SETITEMS": slice(1, None, 2),
    "ADDITEMS": slice(1, None),
    "FROZENSET": slice(0, None),
}


def _take(opcode: pickletools.OpcodeInfo, stack: list[_Size], marks: list[int]) -> list[_Size]:
    """Takes from the stack what an instruction does: a number of objects, or all above a mark and some below it."""
    below, above = opcode.stack_before, []
    if pickletools.markobject in below:
        below = below[: below.index(pickletools.markobject)]
        start = marks.pop()
        above = stack[start:]
        del stack[start:]
    start = len(stack) - len(below)
    taken = stack[start:] + above
    del stack[start:]
    return taken


def _tuple_of(parts: list[_Size]) -> _Size:
    size = _Size(1 + max((part.depth for part in parts), default=0), 1 + sum(part.entries for part in parts))
    if size.depth > _MAX_DEPTH or size.entries > _MAX_ENTRIES:
        raise InertPickleError("it has tuples in tuples without end")
    return size
