"""Teachers as files: a policy with the frozen statistics of its observations, without pickle."""

from torchrl_priors.artifacts.errors import ArtifactError
from torchrl_priors.artifacts.format import read_manifest
from torchrl_priors.artifacts.manifest import PolicyManifest, PriorManifest
from torchrl_priors.artifacts.policy import load_policy, load_prior, save_policy
from torchrl_priors.artifacts.prior import save_prior
from torchrl_priors.artifacts.sb3 import load_sb3_prior

__all__ = [
    "ArtifactError",
    "PolicyManifest",
    "PriorManifest",
    "load_policy",
    "load_prior",
    "load_sb3_prior",
    "read_manifest",
    "save_policy",
    "save_prior",
]
