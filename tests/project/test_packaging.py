"""The core stands without the extras, and the wheel holds the library only."""

from __future__ import annotations

import re
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
EXTRAS = ("gymnasium", "hydra", "matplotlib", "mujoco", "omegaconf", "pandas", "safetensors", "tqdm")

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


def test_the_wheel_holds_the_library_and_nothing_else(tmp_path: Path) -> None:
    wheel = pytest.importorskip("hatchling.builders.wheel")
    (path,) = wheel.WheelBuilder(str(ROOT)).build(directory=str(tmp_path), versions=["standard"])
    with zipfile.ZipFile(path) as archive:
        names = archive.namelist()
    packages = {name.split("/")[0] for name in names if ".dist-info/" not in name}
    assert packages == {"torchrl_priors"}
    assert "torchrl_priors/py.typed" in names


@pytest.mark.parametrize("address", ["https://forge.example/us/priors", None])
def test_a_package_index_shows_a_readme_whose_links_lead_somewhere(
    address: str | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    core, manager = pytest.importorskip("hatchling.metadata.core"), pytest.importorskip("hatchling.plugin.manager")
    monkeypatch.delenv("REPOSITORY_URL", raising=False)
    if address is not None:
        monkeypatch.setenv("REPOSITORY_URL", address)
    metadata = core.ProjectMetadata(str(ROOT), manager.PluginManager()).core
    links = re.findall(r"\]\(([^)#]+)\)", metadata.readme)
    relative = [link for link in links if "://" not in link]
    assert links
    assert (not relative) == (address is not None)
    assert {"Paper"} | ({"Repository", "Documentation", "Changelog", "Issues"} if address else set()) == set(
        metadata.urls
    )
    if address is not None:
        files = [link.split(f"/v{metadata.version}/")[1] for link in links if link.startswith(address)]
        assert files
        assert [file for file in files if not (ROOT / file).exists()] == []
        assert f"![Learning curves]({address}/raw/v{metadata.version}/results/" in metadata.readme
