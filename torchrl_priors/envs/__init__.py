"""Environments of the paper's tabular study."""

from torchrl_priors.envs.gridworld import GridMaps, GridWorldEnv, transition
from torchrl_priors.envs.worlds import GridWorlds, sample_worlds

__all__ = ["GridMaps", "GridWorldEnv", "GridWorlds", "sample_worlds", "transition"]
