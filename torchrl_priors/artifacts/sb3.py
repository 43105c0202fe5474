"""Teachers that Stable-Baselines3 trained."""

from __future__ import annotations

import os
import re
from pathlib import Path
from typing import Any

import torch
from tensordict import NestedKey
from torch import Tensor, nn
from torchrl.modules import OneHotCategorical, TanhNormal

from torchrl_priors.artifacts.errors import ArtifactError, differing
from torchrl_priors.artifacts.network import check_values
from torchrl_priors.artifacts.sb3_files import Checkpoint, Statistics, read_checkpoint, read_vecnormalize
from torchrl_priors.networks import ACTIVATIONS
from torchrl_priors.priors import ModulePrior
from torchrl_priors.priors.layers import (
    ClipToBox,
    GaussianHead,
    NatureCNN,
    ScaleToBox,
    StateIndependentStd,
    TeacherInput,
)

__all__ = ["load_sb3_prior"]


def load_sb3_prior(
    path: str | os.PathLike[str],
    *,
    vecnormalize: str | os.PathLike[str] | None = None,
    std: float | Tensor | None = None,
    clip_mean: bool = True,
    activation: str | None = None,
    one_hot: bool = False,
    in_key: NestedKey = "observation",
    namespace: NestedKey = "prior",
    device: torch.device | str | None = None,
) -> ModulePrior:
    r"""A policy of Stable-Baselines3 as a teacher: PPO, A2C, SAC or TD3, from the file that ``model.save`` wrote.

    Stable-Baselines3 need not be installed, and no code of the files runs: weights are loaded by
    ``torch.load(weights_only=True)``, and of what is pickled only numbers, arrays and names are read.

    What the teacher's distribution is, in the unit of the environment's actions:

    * PPO, A2C, discrete actions: a :class:`~torch.distributions.Categorical` over indices, or, with ``one_hot``, a
      :class:`~torchrl.modules.OneHotCategorical`, as the students of a :func:`~torchrl.envs.GymEnv` are by default;
    * PPO, A2C, continuous: a Gaussian whose mean is clipped to the bounds of the actions, as Stable-Baselines3 clips
      what it sends. With ``clip_mean=False`` it is the policy's own, and so are its log-probabilities;
    * SAC: a :class:`~torchrl.modules.TanhNormal` within the bounds. Stable-Baselines3's own ``log_prob`` is that of
      actions scaled to [-1, 1], and adds 1e-6 to :math:`1-\tanh^2`; this one is exact;
    * TD3, and any other continuous one with ``std``: a Gaussian around the deterministic action. A Gaussian student of
      a SAC teacher needs it: its actions can leave the bounds, where a squashed teacher has no finite opinion.

    It can be written to a file of this library by :func:`save_prior`. ``python -m recipes.export_sb3`` does both.

    Args:
        path (str or path): the ``.zip``.

    Keyword Args:
        vecnormalize (str or path, optional): the file of ``VecNormalize.save``, whose statistics the policy was trained
            with. Defaults to ``None``: it reads raw observations.
        std (float or Tensor, optional): standard deviation of a Gaussian around the deterministic action, in the unit
            of the action, a number or one per dimension; required for TD3. Defaults to ``None``: the policy's own
            distribution.
        clip_mean (bool): whether the mean of a policy of PPO or A2C is clipped to the bounds of the actions, where they
            are finite. Defaults to ``True``: a mean far beyond would draw a student there, where nothing changes.
        activation (str, optional): what the policy must have, one of :data:`~torchrl_priors.networks.ACTIVATIONS`: only
            a check, for what the file says counts, and if it says nothing Stable-Baselines3's default (tanh for PPO and
            A2C, ReLU for SAC and TD3). Defaults to ``None``: not checked.
        one_hot (bool): whether discrete actions are one-hot ``[*B, A]``, not indices ``[*B]``. Defaults to ``False``.
        in_key (NestedKey): raw observations ``[*B, *obs]``, images with channels first. Defaults to ``"observation"``.
        namespace (NestedKey): as in :class:`~torchrl_priors.ActionPrior`.
        device (torch.device, optional): defaults to the CPU.

    Raises:
        FileNotFoundError: there is no such file.
        ArtifactError: a file is damaged or none of Stable-Baselines3; or the policy is of a kind that can't be read:
            observations of several entries or discrete ones, actions that are neither ``Discrete`` nor a ``Box`` of one
            dimension, state-dependent exploration, recurrent or custom networks.
        ValueError: TD3 without ``std``, ``std`` with discrete actions or of another size than the actions, ``one_hot``
            with continuous ones, or an activation that the policy does not have.
    """
    try:
        checkpoint = read_checkpoint(Path(path))
        _check(checkpoint)
    except ArtifactError as error:
        raise ArtifactError(f"{path} can't be used as a Stable-Baselines3 policy: {error}.") from error
    statistics = None if vecnormalize is None else read_vecnormalize(Path(vecnormalize))
    space = checkpoint.observation_space
    if statistics is not None and tuple(statistics.mean.shape) != space.shape:
        raise ArtifactError(
            f"{vecnormalize} has statistics of observations {tuple(statistics.mean.shape)}, and the policy of {path}"
            f" reads {space.shape}."
        )
    discrete = checkpoint.action_space.kind == "Discrete"
    off_policy = any(name.startswith("actor.") for name in checkpoint.weights)
    squashed = "actor.log_std.weight" in checkpoint.weights
    if off_policy and not squashed and std is None:
        raise ValueError(f"{path} is a deterministic policy (TD3): pass std, its spread in the unit of the action.")
    if discrete and std is not None:
        raise ValueError(f"{path} is a policy over discrete actions: std={std} is of no use.")
    if one_hot and not discrete:
        raise ValueError(f"{path} is a policy over continuous actions: one_hot=True is of no use.")
    if std is not None and torch.as_tensor(std).shape not in ((), checkpoint.action_space.shape):
        raise ValueError(
            f"std must be a number or have one for each of {checkpoint.action_space.shape[0]} dimensions of the actions"
            f" of {path}, got shape {tuple(torch.as_tensor(std).shape)}."
        )
    try:
        kind = _activation(checkpoint, "relu" if off_policy else "tanh", activation)
        parts = _Parts(checkpoint.weights)
        layers = [*_first_layers(parts, checkpoint, statistics, "actor." if off_policy else "")]
        kwargs: dict[str, Any] = {"in_keys": [in_key], "namespace": namespace}
        if off_policy:
            layers += _off_policy_layers(parts, checkpoint, kind, squashed, deterministic=std is not None)
        else:
            layers += parts.mlp("mlp_extractor.shared_net.", kind) + parts.mlp("mlp_extractor.policy_net.", kind)
            layers.append(parts.linear("action_net."))
            if not discrete:
                log_std = parts.take("log_std")
                layers += [_clip(checkpoint)] if clip_mean else []
                layers += [StateIndependentStd(log_std)] if std is None else []
        parts.check_all_taken()
        _check_sizes(layers, checkpoint)
        check_values(nn.Sequential(*layers))
        if squashed and std is None:
            low, high = _bounds(checkpoint)
            kwargs |= {"distribution_class": TanhNormal, "distribution_kwargs": {"low": low, "high": high}}
    except ArtifactError as error:
        raise ArtifactError(f"{path} can't be used as a Stable-Baselines3 policy: {error}.") from error
    if one_hot:
        kwargs["distribution_class"] = OneHotCategorical
    output = "logits" if discrete else "mean_std" if std is None else "mean"
    return ModulePrior(nn.Sequential(*layers), output, std=std, **kwargs).to(device)  # type: ignore[arg-type]


