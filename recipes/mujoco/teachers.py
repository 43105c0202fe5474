"""The teachers of a run: files of several kinds, or code of the user's; how each is read, and what identifies it."""

from __future__ import annotations

import os
from collections.abc import Callable
from importlib import import_module
from importlib.machinery import PathFinder
from operator import attrgetter
from pathlib import Path
from typing import Any

import torch
from torch import Tensor
from torchrl.data import Categorical, TensorSpec
from torchrl.modules import TanhNormal

from recipes.common.checks import at_home, require
from recipes.common.run_folder import sha256
from recipes.mujoco.config import MujocoConfig, Source, sources
from torchrl_priors import CallablePrior, ModulePrior, Prior, load_sb3_prior
from torchrl_priors.artifacts import ArtifactError, load_prior
from torchrl_priors.artifacts.spaces import check_spaces
from torchrl_priors.priors.prior import PriorWrapper

__all__ = ["ReversedPrior", "identify", "read_teacher"]

#: The keys of ``prior`` that say how a teacher of a kind is read.
_READ_BY = {
    "file": (),
    "sb3": ("vecnormalize", "std", "temperature"),
    "torchscript": ("outputs", "std", "epsilon"),
    "code": ("std", "epsilon"),
}
_OUTPUTS = {("loc", "scale"): "mean_std", ("logits",): "logits", ("action",): "action"}


def identify(cfg: MujocoConfig, prior: dict[str, Any]) -> dict[str, Any]:
    """The entry ``prior`` of a configuration with what the results depend on.

    Of teachers that is the content of their files, wherever these are, and of code that of the module's file, without
    what it imports.

    Raises:
        OSError: a file can't be read.
    """
    given = sources(cfg)
    used = {key for source in given for key in _READ_BY[source.kind]}
    idle = {"trust_code"} | {key for keys in _READ_BY.values() for key in keys if key not in used}
    prior = {key: value for key, value in prior.items() if key not in idle}
    if prior.get("vecnormalize") is not None:
        file = at_home("prior.vecnormalize", cfg.prior.vecnormalize or "")
        prior |= {"vecnormalize": file.name, "vecnormalize_sha256": sha256(file)}
    if not given:
        return prior
    names, digests = [source.file_name for source in given], [sha256(_content(source)) for source in given]
    one = isinstance(cfg.prior.path, str)
    return prior | {"path": names[0] if one else names, "sha256": digests[0] if one else digests}


def _content(source: Source) -> Path:
    """The file of a teacher, or of the module of its code, found without importing anything."""
    if source.kind != "code":
        return source.path
    spec, where = None, None
    for part in source.text.partition(":")[0].split("."):
        spec = PathFinder.find_spec(part, where)
        if spec is None:
            break
        where = spec.submodule_search_locations
    if spec is None or spec.origin is None:
        raise ValueError(
            f"prior.path={source}: there is no such module. Expected a file (.safetensors, .zip, .pt) or"
            " module:function, of a module in the working directory or on PYTHONPATH."
        )
    return Path(spec.origin)


def read_teacher(cfg: MujocoConfig, source: Source, env_id: str, obs_dim: int, actions: TensorSpec) -> Prior:
    """A teacher as its file has it, which advises on actions such as the student's.

    Raises:
        ValueError: names the key and the file, and what was expected.
        FileNotFoundError: there is no such file.
    """
    if source.kind in ("torchscript", "code") and not cfg.prior.trust_code:
        raise ValueError(
            f"prior.trust_code=False: expected true, as prior.path={source} is a program, which may do anything that"
            " you may do. Set it for code of your own, or of someone whom you trust."
        )
    if not os.path.isfile(_content(source)):  # Path.is_file raises for a name that is too long
        there = "a folder, expected a file" if os.path.isdir(source.path) else "no such file"
        raise FileNotFoundError(f"prior.path={source}: {there}.")
    readers: dict[str, Callable[[], Prior]] = {
        "file": lambda: load_prior(source.path, env_id=env_id),
        "sb3": lambda: _read_sb3(cfg, source, actions),
        "torchscript": lambda: _read_torchscript(cfg, source, actions),
        "code": lambda: CallablePrior(_function(source), **_spread(cfg, actions)),
    }
    try:
        prior = readers[source.kind]()
        check_spaces(prior, obs_dim, actions)
    except ArtifactError as error:
        raise ValueError(f"prior.path={source}: {error}") from None
    except (ValueError, OSError):
        raise
    except Exception as error:
        if source.kind == "code":
            raise ValueError(f"prior.path={source}: it fails ({type(error).__name__}: {error}).") from error
        raise
    return prior


