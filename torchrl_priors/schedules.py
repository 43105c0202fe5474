"""Coefficients that change over training by a schedule: the alternative to a learned prior weight."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor, nn

if TYPE_CHECKING:
    from torchrl.trainers import Trainer

__all__ = ["CoeffScheduler", "CosineSchedule", "LinearSchedule", "PiecewiseSchedule", "Schedule"]


class Schedule(ABC):
    """A value as a pure function of the number of frames so far, of any shape."""

    def __call__(self, frames: Tensor | float) -> Tensor:
        """The value after so many frames; elementwise, in float32, or in float64 for a number."""
        frames = frames.float() if isinstance(frames, Tensor) else torch.tensor(float(frames), dtype=torch.float64)
        return self._value(frames)

    @abstractmethod
    def _value(self, frames: Tensor) -> Tensor: ...


@dataclass(frozen=True)
class _StartToEnd(Schedule):
    """From ``start`` to ``end`` in so many ``frames``, then constant."""

    start: float
    end: float
    frames: float

    def __post_init__(self) -> None:
        _check(self, self.frames, [self.start, self.end])

    def _part(self, frames: Tensor) -> Tensor:
        """How far the way is done, in [0, 1]."""
        return (frames / self.frames).clamp(0.0, 1.0)


@dataclass(frozen=True)
class LinearSchedule(_StartToEnd):
    r"""From ``start`` to ``end`` in a straight line, then constant.

    .. math::
        c(n) = (1-p)\,c_0 + p\,c_1,\quad p = \min(n / N, 1)

    Args:
        start (float): :math:`c_0`.
        end (float): :math:`c_1`.
        frames (float): :math:`N`, when the end is reached.

    Raises:
        ValueError: ``frames`` is not positive, or a value is not finite.

    Examples:
        >>> anneal = LinearSchedule(1.0, 0.0, frames=1000)
        >>> [anneal(frames).item() for frames in (0, 250, 1000, 5000)]
        [1.0, 0.75, 0.0, 0.0]
    """

    def _value(self, frames: Tensor) -> Tensor:
        part = self._part(frames)
        return self.start * (1 - part) + self.end * part


@dataclass(frozen=True)
class CosineSchedule(_StartToEnd):
    r"""From ``start`` to ``end`` along half a period of a cosine, slowly at both ends, then constant.

    .. math::
        c(n) = c_1 + (c_0 - c_1)\,\tfrac12(1 + \cos \pi p),\quad p = \min(n / N, 1)

    After Loshchilov & Hutter, "SGDR: Stochastic Gradient Descent with Warm Restarts", without restarts. Its arguments
    and errors are those of :class:`LinearSchedule`.

    Examples:
        >>> anneal = CosineSchedule(1.0, 0.0, frames=900)
        >>> [round(anneal(frames).item(), 6) for frames in (0, 300, 600, 900, 1200)]
        [1.0, 0.75, 0.25, 0.0, 0.0]
    """

    def _value(self, frames: Tensor) -> Tensor:
        part = (1 + torch.cos(math.pi * self._part(frames))) / 2
        return self.start * part + self.end * (1 - part)


@dataclass(frozen=True)
class PiecewiseSchedule(Schedule):
    """Straight lines between given points; constant before the first and after the last.

    Args:
        points (sequence of pairs of float): ``(frames, value)``, at increasing frames.

    Raises:
        ValueError: there is no point, or frames do not increase, or a number is not finite.

    Examples:
        >>> hold_then_anneal = PiecewiseSchedule([(100, 1.0), (200, 0.5), (400, 0.0)])
        >>> [hold_then_anneal(frames).item() for frames in (0, 100, 150, 200, 300, 1000)]
        [1.0, 1.0, 0.75, 0.5, 0.25, 0.0]
    """

    points: Sequence[tuple[float, float]]

    def __post_init__(self) -> None:
        points = tuple((float(frames), float(value)) for frames, value in self.points)
        object.__setattr__(self, "points", points)
        if not points:
            raise ValueError("PiecewiseSchedule needs at least one point (frames, value).")
        frames = [point[0] for point in points]
        if sorted(set(frames)) != frames:
            raise ValueError(f"The points of PiecewiseSchedule must be at increasing frames, got {frames}.")
        _check(self, 1.0, [number for point in points for number in point])

    def _value(self, frames: Tensor) -> Tensor:
        result = torch.full_like(frames, self.points[0][1])
        for (first, start), (last, end) in zip(self.points, self.points[1:], strict=False):
            part = ((frames - first) / (last - first)).clamp(0.0, 1.0)
            result = torch.where(frames >= first, start * (1 - part) + end * part, result)
        return result


def _check(schedule: Schedule, frames: float, values: Sequence[float]) -> None:
    name = type(schedule).__name__
    if not 0 < frames < math.inf:
        raise ValueError(f"{name} needs a positive number of frames, got {frames}.")
    if not all(math.isfinite(value) for value in values):
        raise ValueError(f"The values of {name} must be finite, got {list(values)}.")


class CoeffScheduler:
    """Keeps a coefficient of a loss or a transform at what a schedule says.

    TorchRL's losses hold their coefficients as buffers that may be assigned at any time
    (:meth:`~torchrl.objectives.LossModule.register_coeff_buffer`), but TorchRL 0.14 has schedulers for learning rates
    and replay buffers only. This one changes the buffer in place, so that whatever reads it sees the new value: the
    next forward pass, a :class:`~torchrl_priors.objectives.CompiledStep`, or the module after a move to another device.

    The value depends on the number of frames alone, and is set to its first value at once. To resume, load the state
    or call :meth:`step` with the frames so far: both give the same, before or after the module's state is loaded.

    Args:
        module (nn.Module): e.g. :class:`~torchrl_priors.AE2RLoss`, :class:`~torchrl_priors.PriorBonus` or any TorchRL
            loss.
        name (str): of the buffer, with dots where it belongs to a submodule: ``"aux_coeff"``,
            ``"prior_loss.aux_coeff"``.
        schedule (callable): from the number of frames to the value, e.g. :class:`LinearSchedule`.

    Raises:
        AttributeError: the module has no such buffer; the message names those that it has.
        TypeError: the buffer holds integers, and would round.

    Examples:
        >>> from torchrl_priors import PriorBonus
        >>> bonus = PriorBonus(bonus_coeff=1.0)
        >>> scheduler = CoeffScheduler(bonus, "bonus_coeff", LinearSchedule(1.0, 0.0, frames=1000))
        >>> for frames in (200, 400):  # once a batch: for data in collector: ...; frames += data.numel()
        ...     value = scheduler.step(frames)
        >>> value, bonus.bonus_coeff
        (0.6, tensor(0.6000))
    """

    def __init__(self, module: nn.Module, name: str, schedule: Callable[[float], Tensor | float]) -> None:
        self.module = module
        self.name = name
        self.schedule = schedule
        buffer = self._buffer()
        if not buffer.is_floating_point():
            raise TypeError(f"The coefficient {name!r} is of {buffer.dtype}: give it as a float (1.0, not 1).")
        self.step(0)

    def _buffer(self) -> Tensor:
        try:
            return self.module.get_buffer(self.name)
        except AttributeError:
            scalars = [name for name, buffer in self.module.named_buffers() if buffer.numel() == 1]
            raise AttributeError(
                f"{type(self.module).__name__} has no coefficient {self.name!r}; it has {', '.join(scalars) or 'none'}."
            ) from None

    def step(self, frames: int) -> float:
        """Set the coefficient for what comes after so many frames, counted from the beginning; its value."""
        self.frames = int(frames)
        self.value = float(self.schedule(frames))
        self._buffer().fill_(self.value)
        return self.value

    def state_dict(self) -> dict[str, Any]:
        """The number of frames at the last step."""
        return {"frames": self.frames}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Continue at the number of frames of a saved state, and set the coefficient."""
        self.step(state_dict["frames"])

    def register(self, trainer: Trainer, name: str = "coeff_scheduler") -> None:
        """Step after each batch of a :class:`~torchrl.trainers.Trainer`, and be part of its state.

        Args:
            trainer (Trainer): e.g. :class:`~torchrl.trainers.algorithms.PPOTrainer`.
            name (str): another one for each scheduler of a trainer. Defaults to ``"coeff_scheduler"``.
        """
        trainer.register_op("post_steps", lambda: self.step(trainer.collected_frames))
        trainer.register_module(name, self)
