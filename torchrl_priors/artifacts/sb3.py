"""Teachers that Stable-Baselines3 trained."""

from __future__ import annotations

import os
import re
import warnings
from pathlib import Path
from typing import Any, Literal, TypeAlias

import torch
from tensordict import NestedKey
from torch import Tensor, nn
from torchrl.data import Bounded, TensorSpec
from torchrl.modules import OneHotCategorical, TanhNormal

from torchrl_priors.artifacts.errors import ArtifactError, refusing, short
from torchrl_priors.artifacts.sb3_files import Checkpoint, Statistics, read_checkpoint, read_vecnormalize
from torchrl_priors.artifacts.sb3_network import Family, action_bounds, build_layers, find_family
from torchrl_priors.artifacts.spaces import check_bounds, check_spaces
from torchrl_priors.networks import ACTIVATIONS
from torchrl_priors.priors import BoltzmannPrior, ModulePrior

_PURPOSE = "a Stable-Baselines3 policy"
_Output: TypeAlias = Literal["logits", "mean", "mean_std"]
_POLICIES = re.compile(
    r"stable_baselines3\.(common|ppo|a2c|sac|td3|dqn)\.policies|sb3_contrib\.(tqc|trpo|qrdqn)\.policies"
)
_EXTRACTORS = re.compile(r"stable_baselines3\.common\.torch_layers\.(FlattenExtractor|NatureCNN)'")
_ACTIVATIONS = {f"<class 'torch.nn.modules.activation.{kind.__name__}'>": name for name, kind in ACTIVATIONS.items()}


