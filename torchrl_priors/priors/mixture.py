"""Several priors as one."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from copy import deepcopy
from typing import Any

import torch
from tensordict import NestedKey, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor, nn
from torch import distributions as d
from torchrl.modules import IndependentNormal, OneHotCategorical

from torchrl_priors.distributions import CATEGORICAL, TORCHRL_ONE_HOT, action_shape, without_independent
from torchrl_priors.priors.prior import Prior
from torchrl_priors.state_table import Constant, by_state


class MixturePrior(Prior):
    r"""A mixture of priors, :math:`\pi_0(a|s) = \sum_k w_k(s)\,\pi_k(a|s)`.

    All are over the same actions. Categorical priors mix to a categorical one, with ``logits``: the cross-entropy stays
    in closed form. Gaussian ones mix to a :class:`~torch.distributions.MixtureSameFamily`, with ``mixture_logits``
    ``[*B, K]``, ``loc`` and ``scale`` ``[*B, K, A]``: the cross-entropy is estimated from samples of the student.

    The weights never learn, as nothing of a prior does. To *learn* how far to trust each of several teachers in each
    state, see :class:`~torchrl_priors.MultiTeacherLoss`.

    Args:
        priors (sequence of Prior): two or more. They are shared.
        weights: of the priors, not negative; they are normalised to sum to 1. Defaults to ``None``: equal.

            * K numbers: the same in every state;
            * a tensor ``[S, K]`` or ``[*W, S, K]``: a table over the integer states under ``in_keys``;
            * a network or function of tensors, from the entries ``in_keys`` to ``[*B, K]``;
            * a TensorDict module that writes ``[*B, K]`` as its first key.

    Keyword Args:
        in_keys (sequence of NestedKey, optional): of ``weights``. Defaults to ``["state"]`` for a table, else to
            ``["observation"]``.
        namespace (str or tuple of str): as in :class:`Prior`.

    Raises:
        TypeError: one is no :class:`Prior`.
        ValueError: fewer than two; weights that are negative, all 0, or not one for each; two that keep a random draw
            under one key; at call, priors over different actions.
        NotImplementedError: they are neither all categorical nor all Gaussian.

    Examples:
        >>> from tensordict import TensorDict
        >>> from torchrl_priors.priors import BoltzmannPrior, UniformPrior
        >>> left = BoltzmannPrior(torch.tensor([[100.0, 0.0]]))
        >>> prior = MixturePrior([left, UniformPrior(2)], weights=[0.5, 0.5])
        >>> prior.get_dist(TensorDict(state=torch.tensor([0]), batch_size=[1])).probs
        tensor([[0.7500, 0.2500]])
    """

    priors: Any
    """Those that are mixed, a :class:`~torch.nn.ModuleList`."""

    def __init__(
        self,
        priors: Sequence[Prior],
        weights: Sequence[float] | Tensor | nn.Module | TensorDictModuleBase | Callable[..., Tensor] | None = None,
        *,
        in_keys: Sequence[NestedKey] | None = None,
        namespace: NestedKey = "prior",
    ) -> None:
        priors = list(priors)
        if wrong := [type(prior).__name__ for prior in priors if not isinstance(prior, Prior)]:
            raise TypeError(f"A mixture is one of priors, got {', '.join(wrong)}.")
        if len(priors) < 2:
            raise ValueError(f"A mixture has at least two priors, got {len(priors)}.")
        weights = [1.0] * len(priors) if weights is None else weights
        of_state = _weights_module(weights, in_keys, len(priors)).requires_grad_(False).eval()
        keys = dict.fromkeys(key for part in (*priors, of_state) for key in part.in_keys)
        distribution_class, names = _family(priors)
        super().__init__(list(keys), names, distribution_class, namespace=namespace)
        self.action_key = priors[0].action_key
        self.priors = nn.ModuleList(priors).eval()
        self.weights = of_state
        if len(self.draw_keys) < sum(len(prior.draw_keys) for prior in priors):
            raise ValueError("Two priors of the mixture keep their random draws under one key: pass draw_key to one.")

    @property
    def draw_keys(self) -> list[NestedKey]:
        """What the priors draw at random and leave in the batch."""
        return list(dict.fromkeys(key for prior in self.priors for key in prior.draw_keys))

    def draw(self, tensordict: TensorDictBase) -> None:
        """Draws what the priors draw at random, unless it is there already."""
        for prior in self.priors:
            prior.draw(tensordict)

    @torch.no_grad()
    def get_weights(self, tensordict: TensorDictBase) -> Tensor:
        """The weights of the priors, ``[*B, K]``, which sum to 1."""
        out = self.weights(tensordict.select(*self.weights.in_keys)).get(self.weights.out_keys[0])
        expected = (*tensordict.batch_size, len(self.priors))
        if tuple(out.shape) != expected:
            raise ValueError(f"The weights of a mixture must be of shape {expected}, got {tuple(out.shape)}.")
        if not torch.compiler.is_compiling():
            _check_weights(out)
        return out / out.sum(-1, keepdim=True)

    @torch.no_grad()
    def get_params(self, tensordict: TensorDictBase) -> dict[str, Tensor]:
        """The parameters of the mixture by name."""
        dists: list[Any] = [prior.get_dist(tensordict) for prior in self.priors]
        discrete = self.param_names == ["logits"]
        sizes = [dist.logits.shape[-1] if discrete else action_shape(dist)[-1] for dist in dists]
        if len(set(sizes)) > 1:
            raise ValueError(f"The priors of a mixture must be over the same actions, got some over {sizes}.")
        log_weights = self.get_weights(tensordict).log()
        if discrete:
            log_probs = torch.stack([dist.logits for dist in dists], dim=-1)
            return {"logits": torch.logsumexp(log_probs + log_weights.unsqueeze(-2), dim=-1)}
        normals: list[Any] = [without_independent(dist) for dist in dists]
        return {
            "mixture_logits": log_weights,
            "loc": torch.stack([normal.loc for normal in normals], dim=-2),
            "scale": torch.stack([normal.scale for normal in normals], dim=-2),
        }

    def build_dist(self, params: dict[str, Tensor]) -> d.Distribution:
        """The mixture with the parameters of :meth:`get_params`."""
        if self.param_names == ["logits"]:
            return self.distribution_class(logits=params["logits"])
        return GaussianMixture(
            d.Categorical(logits=params["mixture_logits"]), d.Independent(d.Normal(params["loc"], params["scale"]), 1)
        )


class GaussianMixture(d.MixtureSameFamily):
    """A mixture of Gaussians; a policy that does not sample takes the mean of its heaviest one."""

    @property
    def deterministic_sample(self) -> Tensor:
        """The action of one of the teachers, ``[*B, A]``: the mean of all may be what none of them would do."""
        heaviest = self.mixture_distribution.logits.argmax(-1)[..., None, None]
        gaussians: Any = self.component_distribution
        return gaussians.base_dist.loc.take_along_dim(heaviest, -2).squeeze(-2)


def _family(priors: list[Prior]) -> tuple[Any, list[str]]:
    """The class of the mixture, and the names of its parameters."""
    kinds = [prior.distribution_class for prior in priors]
    names = [kind.__name__ if isinstance(kind, type) else repr(kind) for kind in kinds]
    if all(isinstance(kind, type) and issubclass(kind, CATEGORICAL) for kind in kinds):
        one_hot = {issubclass(kind, (*TORCHRL_ONE_HOT, d.OneHotCategorical)) for kind in kinds}
        if len(one_hot) > 1:
            raise ValueError(f"Actions of these priors are indices for some, one-hot for others: {', '.join(names)}.")
        return OneHotCategorical if one_hot.pop() else d.Categorical, ["logits"]
    if all(kind in (IndependentNormal, d.Normal) for kind in kinds):
        return d.MixtureSameFamily, ["mixture_logits", "loc", "scale"]
    raise NotImplementedError(
        f"A mixture is one of categorical or of Gaussian priors, got {', '.join(names)}. A squashed"
        " Gaussian can be a Gaussian around its action instead, e.g. load_sb3_prior(..., std=0.1)."
    )


def _weights_module(
    weights: Sequence[float] | Tensor | nn.Module | TensorDictModuleBase | Callable[..., Tensor],
    in_keys: Sequence[NestedKey] | None,
    number: int,
) -> TensorDictModuleBase:
    if isinstance(weights, nn.Module) or (callable(weights) and not isinstance(weights, Tensor)):
        return by_state(deepcopy(weights), in_keys, "weights")
    table = torch.as_tensor(weights, dtype=torch.get_default_dtype())
    if not table.ndim or table.shape[-1] != number:
        raise ValueError(f"A mixture of {number} priors has a weight for each, got shape {tuple(table.shape)}.")
    _check_weights(table)
    return Constant({"weights": table}) if table.ndim == 1 else by_state(table, in_keys, "weights")


def _check_weights(weights: Tensor) -> None:
    if not (weights.isfinite() & (weights >= 0)).all() or (weights.sum(-1) == 0).any():
        raise ValueError("The weights of a mixture must be finite, not negative, and not all 0 in a state.")
