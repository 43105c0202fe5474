"""Teachers as files, without pickle: any prior whose parts are tensors."""

from torchrl_priors.artifacts.errors import ArtifactError
from torchrl_priors.artifacts.files import load_prior, read_manifest, save_prior
from torchrl_priors.artifacts.manifest import PriorManifest
from torchrl_priors.artifacts.sb3 import load_sb3_prior

__all__ = ["ArtifactError", "PriorManifest", "load_prior", "load_sb3_prior", "read_manifest", "save_prior"]
