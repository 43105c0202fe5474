"""What of a loss's output is wanted."""

from __future__ import annotations

from typing import Any

from tensordict import NestedKey, TensorDictBase
from tensordict.utils import unravel_key


class SelectedOutput:
    """``select_out_keys`` of a loss that reads some entries only if they are there.

    TensorDict's own takes a batch without such an entry for arguments by name, and leaves the output as it is.
    """

    _selected: list[NestedKey] | None = None

    def select_out_keys(self: Any, *out_keys: NestedKey) -> Any:
        """Keeps these entries of the output, in this order, until :meth:`reset_out_keys`; returns the loss.

        Raises:
            ValueError: the loss writes no such entry.
        """
        keys = [unravel_key(key) for key in out_keys]
        if unknown := [key for key in keys if key not in self.out_keys]:
            raise ValueError(f"{type(self).__name__} writes {self.out_keys}, got {unknown} to select.")
        self._selected = keys
        return self

    def reset_out_keys(self: Any) -> Any:
        """Keeps all entries of the output again; returns the loss."""
        self._selected = None
        return self

    def only_selected(self, out: TensorDictBase) -> TensorDictBase:
        """The entries of the output that are wanted."""
        return out if self._selected is None else out.select(*self._selected, strict=False)
