"""The layers of a policy of Stable-Baselines3, from its weights."""

from __future__ import annotations

from typing import Literal

import torch
from torch import Tensor, nn

from torchrl_priors.artifacts.errors import ArtifactError, differing, short
from torchrl_priors.artifacts.network import check_values
from torchrl_priors.artifacts.sb3_files import Checkpoint, Statistics
from torchrl_priors.priors.layers import (
    ClipToBox,
    GaussianHead,
    NatureCNN,
    ScaleToBox,
    StateIndependentStd,
    TeacherInput,
)

Family = Literal["on_policy", "squashed", "deterministic", "values"]


def find_family(checkpoint: Checkpoint) -> Family:
    """PPO, A2C and TRPO; SAC and TQC; TD3 and DDPG; or DQN and QR-DQN: by the names of the weights."""
    names = checkpoint.weights
    if any(name.startswith(("q_net.", "quantile_net.")) for name in names):
        return "values"
    if any(name in names for name in ("actor.log_std", "actor.log_std.weight")):
        return "squashed"
    return "deterministic" if any(name.startswith("actor.") for name in names) else "on_policy"


def build_layers(
    checkpoint: Checkpoint,
    statistics: Statistics | None,
    activation: type[nn.Module],
    *,
    deterministic: bool,
    clip_mean: bool,
) -> nn.Sequential:
    """From raw observations to logits, action values, a mean, or a mean and a standard deviation.

    With ``deterministic`` continuous actions are in the unit of the environment; ``clip_mean`` is for an on-policy one.
    """
    family, parts = find_family(checkpoint), _Parts(checkpoint.weights)
    if family == "values":
        layers = _value_layers(parts, checkpoint, statistics, activation)
    elif family == "on_policy":
        layers = _on_policy_layers(
            parts, checkpoint, statistics, activation, deterministic=deterministic, clip_mean=clip_mean
        )
    else:
        layers = _first_layers(parts, checkpoint, statistics, "actor.")
        if family == "squashed":
            layers += _squashed_layers(parts, checkpoint, activation, deterministic=deterministic)
        else:
            layers += parts.mlp("actor.mu.", activation)[:-1]
        if deterministic:
            layers += _to_bounds(checkpoint)
    parts.check_all_taken()
    network = nn.Sequential(*layers)
    _check_sizes(network, checkpoint)
    check_values(network)
    return network


def action_bounds(checkpoint: Checkpoint) -> tuple[Tensor, Tensor]:
    """The bounds of the actions, which a squashed policy needs."""
    space = checkpoint.action_space
    low, high = (torch.as_tensor(bound).float() for bound in (space.low, space.high))
    if not (low.isfinite().all() and high.isfinite().all() and (low < high).all()):
        raise ArtifactError(f"its actions must have finite bounds, got {low.tolist()} and {high.tolist()}")
    return low, high


def _to_bounds(checkpoint: Checkpoint) -> list[nn.Module]:
    """From a mean before squashing to an action in the environment's unit."""
    return [nn.Tanh(), ScaleToBox(*action_bounds(checkpoint))]


def _first_layers(parts: _Parts, checkpoint: Checkpoint, statistics: Statistics | None, prefix: str) -> list[nn.Module]:
    """From raw observations to features."""
    space = checkpoint.observation_space
    own = f"{prefix}pi_features_extractor."  # of a policy that does not share it with the critic
    if any(name.startswith(own) for name in parts.left):
        parts.drop("features_extractor.")
    else:
        own = f"{prefix}features_extractor."
    cnn = any(name.startswith(own) for name in parts.left)
    first = TeacherInput(
        space.shape,
        statistics=None if statistics is None else (statistics.mean, statistics.var),
        pixels=space.is_image and checkpoint.options.get("normalize_images", True) is not False,
        flatten=not cnn,
        **({} if statistics is None else {"eps": statistics.epsilon, "clip": statistics.clip}),
    )
    return [first, parts.nature_cnn(own, space.shape)] if cnn else [first]


def _on_policy_layers(
    parts: _Parts,
    checkpoint: Checkpoint,
    statistics: Statistics | None,
    activation: type[nn.Module],
    *,
    deterministic: bool,
    clip_mean: bool,
) -> list[nn.Module]:
    """To logits, or to a mean, and a standard deviation unless ``deterministic``."""
    layers = _first_layers(parts, checkpoint, statistics, "")
    layers += parts.mlp("mlp_extractor.shared_net.", activation) + parts.mlp("mlp_extractor.policy_net.", activation)
    layers.append(parts.linear("action_net."))
    space = checkpoint.action_space
    if space.kind == "Discrete":
        return layers
    log_std = parts.take("log_std")
    parts.drop("sde_features_extractor.")  # of the noise of state-dependent exploration
    if checkpoint.use_sde and checkpoint.options.get("squash_output"):
        layers += _to_bounds(checkpoint)
    elif clip_mean:
        layers.append(ClipToBox(*(torch.as_tensor(bound).float() for bound in (space.low, space.high))))
    return layers if deterministic else [*layers, StateIndependentStd(log_std)]


