"""Teachers with a memory, which a prior can't have."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager, suppress
from typing import Any

import torch
from tensordict import NestedKey
from tensordict.nn import TensorDictModuleBase
from tensordict.utils import unravel_key
from torch import Tensor, nn

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


def _kept(module: nn.Module) -> dict[str, Any]:
    """What a network keeps between two calls: its buffers, and what TorchScript assigns to its modules."""
    kept: dict[str, Any] = dict(module.named_buffers())
    scripts = {path: child for path, child in module.named_modules() if isinstance(child, torch.jit.ScriptModule)}
    graphs: list[Any] = []
    for child in scripts.values():
        with suppress(RuntimeError):  # a module without a forward method
            graphs.append(child.graph)
    assigned = {node.s("name") for graph in graphs for node in graph.findAllNodes("prim::SetAttr")}
    for path, child in scripts.items():  # what is frozen assigns to the modules within it from outside
        kept.update({f"{path}.{name}": getattr(child, name) for name in assigned if hasattr(child, name)})
    return kept


@contextmanager
def without_memory(module: nn.Module) -> Iterator[None]:
    """Refuses a network that changes what it keeps when it is run, as one that keeps its hidden state inside does."""
    before = {name: (value, getattr(value, "_version", None)) for name, value in _kept(module).items()}
    yield
    changed = []
    for name, value in _kept(module).items():
        old, version = before[name]
        same = old is value if isinstance(value, Tensor) else old == value
        if not same or version != getattr(value, "_version", None):
            changed.append(name)
    if changed:
        raise NotImplementedError(f"The teacher has a memory: it changed {', '.join(changed)} when it ran. {_WAY}")
