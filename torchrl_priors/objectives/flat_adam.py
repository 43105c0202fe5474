"""Adam on parameters that lie end to end."""

from __future__ import annotations

import math

import torch
from torch import Tensor


class FlatParameters:
    """Parameters of one group at one step of Adam, and their state, end to end: few large operations, not many small.

    Each begins at a multiple of 64 bytes. The gaps are 0 and remain so.
    """

    def __init__(self, optimizer: torch.optim.Adam, group: int, parameters: list[Tensor]) -> None:
        self.group = group
        self.parameters = parameters
        self.options = optimizer.param_groups[group]
        self.states = [optimizer.state[parameter] for parameter in parameters]
        self.shapes = [parameter.shape for parameter in parameters]
        self.sizes = [-(-parameter.numel() // 16) * 16 for parameter in parameters]
        self.layout = (group, parameters[0].dtype, parameters[0].device, *self.shapes, *map(id, parameters))
        self.first = float(self.states[0]["step"])
        self.buffers = [parameters[0].new_zeros(sum(self.sizes)) for _ in range(3)]
        for buffer, tensors in zip(self.buffers, self._tensors(), strict=True):
            torch._foreach_copy_(self.split(buffer), tensors)

    def _tensors(self) -> list[list[Tensor]]:
        names = ("exp_avg", "exp_avg_sq")
        return [
            [parameter.detach() for parameter in self.parameters],
            *([state[name] for state in self.states] for name in names),
        ]

    def write(self, steps: int) -> None:
        """Back into the parameters and the optimizer, after so many steps."""
        for buffer, tensors in zip(self.buffers, self._tensors(), strict=True):
            torch._foreach_copy_(tensors, self.split(buffer))
        torch._foreach_add_([state["step"] for state in self.states], float(steps))

    def split(self, buffer: Tensor) -> list[Tensor]:
        """The parts of a buffer that are the parameters, in their shapes."""
        pieces, start = [], 0
        for shape, size in zip(self.shapes, self.sizes, strict=True):
            pieces.append(buffer[start : start + shape.numel()].view(shape))
            start += size
        return pieces

    def join(self, pieces: list[Tensor | None]) -> Tensor:
        """The inverse of :meth:`split`."""
        parts = []
        for piece, size in zip(pieces, self.sizes, strict=True):
            assert piece is not None
            parts.append(piece.reshape(-1))
            if size > piece.numel():
                parts.append(piece.new_zeros(size - piece.numel()))
        return torch.cat(parts)

    def factors(self, steps: int) -> tuple[float, float]:
        """Adam's step size and the scale of its second moment after so many more steps."""
        step, (beta, beta_sq) = self.first + steps, self.options["betas"]
        return float(self.options["lr"]) / (1 - beta**step), math.sqrt(1 - beta_sq**step)


def clip(gradients: list[Tensor], max_norm: float | None) -> list[Tensor]:
    """As :func:`torch.nn.utils.clip_grad_norm_`."""
    if max_norm is None or not gradients:
        return gradients
    norm = torch.stack([gradient.square().sum() for gradient in gradients]).sum().sqrt()
    factor = (max_norm / (norm + 1e-6)).clamp(max=1.0)
    return [gradient * factor for gradient in gradients]


def adam(
    parameter: Tensor,
    mean: Tensor,
    square: Tensor,
    gradient: Tensor,
    factors: Tensor,
    betas: tuple[float, float],
    eps: float,
) -> None:
    """As :class:`torch.optim.Adam`, in place; the factors are those of :meth:`FlatParameters.factors`."""
    rate, scale = factors.unbind()
    mean.lerp_(gradient, 1 - betas[0])
    square.mul_(betas[1]).addcmul_(gradient, gradient, value=1 - betas[1])
    parameter.sub_(rate * mean / (square.sqrt() / scale + eps))
