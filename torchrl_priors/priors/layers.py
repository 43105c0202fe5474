"""The layers of teachers that were trained elsewhere, beside those of :mod:`torch.nn`."""

from __future__ import annotations

import math
from collections.abc import Sequence

from torch import Tensor, nn
from torch.compiler import is_compiling


class TeacherInput(nn.Module):
    r"""From raw observations to what a teacher's network reads.

    Normalises by frozen statistics, :math:`(x-\mu)/\sqrt{\sigma^2+\epsilon}` clipped, in float64 as NumPy does; divides
    pixels by 255; flattens; each only if asked to. ``shape`` is that of one observation, as that of both statistics.
    """

    def __init__(
        self,
        shape: Sequence[int],
        *,
        statistics: tuple[Tensor, Tensor] | None = None,
        eps: float = 1e-8,
        clip: float = 10.0,
        pixels: bool = False,
        flatten: bool = True,
    ) -> None:
        super().__init__()
        self.shape = tuple(shape)
        self.eps, self.clip = float(eps), float(clip)
        self.pixels, self.flatten = pixels, flatten
        self.mean: Tensor | None
        self.var: Tensor | None
        for name, value in zip(("mean", "var"), statistics or (None, None), strict=True):
            if value is not None and tuple(value.shape) != self.shape:
                raise ValueError(
                    f"The {name} of observations {self.shape} must be of that shape, got {tuple(value.shape)}."
                )
            self.register_buffer(name, None if value is None else value.detach().double().clone())

    @property
    def statistics(self) -> tuple[Tensor, Tensor] | None:
        """The mean and the variance, unless observations stay raw."""
        return None if self.mean is None or self.var is None else (self.mean, self.var)

    def forward(self, observation: Tensor) -> Tensor:
        """From raw observations ``[*B, *shape]`` to float32 ``[*B, *shape]``, or ``[*B, features]``."""
        batch_ndim = observation.ndim - len(self.shape)
        if batch_ndim < 0 or tuple(observation.shape[batch_ndim:]) != self.shape:
            raise ValueError(
                f"The teacher reads raw observations of shape [*B, {', '.join(map(str, self.shape))}], got"
                f" {tuple(observation.shape)}."
            )
        if self.pixels and observation.is_floating_point() and observation.numel() > 0 and not is_compiling():
            _check_pixels(observation)
        if self.mean is not None and self.var is not None:
            observation = (observation.to(self.mean) - self.mean) / (self.var + self.eps).sqrt()
            observation = observation.clamp(-self.clip, self.clip)
        observation = observation.float()
        if self.pixels:
            observation = observation / 255.0
        if not self.flatten:
            return observation
        return observation.reshape(*observation.shape[:batch_ndim], math.prod(self.shape))


def _check_pixels(observation: Tensor) -> None:
    """Refuses floats that are no raw pixels. Some have fractions, as of interpolation, which may overshoot 1 too."""
    low, high = float(observation.min()), float(observation.max())
    scaled = 0 < high <= 1 or (high < 2 and bool((observation != observation.round()).any()))
    if scaled or low < 0 or high > 255:
        raise ValueError(
            f"The teacher reads raw pixels from 0 to 255, got floats from {low:.3g} to {high:.3g}, as of ToTensorImage"
            " or ObservationNorm: keep the raw pixels under a key of their own."
        )


class StateIndependentStd(nn.Module):
    """A standard deviation that is the same in every state, from a mean ``[*B, A]`` to mean and std ``[*B, A]``."""

    def __init__(self, log_std: Tensor) -> None:
        super().__init__()
        self.log_std = nn.Parameter(log_std.detach().clone())

    def forward(self, mean: Tensor) -> tuple[Tensor, Tensor]:
        """The mean as it is, and the standard deviation."""
        return mean, self.log_std.exp().expand_as(mean)


class GaussianHead(nn.Module):
    """Mean and standard deviation ``[*B, A]`` from features ``[*B, F]``, its logarithm clamped as in SAC."""

    def __init__(self, features: int, act_dim: int, *, log_std_range: tuple[float, float] = (-20.0, 2.0)) -> None:
        super().__init__()
        self.features, self.act_dim = features, act_dim
        self.mean = nn.Linear(features, act_dim)
        self.log_std = nn.Linear(features, act_dim)
        self.log_std_range = tuple(log_std_range)

    def forward(self, features: Tensor) -> tuple[Tensor, Tensor]:
        """The mean and the standard deviation."""
        return self.mean(features), self.log_std(features).clamp(*self.log_std_range).exp()


class ScaleToBox(nn.Module):
    """Actions from [-1, 1] to the bounds ``[A]`` of a box, in the unit of the environment."""

    low: Tensor
    high: Tensor

    def __init__(self, low: Tensor, high: Tensor) -> None:
        super().__init__()
        self.register_buffer("low", low.detach().clone())
        self.register_buffer("high", high.detach().clone())

    def forward(self, action: Tensor) -> Tensor:
        """From ``[*B, A]`` in [-1, 1] to ``[*B, A]`` in the box."""
        return self.low + 0.5 * (action + 1.0) * (self.high - self.low)


class ClipToBox(nn.Module):
    """Clips actions to the bounds ``[A]`` of a box; an infinite one is kept as the largest number.

    Examples:
        >>> import torch
        >>> ClipToBox(torch.tensor([-1.0, -torch.inf]), torch.tensor([1.0, 2.0]))(torch.tensor([[-3.0, -3.0]]))
        tensor([[-1., -3.]])
    """

    low: Tensor
    high: Tensor

    def __init__(self, low: Tensor, high: Tensor) -> None:
        super().__init__()
        self.register_buffer("low", low.detach().nan_to_num())
        self.register_buffer("high", high.detach().nan_to_num())

    def forward(self, action: Tensor) -> Tensor:
        """From ``[*B, A]`` to ``[*B, A]`` in the box."""
        return action.clamp(self.low, self.high)


class NatureCNN(nn.Module):
    """The convolutions of Mnih et al., "Human-level control through deep reinforcement learning" (2015)."""

    def __init__(self, shape: Sequence[int], features: int = 512) -> None:
        super().__init__()
        channels, *size = shape
        for kernel, stride in ((8, 4), (4, 2), (3, 1)):
            size = [(pixels - kernel) // stride + 1 for pixels in size]
        if len(size) != 2 or min(size) < 1:
            raise ValueError(f"The NatureCNN reads images [C, H, W] of 36 x 36 pixels at least, got {tuple(shape)}.")
        self.shape = tuple(shape)
        self.features = features
        self.cnn = nn.Sequential(
            nn.Conv2d(channels, 32, 8, 4),
            nn.ReLU(),
            nn.Conv2d(32, 64, 4, 2),
            nn.ReLU(),
            nn.Conv2d(64, 64, 3, 1),
            nn.ReLU(),
            nn.Flatten(),
        )
        self.linear = nn.Sequential(nn.Linear(64 * math.prod(size), features), nn.ReLU())

    def forward(self, image: Tensor) -> Tensor:
        """From images ``[*B, C, H, W]`` to ``[*B, features]``."""
        batch = image.shape[:-3]
        return self.linear(self.cnn(image.reshape(-1, *self.shape))).reshape(*batch, self.features)
