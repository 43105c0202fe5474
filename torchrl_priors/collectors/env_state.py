"""The exact state of vectors of environments: MuJoCo's, and those that keep a log of their episode."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
import torch

if TYPE_CHECKING:
    import gymnasium
    import mujoco
    from gymnasium.vector import VectorEnv


def env_state_dict(env: VectorEnv) -> dict[str, Any]:
    """The state of each environment of a vector, exact to the bit.

    Of each environment:

    * the simulator's integration state, warm start included (``mjSTATE_INTEGRATION``), and the quantities that the last
      step derived from the state before it: some environments read these first in the next step (Ant, Humanoid);
    * the state of its random numbers;
    * the numbers and arrays among the attributes of the environment and its wrappers (elapsed steps, ...).

    Of environments that are none of MuJoCo's, and that :func:`make_vector_env` made, it is how their episode began and
    its actions, which are played again. So an episode is to depend on Gymnasium's random numbers (``np_random``) and
    the actions only.

    Args:
        env (VectorEnv): a :class:`gymnasium.vector.SyncVectorEnv`, between steps, with no episode that ended and was
            not reset.

    Returns:
        dict: ``"physics"``, a float64 tensor ``[num_envs, numbers]``, and ``"attributes"``, a list of JSON texts; or
        ``"episodes"``, a list of JSON texts.

    Raises:
        TypeError: an environment that is none of MuJoCo's, or a wrapper that keeps something else than numbers and
            arrays; named in the message.
    """
    envs = _sub_envs(env)
    if not is_mujoco(envs[0]):
        return {"episodes": [json.dumps({"identity": _identity(sub), **sub.episode()}) for sub in envs]}
    return {
        "physics": torch.from_numpy(np.stack([_physics(sub) for sub in envs])),
        "attributes": [json.dumps(_attributes(sub)) for sub in envs],
    }


def load_env_state_dict(env: VectorEnv, state_dict: Mapping[str, Any]) -> None:
    """Puts the environments of a vector into the states that :func:`env_state_dict` returned.

    Raises:
        TypeError: see :func:`env_state_dict`.
        ValueError: the state is that of another number or kind of environments; or the actions of an episode that is
            played again lead elsewhere.
    """
    envs = _sub_envs(env)
    attributes = [json.loads(text) for text in state_dict.get("attributes", state_dict.get("episodes"))]
    if len(attributes) != len(envs):
        raise ValueError(f"The state is that of {len(attributes)} environments, there are {len(envs)}.")
    for sub, saved in zip(envs, attributes, strict=True):
        for what, value in _identity(sub).items():
            if saved["identity"].get(what) != value:
                raise ValueError(
                    f"The state is that of another environment: {what} {saved['identity'].get(what)}, not {value}."
                )
    if not is_mujoco(envs[0]):
        env.reset()
        for sub, saved in zip(envs, attributes, strict=True):
            sub.play_again(saved)
        return
    physics = state_dict["physics"].cpu().numpy()
    for sub, numbers in zip(envs, physics, strict=True):
        if numbers.shape != _physics(sub).shape:
            raise ValueError("The state is that of another model, or of another version of MuJoCo.")
    env.reset()  # the vector's and the wrappers' own bookkeeping, as of environments within an episode
    for sub, saved, numbers in zip(envs, attributes, physics, strict=True):
        _set_attributes(sub, saved)
        _set_physics(sub, numbers)


def is_mujoco(env: gymnasium.Env) -> bool:
    """Whether the state of an environment is that of MuJoCo's simulator."""
    base = env.unwrapped
    kinds = (type(getattr(base, "model", None)).__name__, type(getattr(base, "data", None)).__name__)
    return kinds == ("MjModel", "MjData")


def _sub_envs(env: VectorEnv) -> list[gymnasium.Env]:
    """The environments of a vector, all of them MuJoCo's, or with a log of their episode."""
    from gymnasium.vector import SyncVectorEnv

    from torchrl_priors.collectors.episode_log import EpisodeLog

    if not isinstance(env, SyncVectorEnv):
        raise TypeError(
            f"Only the state of a SyncVectorEnv can be saved, not that of {type(env).__name__}: see make_vector_env."
        )
    for sub in env.envs:
        base = sub.unwrapped
        if not is_mujoco(sub) and not isinstance(sub, EpisodeLog):
            name = type(base).__name__ if base.spec is None else base.spec.id
            raise TypeError(
                f"{name} is not a MuJoCo environment: its state cannot be saved, but where make_vector_env made it."
            )
    return list(env.envs)