def load_sb3_prior(
    path: str | os.PathLike[str],
    *,
    vecnormalize: str | os.PathLike[str] | None = None,
    std: float | Tensor | None = None,
    temperature: float | None = None,
    clip_mean: bool = True,
    activation: str | None = None,
    one_hot: bool = False,
    action_spec: TensorSpec | None = None,
    in_key: NestedKey = "observation",
    namespace: NestedKey = "prior",
    device: torch.device | str | None = None,
) -> ModulePrior | BoltzmannPrior:
    r"""A policy of Stable-Baselines3 as a teacher, from the file that ``model.save`` wrote.

    It reads PPO, A2C, SAC, TD3, DDPG and DQN of ``stable_baselines3``, and TQC, TRPO and QR-DQN of ``sb3_contrib``.
    Neither need be installed, and no code of the files runs: of what is pickled only tensors, numbers, arrays and names
    are read.

    What the teacher's distribution is, in the unit of the environment's actions:

    * PPO, A2C, TRPO, discrete actions: a :class:`~torch.distributions.Categorical` over indices, or, with ``one_hot``,
      a :class:`~torchrl.modules.OneHotCategorical`, as the students of a :func:`~torchrl.envs.GymEnv` are by default;
    * PPO, A2C, TRPO, continuous: a Gaussian whose mean is clipped to the bounds of the actions, as Stable-Baselines3
      clips what it sends. With ``clip_mean=False`` it is the policy's own, and so are its log-probabilities;
    * SAC, TQC: a :class:`~torchrl.modules.TanhNormal` within the bounds. Stable-Baselines3's own ``log_prob`` is that
      of actions scaled to [-1, 1], and adds 1e-6 to :math:`1-\tanh^2`; this one is exact;
    * TD3, DDPG, and any other continuous one with ``std``: a Gaussian around the deterministic action. A Gaussian
      student of a SAC teacher needs it: its actions can leave the bounds, where a squashed teacher has no finite
      opinion. So does a policy with state-dependent noise (``use_sde=True``);
    * DQN, QR-DQN: a :class:`~torchrl_priors.BoltzmannPrior` of the action values, which are the means of the quantiles.

    It can be written to a file of this library by :func:`save_prior`. ``python -m recipes.export_sb3`` does both.

    Args:
        path (str or path): the ``.zip``.

    Keyword Args:
        vecnormalize (str or path, optional): the file of ``VecNormalize.save``, whose statistics the policy was trained
            with. Defaults to ``None``: it reads raw observations. Files of PPO, A2C and TRPO show whether there were
            any: if so, a warning says that they are missing.
        std (float or Tensor, optional): standard deviation of a Gaussian around the deterministic action, in the unit
            of the action, a number or one per dimension; required for TD3, DDPG and ``use_sde=True``. Defaults to
            ``None``: the policy's own distribution.
        temperature (float, optional): of the softmax over action values, in the unit of the returns; required for DQN
            and QR-DQN, of no use for others.
        clip_mean (bool): whether the mean of PPO, A2C or TRPO is clipped to the bounds of the actions, where they are
            finite. Defaults to ``True``: a mean far beyond would draw a student there, where nothing changes.
        activation (str, optional): what the policy must have, one of :data:`~torchrl_priors.networks.ACTIVATIONS`: only
            a check, for what the file says counts, and if it says nothing Stable-Baselines3's default (tanh for PPO,
            A2C and TRPO, ReLU for the others). Defaults to ``None``: not checked.
        one_hot (bool): whether discrete actions are one-hot ``[*B, A]``, not indices ``[*B]``. Defaults to ``False``.
        action_spec (TensorSpec, optional): the student's actions, which must be of the same kind, size and bounds.
            :class:`~torchrl_priors.priors.RescaledPrior` takes a teacher to other bounds, such as those behind
            :class:`~torchrl.envs.ActionScaling`. Defaults to ``None``: not checked.
        in_key (NestedKey): raw observations ``[*B, *obs]``, images with channels first. Defaults to ``"observation"``.
        namespace (NestedKey): as in :class:`~torchrl_priors.ActionPrior`.
        device (torch.device, optional): defaults to the CPU.

    Raises:
        FileNotFoundError: there is no such file.
        ArtifactError: a file is damaged or none of Stable-Baselines3; or the policy is of a kind that can't be read:
            observations of several entries or discrete ones, actions that are neither ``Discrete`` nor a ``Box`` of one
            dimension, recurrent or custom networks, statistics of single frames; or it is none for ``action_spec``. The
            message says how
            :class:`~torchrl_priors.CallablePrior` takes it.
        ValueError: TD3 without ``std``, DQN without ``temperature``; ``std`` with discrete actions or of another size
            than the actions, ``one_hot`` with continuous ones, ``temperature`` without action values, or an activation
            that the policy does not have.
    """
    with refusing(path, _PURPOSE):
        checkpoint = read_checkpoint(Path(path))
        _check(checkpoint)
        if checkpoint.use_sde and std is None:
            raise ArtifactError(
                "it explores by state-dependent noise (use_sde=True): pass std, the spread around its deterministic"
                " action in the unit of the action"
            )
    family = find_family(checkpoint)
    discrete = checkpoint.action_space.kind == "Discrete"
    _check_arguments(path, checkpoint, family, std=std, temperature=temperature, one_hot=one_hot)
    if vecnormalize is None and family == "on_policy" and checkpoint.original_obs:
        warnings.warn(
            f"{path} was trained with VecNormalize, and vecnormalize is missing: its advice on raw observations is"
            " wrong. Pass the file of VecNormalize.save, also if it only normalised rewards.",
            stacklevel=2,
        )
    statistics = None if vecnormalize is None else read_vecnormalize(Path(vecnormalize))
    if statistics is not None and tuple(statistics.mean.shape) != checkpoint.observation_space.shape:
        raise ArtifactError(
            f"{vecnormalize} has statistics of observations {tuple(statistics.mean.shape)}, and the policy of {path}"
            f" reads {checkpoint.observation_space.shape}.{_frames(statistics, checkpoint)}"
        )
    kwargs: dict[str, Any] = {"in_keys": [in_key], "namespace": namespace}
    if one_hot:
        kwargs["distribution_class"] = OneHotCategorical
    with refusing(path, _PURPOSE):
        kind = _activation(checkpoint, "tanh" if family == "on_policy" else "relu", activation)
        network = build_layers(checkpoint, statistics, kind, deterministic=std is not None, clip_mean=clip_mean)
        if family == "squashed" and std is None:
            low, high = action_bounds(checkpoint)
            kwargs |= {"distribution_class": TanhNormal, "distribution_kwargs": {"low": low, "high": high}}
        prior: ModulePrior | BoltzmannPrior
        if temperature is not None:
            prior = BoltzmannPrior(network, temperature, **kwargs)
        else:
            output: _Output = "logits" if discrete else "mean_std" if std is None else "mean"
            prior = ModulePrior(network, output, std=std, **kwargs)
        if action_spec is not None:
            check_spaces(prior, checkpoint.observation_space.shape, action_spec)
            if isinstance(action_spec, Bounded):  # its layers have no bounds with clip_mean=False
                space = checkpoint.action_space
                check_bounds((torch.as_tensor(space.low), torch.as_tensor(space.high)), action_spec)
    return prior.to(device)


def _check(checkpoint: Checkpoint) -> None:
    """Refuses what can't be converted, and says what can be done."""
    unsupported = _unsupported(checkpoint)
    if unsupported is not None:
        raise ArtifactError(f"{unsupported}. Stable-Baselines3 can play it: {_instead(checkpoint)}")
    discrete, family = checkpoint.action_space.kind == "Discrete", find_family(checkpoint)
    if checkpoint.use_sde and discrete:
        raise ArtifactError("it is damaged: it has discrete actions and state-dependent noise (use_sde=True)")
    if family != "on_policy" and discrete != (family == "values"):
        raise ArtifactError(f"it is damaged: its weights are not of actions of a {checkpoint.action_space.kind} space")


