"""Teachers as files: a policy with the frozen statistics of its observations, without pickle."""

from torchrl_priors.artifacts.format import ArtifactError, PolicyManifest, read_manifest
from torchrl_priors.artifacts.policy import load_policy, load_prior, save_policy

__all__ = ["ArtifactError", "PolicyManifest", "load_policy", "load_prior", "read_manifest", "save_policy"]
