"""A plain PyTorch network as a prior."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Literal, get_args

import torch
from tensordict import NestedKey, TensorDictBase
from tensordict.nn import TensorDictModule, TensorDictModuleBase
from torch import Tensor, nn
from torch import distributions as d
from torch.compiler import is_compiling
from torchrl.modules import IndependentNormal

from torchrl_priors.distributions import CATEGORICAL, without_independent
from torchrl_priors.priors.action_prior import ActionPrior, policy_of
from torchrl_priors.priors.spread import as_std

_Output = Literal["logits", "probs", "mean", "mean_std", "distribution"]


class ModulePrior(ActionPrior):
    r"""Any :class:`torch.nn.Module` as a teacher. What it returns is said, not guessed.

    Like any :class:`ActionPrior` it copies the network and freezes it. A TorchScript policy (:func:`torch.jit.load`) is
    such a network too, also after :func:`torch.jit.freeze`.

    Args:
        module (nn.Module): from the entries ``in_keys`` to ``output``. It gets and returns ``[N, ...]``: the batch is
            flattened, so that a network of images or one with ``softmax(dim=1)`` works whatever ``*B`` is.
        output (str): what it returns:

            * ``"logits"``: unnormalised log-probabilities of discrete actions ``[N, A]``;
            * ``"probs"``: their probabilities ``[N, A]``, all above 0 (:class:`AffordancePrior` takes zeros);
            * ``"mean"``: a deterministic action ``[N, A]``, which needs a ``std``;
            * ``"mean_std"``: a pair of mean and standard deviation, each ``[N, A]``;
            * ``"distribution"``: a :class:`torch.distributions.Distribution`, categorical or a (diagonal) Gaussian,
              which needs ``distribution_class`` to say which of the two.

    Keyword Args:
        std (float or Tensor, optional): the spread around a deterministic action, a number or ``[A]``, in the unit of
            the action. Only for ``"mean"``.
        in_keys (sequence of NestedKey, optional): defaults to ``["observation"]``.
        distribution_class (type, optional): what is built from ``logits`` or from ``loc`` and ``scale``. Defaults to
            :class:`~torch.distributions.Categorical` (indices) or :class:`~torchrl.modules.IndependentNormal`; e.g.
            :class:`~torchrl.modules.OneHotCategorical` for one-hot actions, :class:`~torchrl.modules.TanhNormal` for
            squashed ones.
        distribution_kwargs (dict, optional): its further arguments, e.g. ``low`` and ``high``.
        namespace (str or tuple of str): as in :class:`Prior`.

    Raises:
        TypeError: ``module`` is no network; at call, it returns something else than ``output``.
        ValueError: an unknown ``output``; a ``std`` that is missing, not positive, or of no use.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> batch = TensorDict(observation=torch.randn(5, 3), action=torch.zeros(5, 2), batch_size=[5])
        >>> ModulePrior(torch.nn.Linear(3, 2), "mean", std=0.5).log_prob(batch).shape
        torch.Size([5])
        >>> ModulePrior(torch.nn.Linear(3, 4), "logits").get_dist(batch)
        Categorical(logits: torch.Size([5, 4]))
    """

    def __init__(
        self,
        module: nn.Module,
        output: _Output,
        *,
        std: float | Tensor | None = None,
        in_keys: Sequence[NestedKey] | None = None,
        distribution_class: type[d.Distribution] | None = None,
        distribution_kwargs: dict[str, Any] | None = None,
        namespace: NestedKey = "prior",
    ) -> None:
        if isinstance(module, TensorDictModuleBase) or not isinstance(module, nn.Module):
            raise TypeError(
                f"A ModulePrior is made of a torch.nn.Module that reads and gives tensors, got {type(module).__name__}:"
                " a TensorDict policy is an ActionPrior, a function a CallablePrior."
            )
        if output not in get_args(_Output):
            raise ValueError(f"Unknown output {output!r}: expected one of {', '.join(get_args(_Output))}.")
        discrete = output in ("logits", "probs")
        if output == "distribution":
            if distribution_class is None:
                raise ValueError(
                    "output='distribution' needs distribution_class, which says whether it is categorical or Gaussian."
                )
            discrete = issubclass(distribution_class, CATEGORICAL)
        if distribution_class is None:
            distribution_class = d.Categorical if discrete else IndependentNormal
        names = ["logits"] if discrete else ["loc", "scale"]
        keys = ["observation"] if in_keys is None else list(in_keys)
        network = _Flat(_Params(module, output, std, discrete), in_keys=keys, out_keys=names)
        super().__init__(
            policy_of(network, names=names, distribution_class=distribution_class, **(distribution_kwargs or {})),
            namespace=namespace,
        )
        self.output = output


class _Flat(TensorDictModule):
    """Gives a network ``[N, ...]``, which is what it was written for, whatever the batch is."""

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        if tensordict.ndim == 1:
            return super().forward(tensordict)
        flat = super().forward(tensordict.select(*self.in_keys).reshape(tensordict.batch_size.numel()))
        for key in self.out_keys:
            tensordict.set(key, flat.get(key).reshape(*tensordict.batch_size, *flat.get(key).shape[1:]))
        return tensordict


class _Params(nn.Module):
    """The parameters of the distribution from what a network returns."""

    std: Tensor | None

    def __init__(self, module: nn.Module, output: str, std: float | Tensor | None, discrete: bool) -> None:
        super().__init__()
        if (std is None) == (output == "mean"):
            raise ValueError(
                "A deterministic teacher needs a spread: pass std, in the unit of the action."
                if std is None
                else f"std is the spread of a deterministic teacher, output='mean', and of no use for {output!r}."
            )
        self.network = module
        self.output = output
        self.discrete = discrete
        self.register_buffer("std", None if std is None else as_std(std))

    def forward(self, *inputs: Tensor) -> Tensor | tuple[Tensor, Tensor]:
        value = self.network(*inputs)
        if self.output == "distribution":
            return self._of_distribution(value)
        if self.output == "mean_std":
            if not (isinstance(value, (tuple, list)) and len(value) == 2):
                raise TypeError(f"A teacher with output='mean_std' must return a pair, got {type(value).__name__}.")
            return value[0], value[1]
        if not isinstance(value, Tensor):
            raise TypeError(f"A teacher with output={self.output!r} must return a tensor, got {type(value).__name__}.")
        if self.output == "probs":
            if not is_compiling() and not torch.allclose(value.sum(-1), torch.ones_like(value[..., 0]), atol=1e-3):
                raise ValueError(
                    "The teacher's probs are probabilities that sum to 1: are they logits (output='logits')?"
                )
            return value.log()
        if self.output == "mean":
            assert self.std is not None
            if self.std.ndim and self.std.shape != value.shape[-1:]:
                shapes = f"{tuple(value.shape[1:])} and {tuple(self.std.shape)}"
                raise ValueError(f"std must be a number or one per dimension of the action, got {shapes}.")
            return value, self.std.to(value.dtype).expand_as(value)
        return value

    def _of_distribution(self, dist: Any) -> Tensor | tuple[Tensor, Tensor]:
        base = without_independent(dist)
        if self.discrete and isinstance(base, CATEGORICAL):
            return base.logits
        if not self.discrete and isinstance(base, d.Normal):
            return base.loc, base.scale
        raise TypeError(
            f"The teacher was expected to return a {'categorical' if self.discrete else 'diagonal Gaussian'}"
            f" distribution, got {type(dist).__name__}."
        )
