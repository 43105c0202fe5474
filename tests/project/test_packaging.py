"""The core stands without the extras."""

from __future__ import annotations

import subprocess
import sys

EXTRAS = ("gymnasium", "hydra", "matplotlib", "mujoco", "omegaconf", "pandas", "rliable", "safetensors", "tqdm")

IMPORT_WITHOUT = """
import sys
for name in {extras}:
    sys.modules[name] = None  # makes the import of it fail
import torchrl_priors
for name in torchrl_priors.__all__:
    getattr(torchrl_priors, name)
"""


def test_every_public_name_imports_without_the_extras() -> None:
    code = IMPORT_WITHOUT.format(extras=EXTRAS)
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert result.returncode == 0, result.stderr
