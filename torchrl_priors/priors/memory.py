"""Teachers with a memory, which a prior can't have."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from tensordict import NestedKey
from tensordict.nn import TensorDictModuleBase
from tensordict.utils import unravel_key
from torch import nn

_WAY = (
    "A prior is asked for its advice on states in any order. Let the teacher step along while the batch is collected,"
    " write the parameters of its distribution, and make a prior that reads them (see the guide to pitfalls)."
)


def refuse_hidden_states(module: TensorDictModuleBase) -> None:
    """Refuses a policy that reads a hidden state, which it writes for the next step, or where episodes begin."""
    written = set(module.out_keys)
    hidden = [key for key in module.in_keys if unravel_key(("next", key)) in written or _name(key) == "is_init"]
    if hidden:
        raise NotImplementedError(f"The teacher has a memory: it reads {hidden}. {_WAY}")


def _name(key: NestedKey) -> str:
    return key if isinstance(key, str) else key[-1]


@contextmanager
def without_memory(module: nn.Module) -> Iterator[None]:
    """Refuses a network that changes a buffer when it is run, as one that keeps its hidden state inside does."""
    before = {name: (buffer, buffer._version) for name, buffer in module.named_buffers()}
    yield
    changed = [
        name
        for name, buffer in module.named_buffers()
        if before[name][0] is not buffer or before[name][1] != buffer._version
    ]
    if changed:
        raise NotImplementedError(f"The teacher has a memory: it changed {', '.join(changed)} when it ran. {_WAY}")