def _check(checkpoint: Checkpoint) -> None:
    """Refuses what can't be converted."""
    if checkpoint.use_sde or checkpoint.options.get("use_sde"):
        raise ArtifactError("it explores by state-dependent noise (use_sde=True), which is not supported")
    if not re.fullmatch(r"stable_baselines3\.(common|ppo|a2c|sac|td3)\.policies", checkpoint.policy_module):
        raise ArtifactError(
            f"its policy class is one of {checkpoint.policy_module or 'an unknown module'}, and only those of PPO, A2C,"
            " SAC and TD3 in stable_baselines3 are known; ModulePrior takes any network"
        )
    if checkpoint.observation_space.kind != "Box":
        raise ArtifactError(f"its observations are a {checkpoint.observation_space.kind} space, a Box is supported")
    actions = checkpoint.action_space
    if actions.kind not in ("Box", "Discrete") or (actions.kind == "Box" and len(actions.shape) != 1):
        raise ArtifactError(
            f"its actions are a {actions.kind} space {actions.shape or ''}, Discrete and Box of one dimension are"
            " supported"
        )
    if actions.start:
        raise ArtifactError(f"its discrete actions start at {actions.start}, 0 is supported")
    extractor = checkpoint.options.get("features_extractor_class")
    if extractor is not None and not re.search(
        r"stable_baselines3\.common\.torch_layers\.(FlattenExtractor|NatureCNN)'", str(extractor)
    ):
        raise ArtifactError(f"its features extractor is {extractor}, only FlattenExtractor and NatureCNN are known")


