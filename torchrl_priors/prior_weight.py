"""The weight of a prior, state by state: how much its advice counts."""

from __future__ import annotations

import torch
from tensordict import NestedKey, TensorDictBase
from tensordict.nn import TensorDictModule, TensorDictModuleBase, dispatch
from torch import Tensor, nn

from torchrl_priors.state_table import StateTable

__all__ = ["PriorWeight"]


class PriorWeight(TensorDictModuleBase):
    r"""A learned weight of the prior's advice, :math:`\omega_\psi(s) = \mathrm{sigmoid}(f_\psi(s)) \in [0, 1]`.

    Of AER and AE2R in Centa & Preux, "Soft Action Priors: Towards Robust Policy Transfer". It multiplies the reward
    bonus and the auxiliary loss, so that bad advice is switched off where it is bad. With the last layer scaled down,
    it starts near ``sigmoid(init_bias)`` in every state: one half by default.

    Args:
        net (nn.Module or TensorDictModule): :math:`f_\psi`, from the entries ``in_keys`` to a logit ``[*B, 1]``,
            without a sigmoid. It is not copied.
        in_keys (sequence of NestedKey, optional): defaults to ``["observation"]``, or to those of a TensorDict module.
        out_keys (sequence of NestedKey): where to write the weight ``[*B, 1]``. Defaults to ``["prior_weight"]``.

    Keyword Args:
        init_scale (float, optional): multiplies the weight of the last linear layer, now and at each
            ``reset_parameters_recursive``. Defaults to 0.01; ``None`` leaves ``net`` as it is, ``init_bias`` too.
        init_bias (float): the bias of that layer. A negative one starts with less trust. Defaults to 0.

    Raises:
        ValueError: ``net`` has no linear layer to scale, or it is not initialised yet, or a value is out of range.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> weight = PriorWeight(torch.nn.Linear(3, 1))
        >>> batch = weight(TensorDict(observation=torch.randn(5, 3), batch_size=[5]))
        >>> batch["prior_weight"].shape, bool((batch["prior_weight"] - 0.5).abs().max() < 0.05)
        (torch.Size([5, 1]), True)
        >>> PriorWeight.table(10)(TensorDict(state=torch.tensor([3, 7]), batch_size=[2]))["prior_weight"].squeeze(-1)
        tensor([0.5000, 0.5000], grad_fn=<SqueezeBackward1>)
        >>> PriorWeight.constant(0.25)(batch)["prior_weight"][0]
        tensor([0.2500])
    """

    def __init__(
        self,
        net: nn.Module | TensorDictModuleBase,
        in_keys: list[NestedKey] | None = None,
        out_keys: list[NestedKey] | None = None,
        *,
        init_scale: float | None = 0.01,
        init_bias: float = 0.0,
    ) -> None:
        super().__init__()
        self.out_keys = ["prior_weight"] if out_keys is None else list(out_keys)
        if len(self.out_keys) != 1:
            raise ValueError(f"A prior weight is one entry, got out_keys={self.out_keys}.")
        if not isinstance(net, TensorDictModuleBase):
            net = TensorDictModule(net, in_keys=["observation"] if in_keys is None else in_keys, out_keys=self.out_keys)
        elif in_keys is not None:
            raise ValueError(f"A TensorDict module has its own in_keys, {net.in_keys}.")
        self.logit = net
        self.in_keys = list(net.in_keys)
        self.init_scale = init_scale
        self.init_bias = init_bias
        self._scale_last_layer()

    @classmethod
    def table(
        cls,
        num_states: int,
        key: NestedKey = "state",
        batch: tuple[int, ...] = (),
        *,
        out_keys: list[NestedKey] | None = None,
    ) -> PriorWeight:
        """One weight per state, of logits that start at 0.

        Args:
            num_states (int): the number of states.
            key (NestedKey): integer states ``[*batch, ...]``. Defaults to ``"state"``.
            batch (tuple of int): a table for each, e.g. for each world of a batch. Defaults to ``()``.

        Keyword Args:
            out_keys (list of NestedKey, optional): defaults to ``["prior_weight"]``.
        """
        if num_states < 1:
            raise ValueError(f"A table needs at least one state, got num_states={num_states}.")
        logits = nn.Parameter(torch.zeros(*batch, num_states, 1))
        table = StateTable(
            logits, in_key=key, out_key="prior_weight" if out_keys is None else out_keys[0], feature_dims=1
        )
        return cls(table, out_keys=out_keys, init_scale=None)

    @classmethod
    def constant(cls, value: float, *, out_keys: list[NestedKey] | None = None) -> PriorWeight:
        """The same weight in every state, exactly ``value`` in [0, 1], which is not learned.

        Args:
            value (float): 0 switches the prior off, 1 is ER or E2R.

        Keyword Args:
            out_keys (list of NestedKey, optional): defaults to ``["prior_weight"]``.
        """
        return _ConstantPriorWeight(value, out_keys=out_keys)

    def _scale_last_layer(self) -> None:
        if self.init_scale is None:
            return
        layers = [module for module in self.logit.modules() if isinstance(module, nn.Linear)]
        if not layers:
            raise ValueError("The network of a prior weight has no linear layer to scale: pass init_scale=None.")
        last = layers[-1]
        if nn.parameter.is_lazy(last.weight):
            raise ValueError("The last layer of a prior weight is lazy: run the network once, or pass init_scale=None.")
        if last.out_features != 1:
            raise ValueError(f"The last layer of a prior weight must have one output, got {last.out_features}.")
        with torch.no_grad():
            last.weight.mul_(self.init_scale)
            if last.bias is not None:
                last.bias.fill_(self.init_bias)
            elif self.init_bias:
                raise ValueError("The last layer of the prior weight has no bias to set to init_bias.")

    def _reset_parameters(self, module: nn.Module) -> bool:
        """Resets, then scales the last layer; what ``reset_parameters_recursive`` calls, also with other parameters."""
        any_reset = super()._reset_parameters(module)
        if module is self:
            self._scale_last_layer()
        return any_reset

    def reset_parameters(self) -> None:
        """Draws the parameters anew, with the last layer scaled as at first."""
        self._reset_parameters(self)

    @dispatch(auto_batch_size=False)
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Writes the weight ``[*B, 1]``."""
        logit = self.logit(tensordict.select(*self.in_keys)).get(self.logit.out_keys[0])
        if logit.shape[-1:] != (1,):
            raise ValueError(f"The network of a prior weight must give [*B, 1], got {tuple(logit.shape)}.")
        return tensordict.set(self.out_keys[0], logit.sigmoid())


class _ConstantPriorWeight(PriorWeight):
    """See :meth:`PriorWeight.constant`."""

    value: Tensor

    def __init__(self, value: float, *, out_keys: list[NestedKey] | None = None) -> None:
        TensorDictModuleBase.__init__(self)
        if not 0 <= value <= 1:
            raise ValueError(f"A prior weight is in [0, 1], got {value}.")
        self.in_keys: list[NestedKey] = []
        self.out_keys = ["prior_weight"] if out_keys is None else list(out_keys)
        self.register_buffer("value", torch.tensor(float(value)))

    def _reset_parameters(self, module: nn.Module) -> bool:
        return True

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Writes the value at every step."""
        value = self.value.to(tensordict.device) if tensordict.device is not None else self.value
        return tensordict.set(self.out_keys[0], value.expand(*tensordict.batch_size, 1))
