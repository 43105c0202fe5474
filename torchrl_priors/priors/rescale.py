"""The advice of a teacher in the unit of a student whose actions are scaled."""

from __future__ import annotations

from typing import Any, TypeGuard

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torch import distributions as d
from torchrl.modules import TanhNormal

from torchrl_priors.distributions import without_independent
from torchrl_priors.priors.prior import Prior, PriorWrapper


class RescaledPrior(PriorWrapper):
    r"""A Gaussian teacher of actions in ``[low, high]`` for a student of the same actions in ``[to_low, to_high]``.

    A student behind TorchRL's :class:`~torchrl.envs.ActionScaling` acts in [-1, 1], and its teacher perhaps in the unit
    of the environment. Mean and standard deviation are mapped by the line that takes one box to the other:
    :math:`\mu' = f\mu + b`, :math:`\sigma' = f\sigma`; of a :class:`~torchrl.modules.TanhNormal`, the bounds.

    Args:
        prior (Prior): over a :class:`~torchrl.modules.IndependentNormal` or :class:`~torchrl.modules.TanhNormal`. It is
            shared, and so are its namespace and keys.
        low, high (float or Tensor): the bounds of its actions, a number or ``[A]``.

    Keyword Args:
        to_low, to_high (float or Tensor): the bounds of the student's. Default to -1 and 1.

    Raises:
        ValueError: bounds that are not finite, or in the wrong order.
        NotImplementedError: at call, the distribution is another one.

    Examples:
        >>> from tensordict import TensorDict
        >>> from torchrl_priors import CallablePrior
        >>> pendulum = CallablePrior(lambda x: x, std=0.5)
        >>> batch = TensorDict(observation=torch.tensor([[-2.0], [1.0]]), batch_size=[2])
        >>> dist = RescaledPrior(pendulum, -2.0, 2.0).get_dist(batch)
        >>> dist.mean.flatten(), dist.stddev.flatten()
        (tensor([-1.0000,  0.5000]), tensor([0.2500, 0.2500]))
    """

    factor: Tensor
    shift: Tensor

    def __init__(
        self,
        prior: Prior,
        low: float | Tensor,
        high: float | Tensor,
        *,
        to_low: float | Tensor = -1.0,
        to_high: float | Tensor = 1.0,
    ) -> None:
        super().__init__(prior)
        boxes = [_bounds(low, high), _bounds(to_low, to_high)]
        (start, end), (to_start, to_end) = boxes
        self.register_buffer("factor", (to_end - to_start) / (end - start))
        self.register_buffer("shift", to_start - self.factor * start)
        self._boxes = boxes

    def get_params(self, tensordict: TensorDictBase) -> dict[str, Tensor]:
        """The parameters of the distribution by name, in the student's unit."""
        params = self.module.get_params(tensordict)
        dist = self.module.build_dist(params)
        if _is_gaussian(dist):
            return {"loc": self._map(params["loc"]), "scale": params["scale"] * self.factor}
        if type(dist) is not TanhNormal:
            raise NotImplementedError(
                f"A RescaledPrior is one of a Gaussian or a TanhNormal, got {type(dist).__name__}. Of a mixture,"
                " rescale its priors; of no advice, make a UniformPrior of the student's actions."
            )
        return params

    def build_dist(self, params: dict[str, Tensor]) -> d.Distribution:
        """The distribution in the student's unit."""
        dist = self.module.build_dist(params)
        if not isinstance(dist, TanhNormal):
            return dist
        bounds = {"low": self._map(dist.low), "high": self._map(dist.high)}
        return TanhNormal(**params, upscale=dist.upscale, tanh_loc=dist.tanh_loc, **bounds)

    def adversary(self) -> Prior:
        """The negated advice of the teacher, in the student's unit."""
        (low, high), (to_low, to_high) = self._boxes
        adversary = RescaledPrior(self.module.adversary(), low, high, to_low=to_low, to_high=to_high)
        return adversary.to(self.factor.device)

    def _map(self, action: Any) -> Tensor:
        return self.factor * action + self.shift


def _bounds(low: float | Tensor, high: float | Tensor) -> tuple[Tensor, Tensor]:
    start, end = (torch.as_tensor(bound, dtype=torch.get_default_dtype()) for bound in (low, high))
    if not (start.isfinite().all() and end.isfinite().all() and (start < end).all()):
        raise ValueError(
            f"Bounds of actions must be finite, the lower ones below the upper ones, got {start.tolist()} and"
            f" {end.tolist()}."
        )
    return start, end


def _is_gaussian(dist: Any) -> TypeGuard[d.Distribution]:
    return type(without_independent(dist)) is d.Normal
