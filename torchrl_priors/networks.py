"""The networks of the MuJoCo experiments: small dense ones, with the initialisation of CleanRL."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import torch
from tensordict import NestedKey
from tensordict.nn import AddStateIndependentNormalScale, TensorDictModule
from torch import Tensor, nn
from torch.distributions import Categorical
from torchrl.modules import MLP, IndependentNormal, ProbabilisticActor, ValueOperator

from torchrl_priors.prior_weight import PriorWeight

__all__ = ["ACTIVATIONS", "GaussianMLP", "make_actor", "make_critic", "make_prior_weight"]

ACTIVATIONS: dict[str, type[nn.Module]] = {
    "elu": nn.ELU,
    "gelu": nn.GELU,
    "relu": nn.ReLU,
    "silu": nn.SiLU,
    "tanh": nn.Tanh,
}
"""The activations by the name that a config or an artefact gives them."""


class GaussianMLP(nn.Module):
    r"""A diagonal Gaussian over actions: its mean a dense network, its standard deviation the same in every state.

    :math:`\mu_\theta(s)` and :math:`\sigma = \exp(\theta_\sigma)`, as in Centa & Preux, "Soft Action Priors: Towards
    Robust Policy Transfer". Its layout follows from the four numbers and names below, which is what an artefact
    (:func:`~torchrl_priors.artifacts.save_prior`) keeps of it beside the parameters.

    The arguments are those of :func:`make_actor`.

    Raises:
        ValueError: a size is not a positive integer, or the activation is unknown.

    Examples:
        >>> import torch
        >>> loc, scale = GaussianMLP(17, 6)(torch.zeros(8, 17))
        >>> loc.shape, scale[0]
        (torch.Size([8, 6]), tensor([1., 1., 1., 1., 1., 1.], grad_fn=<SelectBackward0>))
    """

    def __init__(
        self,
        obs_dim: int,
        act_dim: int,
        hidden: Sequence[int] = (64, 64),
        activation: str = "tanh",
        *,
        device: torch.device | str | None = None,
    ) -> None:
        super().__init__()
        self.obs_dim = obs_dim
        self.act_dim = act_dim
        self.hidden = tuple(hidden)
        self.activation = activation
        self.mean = _mlp(obs_dim, act_dim, self.hidden, activation, device)
        self.scale = AddStateIndependentNormalScale(act_dim, device=device)

    def forward(self, observation: Tensor) -> tuple[Tensor, Tensor]:
        """The mean and the standard deviation ``[*B, act_dim]`` at observations ``[*B, obs_dim]``."""
        return self.scale(self.mean(observation))


def make_actor(
    obs_dim: int,
    act_dim: int,
    hidden: Sequence[int] = (64, 64),
    activation: str = "tanh",
    in_key: NestedKey = "observation_norm",
    *,
    discrete: bool = False,
    generator: torch.Generator | None = None,
    device: torch.device | str | None = None,
) -> ProbabilisticActor:
    """A policy that reads normalised observations: Gaussian, its actions neither squashed nor bounded; or categorical.

    Orthogonal weights of gain √2, and 0.01 in the last layer (CleanRL's ``ppo_continuous_action``); biases and the
    logarithm of the standard deviation start at 0. ``reset_parameters_recursive`` would draw PyTorch's defaults.

    Args:
        obs_dim (int): features of an observation.
        act_dim (int): dimensions of an action, or how many actions there are.
        hidden (sequence of int): cells of each hidden layer. Defaults to ``(64, 64)``.
        activation (str): one of :data:`ACTIVATIONS`. Defaults to ``"tanh"``.
        in_key (NestedKey): observations ``[*B, obs_dim]``. Defaults to ``"observation_norm"``.

    Keyword Args:
        discrete (bool): whether actions are indices. Defaults to ``False``.
        generator (torch.Generator, optional): draws the weights. Defaults to torch's global generator.
        device (torch.device, optional): defaults to torch's.

    Returns:
        ProbabilisticActor: writes ``loc`` and ``scale`` ``[*B, act_dim]``, ``action`` ``[*B, act_dim]`` and
        ``action_log_prob`` ``[*B]``, of an :class:`~torchrl.modules.IndependentNormal`. With ``discrete`` it writes
        ``logits`` ``[*B, act_dim]`` and ``action`` ``[*B]``, of a :class:`~torch.distributions.Categorical`.

    Raises:
        ValueError: as :class:`GaussianMLP`.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> batch = make_actor(17, 6)(TensorDict(observation_norm=torch.randn(8, 17), batch_size=[8]))
        >>> batch["action"].shape, batch["action_log_prob"].shape
        (torch.Size([8, 6]), torch.Size([8]))
    """
    net: Any
    if discrete:
        net = dense = _mlp(obs_dim, act_dim, tuple(hidden), activation, device)
        keys, distribution = ["logits"], Categorical
    else:
        net = GaussianMLP(obs_dim, act_dim, hidden, activation, device=device)
        dense, keys, distribution = net.mean, ["loc", "scale"], IndependentNormal
    _orthogonal(dense, last_gain=0.01, generator=generator)
    module = TensorDictModule(net, in_keys=[in_key], out_keys=keys)
    return ProbabilisticActor(module, in_keys=keys, distribution_class=distribution, return_log_prob=True)


def make_critic(
    obs_dim: int,
    hidden: Sequence[int] = (64, 64),
    activation: str = "tanh",
    in_key: NestedKey = "observation_norm",
    *,
    out_key: NestedKey = "state_value",
    generator: torch.Generator | None = None,
    device: torch.device | str | None = None,
) -> ValueOperator:
    """A state-value critic: orthogonal weights of gain √2, and 1 in the last layer; biases start at 0.

    It writes values ``[*B, 1]`` under ``out_key``. The other arguments and the errors are those of :func:`make_actor`.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> make_critic(17)(TensorDict(observation_norm=torch.randn(8, 17), batch_size=[8]))["state_value"].shape
        torch.Size([8, 1])
    """
    net = _mlp(obs_dim, 1, tuple(hidden), activation, device)
    _orthogonal(net, last_gain=1.0, generator=generator)
    return ValueOperator(net, in_keys=[in_key], out_keys=[out_key])


def make_prior_weight(
    obs_dim: int,
    hidden: Sequence[int] = (64, 64),
    activation: str = "tanh",
    in_key: NestedKey = "observation_norm",
    *,
    init_bias: float = 0.0,
    init_scale: float = 0.01,
    out_key: NestedKey = "prior_weight",
    generator: torch.Generator | None = None,
    device: torch.device | str | None = None,
) -> PriorWeight:
    """The weight of a prior as a network like the critic's, near ``sigmoid(init_bias)`` in every state at first.

    It writes weights ``[*B, 1]`` under ``out_key``. The other arguments and the errors are those of :func:`make_actor`.

    Keyword Args:
        init_bias (float): the bias of the last layer. A negative one starts with less trust. Defaults to 0.
        init_scale (float): multiplies the weights of the last layer. Defaults to 0.01.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> weight = make_prior_weight(17, init_bias=-2.0)
        >>> batch = weight(TensorDict(observation_norm=torch.randn(8, 17), batch_size=[8]))
        >>> bool((batch["prior_weight"] < 0.2).all())
        True
    """
    net = _mlp(obs_dim, 1, tuple(hidden), activation, device)
    _orthogonal(net, last_gain=1.0, generator=generator)
    return PriorWeight(
        net, in_keys=[in_key], out_keys=[out_key], init_scale=init_scale, init_bias=init_bias
    )  # scales the last layer


def _mlp(
    in_features: int, out_features: int, hidden: tuple[int, ...], activation: str, device: torch.device | str | None
) -> MLP:
    sizes = [in_features, *hidden, out_features]
    if any(not isinstance(size, int) or isinstance(size, bool) or size < 1 for size in sizes):
        raise ValueError(f"The layers of a network have positive integer sizes, got {sizes}.")
    if activation not in ACTIVATIONS:
        raise ValueError(f"Unknown activation {activation!r}: choose one of {', '.join(sorted(ACTIVATIONS))}.")
    return MLP(
        in_features=in_features,
        out_features=out_features,
        num_cells=list(hidden),
        activation_class=ACTIVATIONS[activation],
        device=device,
    )


def _orthogonal(net: nn.Module, *, last_gain: float, generator: torch.Generator | None) -> None:
    """Orthogonal weights, of gain √2 before the last layer, and biases of 0."""
    layers = [module for module in net.modules() if isinstance(module, nn.Linear)]
    for layer in layers:
        gain = last_gain if layer is layers[-1] else math.sqrt(2)
        nn.init.orthogonal_(layer.weight, gain, generator=generator)
        nn.init.zeros_(layer.bias)