def _activation(checkpoint: Checkpoint, default: str, given: str | None) -> type[nn.Module]:
    """The activation that the file names, or the default, which is what Stable-Baselines3 makes of it too."""
    known = {f"<class 'torch.nn.modules.activation.{kind.__name__}'>": name for name, kind in ACTIVATIONS.items()}
    written = checkpoint.options.get("activation_fn")
    if written is not None and str(written) not in known:
        raise ArtifactError(f"its activation is {written}, known are {', '.join(sorted(ACTIVATIONS))}")
    if given is not None and given not in ACTIVATIONS:
        raise ValueError(f"Unknown activation {given!r}: choose one of {', '.join(sorted(ACTIVATIONS))}.")
    found = default if written is None else known[str(written)]
    if given is not None and given != found:
        raise ValueError(f"activation={given!r} contradicts the file, whose policy has {found!r}.")
    return ACTIVATIONS[found]


def _bounds(checkpoint: Checkpoint) -> tuple[Tensor, Tensor]:
    space = checkpoint.action_space
    low, high = (torch.as_tensor(bound).float() for bound in (space.low, space.high))
    if not (low.isfinite().all() and high.isfinite().all() and (low < high).all()):
        raise ArtifactError(f"its actions must have finite bounds, got {low.tolist()} and {high.tolist()}")
    return low, high


def _clip(checkpoint: Checkpoint) -> ClipToBox:
    """To the bounds of the actions, as far as they are finite."""
    space = checkpoint.action_space
    return ClipToBox(torch.as_tensor(space.low).float(), torch.as_tensor(space.high).float())


def _first_layers(
    parts: _Parts, checkpoint: Checkpoint, statistics: Statistics | None, prefix: str
) -> tuple[nn.Module, ...]:
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
    return (first, parts.nature_cnn(own, space.shape)) if cnn else (first,)


def _off_policy_layers(
    parts: _Parts, checkpoint: Checkpoint, kind: type[nn.Module], squashed: bool, *, deterministic: bool
) -> list[nn.Module]:
    """From features to a mean and a standard deviation before squashing, or to an action in the environment's unit."""
    if squashed:
        layers = parts.mlp("actor.latent_pi.", kind)
        mean, log_std = parts.linear("actor.mu."), parts.linear("actor.log_std.")
        if not deterministic:
            with torch.device("meta"):
                head = GaussianHead(mean.in_features, mean.out_features)
            head.mean, head.log_std = mean, log_std
            if mean.weight.shape != log_std.weight.shape:
                raise ArtifactError("its mean and its standard deviation are of different sizes")
            return [*layers, head]
        layers.append(mean)
    else:
        layers = parts.mlp("actor.mu.", kind)[:-1]
    low, high = _bounds(checkpoint)
    return [*layers, nn.Tanh(), ScaleToBox(low, high)]


def _check_sizes(layers: list[nn.Module], checkpoint: Checkpoint) -> None:
    """Runs the network once, so that layers that do not fit are found here."""
    actions = checkpoint.action_space
    size = actions.n if actions.kind == "Discrete" else actions.shape[0]
    try:
        with torch.no_grad():
            out = nn.Sequential(*layers)(torch.zeros(1, *checkpoint.observation_space.shape))
    except (RuntimeError, ValueError) as error:
        raise ArtifactError(f"its layers do not fit its observations and each other: {error}") from None
    for value in out if isinstance(out, tuple) else (out,):
        if value.shape != (1, size):
            raise ArtifactError(f"its policy is over {tuple(value.shape[1:])} actions, and its action space has {size}")


class _Parts:
    """The tensors of a policy, taken one layer after the other."""

    ignored = ("value_net.", "mlp_extractor.value_net.", "vf_features_extractor.", "critic.", "critic_target.")

    def __init__(self, weights: dict[str, Tensor]) -> None:
        self.left = dict(weights)
        for prefix in (*self.ignored, "actor_target."):
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