def wrappers(env: gymnasium.Env) -> Iterator[Any]:
    """The wrappers of an environment, from the outside."""
    while env is not env.unwrapped:
        yield env
        env = env.env


def _layers(env: gymnasium.Env) -> list[Any]:
    """The wrappers of an environment, and the environment itself."""
    return [*wrappers(env), env.unwrapped]


def _identity(env: gymnasium.Env) -> dict[str, Any]:
    spec = env.spec
    return {
        "id": None if spec is None else spec.id,
        "arguments": None if spec is None else repr(sorted(spec.kwargs.items())),
        "max_episode_steps": None if spec is None else spec.max_episode_steps,
        "layers": [type(layer).__name__ for layer in _layers(env)],
    }


def _attributes(env: gymnasium.Env) -> dict[str, Any]:
    """Identity, random numbers and numeric attributes."""
    return {
        "identity": _identity(env),
        "random": env.unwrapped.np_random.bit_generator.state,
        "layers": [_numbers(layer) for layer in _layers(env)],
    }


def _set_attributes(env: gymnasium.Env, saved: Mapping[str, Any]) -> None:
    env.unwrapped.np_random.bit_generator.state = saved["random"]
    for layer, values in zip(_layers(env), saved["layers"], strict=True):
        for name, value in values.items():
            setattr(layer, name, _decode(value))


def _numbers(layer: gymnasium.Env) -> dict[str, Any]:
    if type(layer).__name__ == "PassiveEnvChecker":  # remembers what it has checked, and changes nothing
        return {}
    return {name: _encode(value) for name, value in vars(layer).items() if _is_state(layer, name, value)}


def _is_state(layer: gymnasium.Env, name: str, value: Any) -> bool:
    """Whether an attribute is to be saved; raises if it may hold a state that cannot be."""
    if isinstance(value, (bool, int, float, np.generic, np.ndarray)):
        return True
    # descriptions, the inner environment, and what is saved on its own
    if isinstance(value, (str, tuple, dict, type(None), np.random.Generator)) or callable(value) or name == "env":
        return False
    # spaces, specifications and renderers; models and their data
    if type(value).__module__.startswith(("gymnasium.spaces.", "gymnasium.envs.", "mujoco.")):
        return False
    raise TypeError(f"{type(layer).__name__} keeps {name!r}, a {type(value).__name__}: its state cannot be saved.")


def _encode(value: Any) -> Any:
    if isinstance(value, (np.ndarray, np.generic)):
        return {"dtype": value.dtype.str, "array": isinstance(value, np.ndarray), "value": value.tolist()}
    return value


def _decode(value: Any) -> Any:
    if isinstance(value, dict):
        array = np.array(value["value"], dtype=value["dtype"])
        return array if value["array"] else array[()]
    return value


def _derived_fields(model: mujoco.MjModel) -> list[str]:
    """The arrays of MjData of real numbers whose size does not change: not those of contacts and constraints."""
    import mujoco

    pristine = mujoco.MjData(model)
    arrays = {name: getattr(pristine, name) for name in dir(pristine) if not name.startswith("_")}
    return [
        name
        for name, value in arrays.items()
        if isinstance(value, np.ndarray) and value.dtype == np.float64 and value.size
    ]


def _physics(env: gymnasium.Env) -> np.ndarray:
    import mujoco

    model, data = env.unwrapped.model, env.unwrapped.data
    signature = int(mujoco.mjtState.mjSTATE_INTEGRATION)
    state = np.empty(mujoco.mj_stateSize(model, signature))
    mujoco.mj_getState(model, data, state, signature)
    return np.concatenate([state, *(getattr(data, name).ravel() for name in _derived_fields(model))])


def _set_physics(env: gymnasium.Env, numbers: np.ndarray) -> None:
    import mujoco

    model, data = env.unwrapped.model, env.unwrapped.data
    signature = int(mujoco.mjtState.mjSTATE_INTEGRATION)
    size = mujoco.mj_stateSize(model, signature)
    mujoco.mj_resetData(model, data)
    mujoco.mj_setState(model, data, numbers[:size], signature)
    position = size
    for name in _derived_fields(model):
        array = getattr(data, name)
        array[...] = numbers[position : position + array.size].reshape(array.shape)
        position += array.size
