"""Values by state, as TensorDict modules: a table, or the same in every state."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import torch
from tensordict import NestedKey, TensorDictBase
from tensordict.nn import TensorDictModule, TensorDictModuleBase
from torch import Tensor, nn


def by_state(
    values: Tensor | nn.Module | TensorDictModuleBase | Callable[..., Tensor],
    in_keys: Sequence[NestedKey] | None,
    out_key: NestedKey,
) -> TensorDictModuleBase:
    """Values ``[*B, K]`` of each state as a TensorDict module, of a table ``[S, K]`` or ``[*W, S, K]`` or a network.

    If ``in_keys`` are not given, a table reads ``"state"``, a network or function ``"observation"``.
    """
    if isinstance(values, TensorDictModuleBase):
        return values
    if not isinstance(values, Tensor):
        return TensorDictModule(values, in_keys=list(in_keys or ["observation"]), out_keys=[out_key])
    keys = ["state"] if in_keys is None else list(in_keys)
    if len(keys) != 1:
        raise ValueError(f"A table reads one key, the state, got in_keys={keys}.")
    return StateTable(values, in_key=keys[0], out_key=out_key, feature_dims=1)


def _read_state(tensordict: TensorDictBase, key: NestedKey) -> Tensor:
    """The integer states of a tensordict, ``[*B]``, whether they are stored as ``[*B]`` or ``[*B, 1]``."""
    state = tensordict.get(key, None)
    if state is None:
        raise KeyError(
            f"A table needs integer states under {key!r}, which is not among {sorted(map(str, tensordict.keys(True)))}."
        )
    if state.is_floating_point() or state.is_complex() or state.dtype is torch.bool:
        raise ValueError(f"A table is indexed by integer states, but {key!r} is of dtype {state.dtype}.")
    if tensordict.ndim and state.ndim == tensordict.ndim + 1 and state.shape[-1] == 1:
        state = state.squeeze(-1)
    return state.long()


class StateTable(TensorDictModuleBase):
    """Writes the entry of a table at the state of each step.

    Args:
        table (Tensor): ``[*W, S, *F]``: S states, entries of shape F, and a table for each of the leading dimensions W
            (e.g. a batch of worlds). A :class:`~torch.nn.Parameter` is learned, another tensor is a buffer.

    Keyword Args:
        in_key (NestedKey): integer states, ``[*W, ...]`` (or with a trailing dimension of 1).
        out_key (NestedKey): where to write ``[*W, ..., *F]``.
        feature_dims (int): the number of dimensions of F. Defaults to 0.

    Raises:
        ValueError: the table has too few dimensions, or the states are not integers or lack the leading dimensions W.
        KeyError: the states are missing.
        IndexError: a state is outside of ``[0, S)``.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> table = StateTable(torch.tensor([0.0, 10.0, 20.0]), in_key="state", out_key="value")
        >>> table(TensorDict(state=torch.tensor([2, 0]), batch_size=[2]))["value"]
        tensor([20.,  0.])
    """

    def __init__(self, table: Tensor, *, in_key: NestedKey, out_key: NestedKey, feature_dims: int = 0) -> None:
        super().__init__()
        if table.ndim <= feature_dims:
            raise ValueError(
                f"Expected a table with a dimension of states and {feature_dims} of features, got {tuple(table.shape)}."
            )
        self.in_keys = [in_key]
        self.out_keys = [out_key]
        self.batch_dims = table.ndim - feature_dims - 1
        self.learned = isinstance(table, nn.Parameter)
        if self.learned:
            self.table = table
        else:
            self.register_buffer("table", table.detach().clone())

    def reset_parameters(self) -> None:
        """Sets a learned table to 0."""
        if self.learned:
            nn.init.zeros_(self.table)

    def _reset_parameters(self, module: nn.Module) -> bool:
        # TorchRL resets the children of a network; a table has none
        any_reset = super()._reset_parameters(module)
        if module is self:
            self.reset_parameters()
            any_reset = any_reset or self.learned
        return any_reset

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Writes the entries at the states of ``tensordict``."""
        state = _read_state(tensordict, self.in_keys[0])
        return tensordict.set(self.out_keys[0], self.gather(state))

    def gather(self, state: Tensor) -> Tensor:
        """The entries at ``state``, from ``[*W, ...]`` to ``[*W, ..., *F]``."""
        worlds, num_states = self.table.shape[: self.batch_dims], self.table.shape[self.batch_dims]
        if state.shape[: self.batch_dims] != worlds:
            raise ValueError(
                f"The tables of a batch {tuple(worlds)} need states with these leading dimensions, but"
                f" {self.in_keys[0]!r} is of shape {tuple(state.shape)}."
            )
        flat = self.table.flatten(0, self.batch_dims)
        if worlds:
            world = torch.arange(worlds.numel(), device=state.device).reshape(
                *worlds, *[1] * (state.ndim - self.batch_dims)
            )
            if not torch.compiler.is_compiling() and ((state < 0) | (state >= num_states)).any():
                # it would silently read another world's entry
                raise IndexError(f"States under {self.in_keys[0]!r} must be in [0, {num_states}).")
            state = state + world * num_states
        else:
            state = torch.where(state < 0, num_states, state)  # -1 is an error too, not the last state
        return flat[state]


class Constant(TensorDictModuleBase):
    """Writes the same values at every step, under their names."""

    def __init__(self, values: dict[str, Tensor]) -> None:
        super().__init__()
        self.in_keys: list[NestedKey] = []
        self.out_keys = list(values)
        for name, value in values.items():
            self.register_buffer(name, value)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Writes them."""
        for name in self.out_keys:
            value = getattr(self, name)
            tensordict.set(name, value.to(tensordict.device).expand(*tensordict.batch_size, *value.shape))
        return tensordict
