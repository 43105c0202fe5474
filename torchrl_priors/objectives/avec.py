"""AVEC: a critic that is trained on the variance of its residual."""

from __future__ import annotations

import contextlib
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor, nn


class ValueOffset(nn.Module):
    """Adds a constant to a value: the last layer of a critic that is trained by :class:`AVECMixin`.

    The constant is a buffer, no parameter: no loss trains it, :meth:`AVECMixin.update_value_offset` sets it.

    Args:
        init (float): the constant to begin with. Defaults to 0.0.

    Examples:
        >>> critic = nn.Sequential(nn.Linear(3, 1), ValueOffset())
        >>> critic(torch.zeros(5, 3)).shape
        torch.Size([5, 1])
    """

    def __init__(self, init: float = 0.0) -> None:
        super().__init__()
        self.register_buffer("offset", torch.tensor(float(init)))

    offset: Tensor

    def forward(self, value: Tensor) -> Tensor:
        """The value, of any shape, plus the constant."""
        return value + self.offset

    def reset_parameters(self) -> None:
        """Set the constant to 0."""
        self.offset.zero_()


class AVECMixin:
    r"""Replaces an l2 critic loss by the variance of the residual, :math:`\mathrm{Var}(f - \hat V)` over the minibatch.

    Flet-Berliac et al., "Learning Value Functions in Deep Policy Gradients using Residual Variance" (ICLR 2021),
    https://openreview.net/forum?id=NX1He-aFO_F. It combines with every loss of TorchRL that has a ``loss_critic`` and
    precomputed value targets::

        class AVECClipPPOLoss(AVECMixin, ClipPPOLoss): ...


        class AVECA2CLoss(AVECMixin, A2CLoss): ...

    With :math:`m` the mean of :math:`f - \hat V` over the minibatch, the critic regresses on :math:`\hat V + m` instead
    of :math:`\hat V`: its loss is the (biased) variance and its gradient that of the variance, in which the derivative
    of :math:`m` drops out. Steps that the loss masks out (``loss_mask_key``) do not count in :math:`m`. PPO has a hook
    through which :math:`m` comes from the values that the loss computes anyway; elsewhere it costs a second forward
    pass of the critic, without gradient.

    The variance leaves :math:`f` free up to a constant, which would enter every bootstrapped target and TD error: end
    the critic with a :class:`ValueOffset` and, after the epochs on a rollout, call :meth:`update_value_offset`.

    Keyword Args:
        loss_critic_type (str): only ``"l2"`` has a variance. Defaults to ``"l2"`` (not to the loss's own default).

    Raises:
        ValueError: ``loss_critic_type`` is not ``"l2"``.

    Examples:
        >>> from tensordict import TensorDict
        >>> from tensordict.nn import TensorDictModule
        >>> from torchrl.modules import ProbabilisticActor, ValueOperator
        >>> from torchrl.objectives import ClipPPOLoss
        >>> class AVECClipPPOLoss(AVECMixin, ClipPPOLoss):
        ...     pass
        >>> net = TensorDictModule(nn.Linear(3, 2), in_keys=["observation"], out_keys=["logits"])
        >>> actor = ProbabilisticActor(net, in_keys=["logits"], distribution_class=torch.distributions.Categorical)
        >>> critic = ValueOperator(nn.Sequential(nn.Linear(3, 1), ValueOffset()), in_keys=["observation"])
        >>> loss = AVECClipPPOLoss(actor, critic)
        >>> data = TensorDict(
        ...     {
        ...         "observation": torch.randn(5, 3),
        ...         "action": torch.zeros(5, dtype=torch.long),
        ...         "action_log_prob": -torch.ones(5),
        ...         "advantage": torch.randn(5, 1),
        ...         "value_target": torch.randn(5, 1),
        ...     },
        ...     [5],
        ... )
        >>> error = critic(data.clone())["state_value"] - data["value_target"]
        >>> torch.allclose(loss(data)["loss_critic"], error.var(correction=0))
        True
        >>> offset = loss.update_value_offset(data)
        >>> error = critic(data.clone())["state_value"] - data["value_target"]
        >>> bool(error.mean().abs() < 1e-6)
        True
    """

    _steps: TensorDictBase | None = None  # those of the minibatch, during a forward pass

    def __init__(self, *args: Any, loss_critic_type: str = "l2", **kwargs: Any) -> None:
        if loss_critic_type != "l2":
            raise ValueError(f"AVEC is the variance of the l2 critic loss, got loss_critic_type={loss_critic_type!r}.")
        super().__init__(*args, loss_critic_type=loss_critic_type, **kwargs)  # type: ignore[call-arg]
        self._has_hook = hasattr(super(), "_critic_loss_inputs")  # PPO's; what is asked here can't be traced

    def loss_critic(self: Any, tensordict: TensorDictBase) -> Any:
        """The critic loss of the parent, on targets moved by the mean residual of the minibatch."""
        if self._has_hook:
            self._steps = tensordict
            try:
                return super().loss_critic(tensordict)  # type: ignore[misc]
            finally:
                self._steps = None
        key = self.tensor_keys.value_target
        target = tensordict.get(key, None)
        if target is not None:  # else the parent says what is missing
            tensordict = tensordict.copy().set(key, target - self._mean_error(tensordict))
        return super().loss_critic(tensordict)  # type: ignore[misc]

    def _critic_loss_inputs(self: Any, target: Tensor, value: Tensor, old_value: Tensor | None) -> Any:
        """PPO's hook: the target moved by the mean residual of the minibatch."""
        target, value, old_value = super()._critic_loss_inputs(target, value, old_value)  # type: ignore[misc]
        error = (target - value).detach()
        return target - self._reduce_loss(error, self._steps, reduction="mean"), value, old_value

    @torch.no_grad()
    def update_value_offset(self: Any, tensordict: TensorDictBase) -> Tensor:
        r"""Set the critic's :class:`ValueOffset` to :math:`b = \mathrm{mean}(\hat V - f)`, in place.

        Call it after the epochs on a rollout, with the whole rollout: the value :math:`V = f + b` that the next
        advantages are estimated from is then right in the mean.

        Args:
            tensordict (TensorDictBase): the rollout, of any batch size, with value targets and what the critic reads.

        Returns:
            Tensor: the new offset, a scalar.

        Raises:
            ValueError: the critic has no :class:`ValueOffset`.
        """
        with self._critic_params():
            offsets = [module for module in self.critic_network.modules() if isinstance(module, ValueOffset)]
            if len(offsets) != 1:
                raise ValueError(
                    f"The critic must have one ValueOffset, as its last layer, found {len(offsets)}: build it as"
                    " nn.Sequential(..., ValueOffset())."
                )
            offset = offsets[0].offset
        offset.add_(self._mean_error(tensordict))
        for module in self.critic_network.modules():  # what value estimators run: a move of the loss parts the two
            if isinstance(module, ValueOffset):
                module.offset = offset
        return offset.clone()

    @torch.no_grad()
    def _mean_error(self: Any, tensordict: TensorDictBase) -> Tensor:
        """The mean of target - value over the steps that count, a scalar."""
        target = tensordict.get(self.tensor_keys.value_target)
        with self._critic_params():
            value = self.critic_network(tensordict.select(*self.critic_network.in_keys, strict=False))
        error = target - value.get(self.tensor_keys.value)
        return self._reduce_loss(error, tensordict, reduction="mean")

    def _critic_params(self: Any) -> contextlib.AbstractContextManager:
        if not self.functional:
            return contextlib.nullcontext()
        return self.critic_network_params.to_module(self.critic_network, preserve_module_state=False)
