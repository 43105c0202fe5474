"""Models of Stable-Baselines3, saved once for each file of tests."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest


@pytest.fixture(scope="module")
def saved(tmp_path_factory: pytest.TempPathFactory) -> Callable[[str], Any]:
    from sb3_cases import save_model

    folder = tmp_path_factory.mktemp("sb3")
    models: dict[str, Any] = {}

    def get(name: str) -> Any:
        if name not in models:
            models[name] = save_model(name, folder)
        return models[name]

    return get