def _squashed_layers(
    parts: _Parts, checkpoint: Checkpoint, activation: type[nn.Module], *, deterministic: bool
) -> list[nn.Module]:
    """From features to a mean before squashing, and a standard deviation unless ``deterministic``."""
    layers = parts.mlp("actor.latent_pi.", activation)
    if checkpoint.use_sde:
        parts.take("actor.log_std")
        parts.drop("actor.sde_features_extractor.")
        bound = checkpoint.options.get("clip_mean", 2.0)
        if type(bound) not in (int, float) or not abs(bound) < float("inf"):
            raise ArtifactError(f"its clip_mean must be a number, got {short(bound)}")
        mean = parts.linear("actor.mu.0." if bound > 0 else "actor.mu.")
        limit = torch.full(mean.bias.shape, float(bound))
        return [*layers, mean, ClipToBox(-limit, limit)] if bound > 0 else [*layers, mean]
    mean, log_std = parts.linear("actor.mu."), parts.linear("actor.log_std.")
    if mean.weight.shape != log_std.weight.shape:
        raise ArtifactError("its mean and its standard deviation are of different sizes")
    if deterministic:
        return [*layers, mean]
    with torch.device("meta"):
        head = GaussianHead(mean.in_features, mean.out_features)
    head.mean, head.log_std = mean, log_std
    return [*layers, head]


def _value_layers(
    parts: _Parts, checkpoint: Checkpoint, statistics: Statistics | None, activation: type[nn.Module]
) -> list[nn.Module]:
    """To action values, the mean of the quantiles if there are any."""
    name = "q_net." if any(name.startswith("q_net.") for name in parts.left) else "quantile_net."
    layers = _first_layers(parts, checkpoint, statistics, name)
    layers += parts.mlp(2 * name, activation)[:-1]
    last, number = layers[-1], checkpoint.action_space.n
    if name == "quantile_net." and isinstance(last, nn.Linear) and last.out_features % number == 0:
        # quantiles of all actions, one after the other: the mean of linear functions is one
        last.weight = nn.Parameter(last.weight.detach().unflatten(0, (-1, number)).mean(0))
        last.bias = nn.Parameter(last.bias.detach().unflatten(0, (-1, number)).mean(0))
        last.out_features = number
    return layers


def _check_sizes(network: nn.Sequential, checkpoint: Checkpoint) -> None:
    """Runs the network once, so that layers that do not fit are found here."""
    actions = checkpoint.action_space
    size = actions.n if actions.kind == "Discrete" else actions.shape[0]
    try:
        with torch.no_grad():
            out = network(torch.zeros(1, *checkpoint.observation_space.shape))
    except (RuntimeError, ValueError) as error:
        raise ArtifactError(f"its layers do not fit its observations and each other: {error}") from None
    for value in out if isinstance(out, tuple) else (out,):
        if value.shape != (1, size):
            raise ArtifactError(f"its policy is over {tuple(value.shape[1:])} actions, and its action space has {size}")


class _Parts:
    """The tensors of a policy, taken one layer after the other."""

    ignored = ("value_net.", "mlp_extractor.value_net.", "vf_features_extractor.", "critic.", "critic_target.")
    targets = ("actor_target.", "q_net_target.", "quantile_net_target.")

    def __init__(self, weights: dict[str, Tensor]) -> None:
        self.left = dict(weights)
        for prefix in (*self.ignored, *self.targets):
            self.drop(prefix)

    def drop(self, prefix: str) -> None:
        self.left = {name: value for name, value in self.left.items() if not name.startswith(prefix)}

    def take(self, name: str) -> Tensor:
        if name not in self.left:
            raise ArtifactError(f"its policy lacks {name}")
        value = self.left.pop(name)
        if value.dtype is not torch.float32 or not value.isfinite().all():
            raise ArtifactError(f"{name} must be finite and float32")
        return value

    def linear(self, prefix: str) -> nn.Linear:
        weight, bias = self.take(f"{prefix}weight"), self.take(f"{prefix}bias")
        if weight.ndim != 2 or bias.shape != weight.shape[:1]:
            raise ArtifactError(f"{prefix}weight and bias are no linear layer: {weight.shape}, {bias.shape}")
        layer = nn.Linear(weight.shape[1], weight.shape[0], device="meta")
        layer.load_state_dict({"weight": weight, "bias": bias}, assign=True)
        return layer

    def mlp(self, prefix: str, activation: type[nn.Module]) -> list[nn.Module]:
        """Linear layers under even numbers, an activation after each."""
        found = {name.removeprefix(prefix).partition(".")[0] for name in self.left if name.startswith(prefix)}
        if found != {str(2 * number) for number in range(len(found))}:
            raise ArtifactError(f"{prefix}* are layers {', '.join(sorted(found))}: not a plain stack of linear ones")
        return [
            layer for number in range(len(found)) for layer in (self.linear(f"{prefix}{2 * number}."), activation())
        ]

    def nature_cnn(self, prefix: str, shape: tuple[int, ...]) -> NatureCNN:
        mine = {name: self.take(name) for name in list(self.left) if name.startswith(prefix)}
        tensors = {name.removeprefix(prefix): value for name, value in mine.items()}
        bias = tensors.get("linear.0.bias")
        try:
            with torch.device("meta"):
                net = NatureCNN(shape, 512 if bias is None else len(bias))
            net.load_state_dict(tensors, assign=True)
        except (RuntimeError, TypeError, ValueError) as error:
            raise ArtifactError(f"its features extractor is no NatureCNN: {error}") from None
        return net

    def check_all_taken(self) -> None:
        if self.left:
            raise ArtifactError(f"its policy has parts that are not known: {differing(self.left)}")
