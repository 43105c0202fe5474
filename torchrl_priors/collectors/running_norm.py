"""Running mean and variance of observations."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor, nn


class RunningNorm(nn.Module):
    """Normalises by the mean and standard deviation of all data seen so far: (x - mean) / sqrt(var + eps), clipped.

    The statistics change in :meth:`update` only, never in :meth:`forward`, in training mode or not: who collects data
    decides when. They are accumulated in float64 by the parallel formula of Chan, Golub and LeVeque ("Updating formulae
    and a pairwise algorithm for computing sample variances", 1979), so that batches of any size and order give the mean
    and the population variance of their union. Before the first update the mean is 0 and the variance 1.

    Args:
        shape (int or sequence of ints): shape of one datum, e.g. that of an observation.

    Keyword Args:
        eps (float): added to the variance.
        clip (float): bound of the absolute value of what is returned.

    Attributes:
        mean (Tensor): float64, ``shape``.
        var (Tensor): float64, ``shape``: population variance.
        count (Tensor): float64, scalar: the number of data seen.

    Examples:
        >>> norm = RunningNorm(2)
        >>> norm.update(torch.tensor([[0.0, 1.0], [2.0, 5.0]]))
        >>> norm.mean, norm.var
        (tensor([1., 3.], dtype=torch.float64), tensor([1., 4.], dtype=torch.float64))
        >>> norm(torch.tensor([2.0, 1.0]))
        tensor([ 1., -1.])
    """

    mean: Tensor
    var: Tensor
    count: Tensor

    def __init__(self, shape: int | Sequence[int], *, eps: float = 1e-8, clip: float = 10.0) -> None:
        super().__init__()
        self.shape = torch.Size([shape] if isinstance(shape, int) else shape)
        self.eps = eps
        self.clip = clip
        self._frozen = False
        self.register_buffer("mean", torch.zeros(self.shape, dtype=torch.float64))
        self.register_buffer("var", torch.ones(self.shape, dtype=torch.float64))
        self.register_buffer("count", torch.zeros((), dtype=torch.float64))

    @property
    def frozen(self) -> bool:
        """Whether the statistics are final."""
        return self._frozen

    def freeze(self, frozen: bool = True) -> RunningNorm:
        """Makes the statistics final (or not): :meth:`update` then raises. Not part of the ``state_dict``."""
        self._frozen = frozen
        return self

    @torch.no_grad()
    def update(self, x: Tensor) -> None:
        """Takes data ``[*B, *shape]`` into the statistics.

        Raises:
            RuntimeError: if the statistics are frozen.
            ValueError: if the trailing dimensions are not ``shape``, or if data are missing or not finite.
        """
        if self._frozen:
            raise RuntimeError("The statistics of this RunningNorm are frozen.")
        self._check_shape(x)
        data = x.to(self.mean).reshape(-1, *self.shape)
        if not data.shape[0]:
            raise ValueError("An update needs at least one datum.")
        if not data.isfinite().all():
            raise ValueError("The data are not finite: the statistics stay as they are.")
        number = float(data.shape[0])
        var, mean = torch.var_mean(data, dim=0, correction=0)
        total = self.count + number
        delta = mean - self.mean
        squares = self.var * self.count + var * number + delta.square() * (self.count * number / total)
        self.mean.add_(delta * (number / total))
        self.var.copy_(squares / total)
        self.count.copy_(total)

    def affine(self) -> tuple[Tensor, Tensor]:
        """The float32 mean and inverse standard deviation that :meth:`forward` uses, each of ``shape``."""
        return self.mean.to(torch.float32), (self.var + self.eps).rsqrt().to(torch.float32)

    def forward(self, x: Tensor) -> Tensor:
        """Normalises ``[*B, *shape]`` to float32 in ``[-clip, clip]``.

        Raises:
            ValueError: the trailing dimensions are not ``shape``; they are never broadcast.
        """
        self._check_shape(x)
        mean, inverse_std = self.affine()
        return ((x.to(torch.float32) - mean) * inverse_std).clamp(-self.clip, self.clip)

    def _check_shape(self, x: Tensor) -> None:
        if x.shape[x.ndim - len(self.shape) :] != self.shape:
            raise ValueError(f"Expected data of shape [..., {', '.join(map(str, self.shape))}], got {tuple(x.shape)}.")

    def extra_repr(self) -> str:
        """What ``repr`` shows."""
        return f"{tuple(self.shape)}, eps={self.eps}, clip={self.clip}"