def _spread(cfg: MujocoConfig, actions: TensorSpec) -> dict[str, Any]:
    """What a teacher that names one action leaves to the others."""
    if isinstance(actions, Categorical):
        return {"num_actions": actions.n, "epsilon": cfg.prior.epsilon}
    return {"std": _std(cfg, actions)}


def _std(cfg: MujocoConfig, actions: TensorSpec) -> Tensor:
    if cfg.prior.std is not None:
        return torch.full(actions.shape, cfg.prior.std)
    std = (actions.space.high - actions.space.low) / 10
    if not std.isfinite().all():
        raise ValueError(
            "prior.std=None: expected a number, as the teacher names one action and the actions have no bounds: the"
            " standard deviation around it, in its unit."
        )
    return std


def _read_sb3(cfg: MujocoConfig, source: Source, actions: TensorSpec) -> Prior:
    """A policy of Stable-Baselines3; with a spread around its action where no student could learn from it else."""
    vecnormalize = cfg.prior.vecnormalize
    if vecnormalize is not None:
        vecnormalize = str(at_home("prior.vecnormalize", vecnormalize))
        if not os.path.isfile(vecnormalize):
            raise FileNotFoundError(f"prior.vecnormalize={vecnormalize}: no such file.")
    options: dict[str, Any] = {"vecnormalize": vecnormalize, "temperature": cfg.prior.temperature}
    try:
        prior = load_sb3_prior(source.path, std=cfg.prior.std, **options)
        if prior.distribution_class is not TanhNormal:
            return prior
    except ValueError as error:
        if cfg.prior.std is not None or "pass std" not in str(error):
            raise ValueError(
                f"prior.path={source}: {error} (Keys: prior.vecnormalize, prior.std, prior.temperature.)"
            ) from None
    return load_sb3_prior(source.path, std=_std(cfg, actions), **options)


def _read_torchscript(cfg: MujocoConfig, source: Source, actions: TensorSpec) -> Prior:
    try:
        script = torch.jit.load(str(source.path), map_location="cpu").eval()
    except (RuntimeError, ValueError) as error:
        reason = (str(error).strip().splitlines() or [""])[0]
        raise ValueError(f"prior.path={source}: it can't be read as TorchScript ({reason}).") from None
    output = _OUTPUTS[tuple(cfg.prior.outputs or ())]
    if output != "action":
        return ModulePrior(script, output)  # type: ignore[arg-type]

    def act(observations: Any) -> Any:
        with torch.no_grad():
            return script(torch.from_numpy(observations)).numpy()

    return CallablePrior(act, batched=True, **_spread(cfg, actions))


def _function(source: Source) -> Callable[..., Any]:
    module, _, name = source.text.partition(":")
    try:
        function = attrgetter(name)(import_module(module))
    except Exception as error:  # whatever the module does
        raise ValueError(f"prior.path={source}: it can't be imported ({type(error).__name__}: {error}).") from error
    require(callable(function), "prior.path", source, "a function of an observation")
    return function


class ReversedPrior(PriorWrapper):
    """A bad teacher: means are mirrored at the middle of the actions, and the order of discrete actions is reversed.

    Args:
        prior (Prior): the good one.
        actions (TensorSpec): where its actions are. Where they have no bounds, their middle is 0.
    """

    def __init__(self, prior: Prior, actions: TensorSpec) -> None:
        super().__init__(prior)
        middle = None if isinstance(actions, Categorical) else (actions.space.low + actions.space.high) / 2
        self.register_buffer("middle", None if middle is None else middle.nan_to_num(0.0, 0.0, 0.0))

    def get_params(self, tensordict: Any) -> dict[str, Tensor]:
        """The other prior's parameters, reversed."""
        return {name: self._reverse(name, value) for name, value in self.module.get_params(tensordict).items()}

    def _reverse(self, name: str, value: Tensor) -> Tensor:
        if name == "loc":
            return 2 * self.middle - value
        return value.flip(-1) if name in ("logits", "probs") else value