def _unsupported(checkpoint: Checkpoint) -> str | None:
    observations, actions = checkpoint.observation_space, checkpoint.action_space
    if not _POLICIES.fullmatch(checkpoint.policy_module):
        return (
            f"its policy class is one of {checkpoint.policy_module or 'an unknown module'}, and only those of PPO, A2C,"
            " SAC, TD3, DDPG and DQN in stable_baselines3 and of TQC, TRPO and QR-DQN in sb3_contrib are known"
        )
    if observations.kind != "Box":
        return f"its observations are a {observations.kind} space, a Box is supported"
    if actions.kind not in ("Box", "Discrete") or (actions.kind == "Box" and len(actions.shape) != 1):
        shape = f" {actions.shape}" if actions.shape else ""
        return f"its actions are a {actions.kind} space{shape}, Discrete and Box of one dimension are supported"
    if actions.start:
        return f"its discrete actions start at {actions.start}, 0 is supported"
    extractor = checkpoint.options.get("features_extractor_class")
    if extractor is not None and not _EXTRACTORS.search(str(extractor)):
        return f"its features extractor is {short(extractor)}, only FlattenExtractor and NatureCNN are known"
    activation = checkpoint.options.get("activation_fn")
    if activation is not None and str(activation) not in _ACTIVATIONS:
        return f"its activation is {short(activation)}, known are {', '.join(sorted(ACTIVATIONS))}"
    return None


def _instead(checkpoint: Checkpoint) -> str:
    """How a prior of another kind has the policy."""
    spread = "num_actions=..." if checkpoint.action_space.kind == "Discrete" else "std=..."
    if checkpoint.observation_space.kind == "Dict":
        call = 'lambda a, b: model.predict({"a": a, "b": b}, deterministic=True)[0]'
        return f'CallablePrior({call}, in_keys=["a", "b"], {spread})'
    return f"CallablePrior(lambda o: model.predict(o, deterministic=True)[0], {spread})"


def _check_arguments(
    path: str | os.PathLike[str],
    checkpoint: Checkpoint,
    family: Family,
    *,
    std: float | Tensor | None,
    temperature: float | None,
    one_hot: bool,
) -> None:
    """Refuses what is missing or of no use for this policy."""
    discrete = checkpoint.action_space.kind == "Discrete"
    if family == "deterministic" and std is None:
        raise ValueError(f"{path} is a deterministic policy (TD3): pass std, its spread in the unit of the action.")
    if family == "values" and temperature is None:
        raise ValueError(f"{path} has action values (DQN): pass temperature, of their softmax, in their unit.")
    if family != "values" and temperature is not None:
        raise ValueError(f"{path} is a policy without action values: temperature={temperature} is of no use.")
    if discrete and std is not None:
        raise ValueError(f"{path} is a policy over discrete actions: std={std} is of no use.")
    if one_hot and not discrete:
        raise ValueError(f"{path} is a policy over continuous actions: one_hot=True is of no use.")
    if std is not None and torch.as_tensor(std).shape not in ((), checkpoint.action_space.shape):
        raise ValueError(
            f"std must be a number or have one for each of {checkpoint.action_space.shape[0]} dimensions of the actions"
            f" of {path}, got shape {tuple(torch.as_tensor(std).shape)}."
        )


def _frames(statistics: Statistics, checkpoint: Checkpoint) -> str:
    """What to do where observations are several of the frames that were normalised."""
    one, stacked = tuple(statistics.mean.shape), checkpoint.observation_space.shape
    if len(one) != len(stacked):
        return ""
    factors = [whole / size for size, whole in zip(one, stacked, strict=True) if size != whole]
    if len(factors) != 1 or not factors[0].is_integer():
        return ""
    return (
        " It looks like VecFrameStack over VecNormalize, which is not supported: the frames before the first are zeros"
        " after normalisation. Normalise frames and stack them in the environment, and pass no vecnormalize; or use"
        f" {_instead(checkpoint)} there."
    )


def _activation(checkpoint: Checkpoint, default: str, given: str | None) -> type[nn.Module]:
    """The activation that the file names, or the default, which is what Stable-Baselines3 makes of it too."""
    if given is not None and given not in ACTIVATIONS:
        raise ValueError(f"Unknown activation {given!r}: choose one of {', '.join(sorted(ACTIVATIONS))}.")
    written = checkpoint.options.get("activation_fn")
    found = default if written is None else _ACTIVATIONS[str(written)]
    if given is not None and given != found:
        raise ValueError(f"activation={given!r} contradicts the file, whose policy has {found!r}.")
    return ACTIVATIONS[found]
