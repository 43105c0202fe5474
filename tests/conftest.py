"""What every test starts from: one thread and a fixed seed."""

from __future__ import annotations

import contextlib
import gc
import sys
from collections.abc import Callable, Iterator
from typing import Any

import pytest
import torch
from hypothesis import settings

with contextlib.suppress(ImportError):
    # absl (TensorBoard's) remembers the sys.stderr of its import, which here is pytest's, and closes it
    # when Hydra sets up logging while a test captures: give it one that nobody closes.
    from absl.logging import get_absl_handler

    get_absl_handler().python_handler.stream = sys.__stderr__

# pytest-xdist runs one process a core: more threads would only get in each other's way.
torch.set_num_threads(1)

# A property that fails must fail for everyone who runs the tests; times are never asserted.
settings.register_profile("deterministic", derandomize=True, deadline=None, max_examples=50, print_blob=True)
settings.load_profile("deterministic")


def pytest_collection_finish() -> None:
    """What was imported stays: Python's collector of garbage looks rarely, and not at that million objects."""
    gc.collect()
    gc.freeze()
    gc.set_threshold(100_000, 10, 100)


@pytest.fixture(autouse=True)
def _seeded() -> Iterator[None]:
    """Seed torch's global generator, and leave it as it was found."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        yield


@pytest.fixture(autouse=True)
def _without_hydras_memory() -> Iterator[None]:
    """Forget the command line that a test ran in this process: the next one is in no sweep."""
    yield
    if "hydra.core.hydra_config" in sys.modules:
        sys.modules["hydra.core.hydra_config"].HydraConfig.instance().cfg = None


@pytest.fixture
def generator() -> torch.Generator:
    return torch.Generator().manual_seed(0)


@pytest.fixture
def without_pictures(monkeypatch: pytest.MonkeyPatch) -> None:
    """Figures are made but not drawn, which takes a second each: there is nothing to see in their files.

    For what else a recipe does. That its figures can be drawn is seen where a study or a report is looked at whole.
    """
    style = pytest.importorskip("recipes.plots.style")
    monkeypatch.setattr(style, "_pictures", lambda figure, formats, dpi: [b"not drawn"] * len(formats))


@pytest.fixture
def without_torchrls_groups(monkeypatch: pytest.MonkeyPatch) -> None:
    """Once ``register_configs`` has run in a process, Hydra knows TorchRL's hundreds of configs beside the recipes'.

    What recipes call model= and logger= would be groups, and ``--help`` would take half a minute to list them all.
    """
    store = pytest.importorskip("hydra.core.config_store").ConfigStore.instance()
    repo = {name: node for name, node in store.repo.items() if name in ("hydra", "schema") or name.endswith(".yaml")}
    monkeypatch.setattr(store, "repo", repo)


@pytest.fixture(scope="module")
def saved(tmp_path_factory: pytest.TempPathFactory) -> Callable[[str], Any]:
    """Models of Stable-Baselines3, saved once for each file of tests."""
    from sb3_cases import save_model

    folder = tmp_path_factory.mktemp("sb3")
    models: dict[str, Any] = {}

    def get(name: str) -> Any:
        if name not in models:
            models[name] = save_model(name, folder)
        return models[name]

    return get
