"""What every test starts from: one thread and a fixed seed."""

from __future__ import annotations

from collections.abc import Iterator

import pytest
import torch
from hypothesis import settings

# pytest-xdist runs one process a core: more threads would only get in each other's way.
torch.set_num_threads(1)

# A property that fails must fail for everyone who runs the tests; times are never asserted.
settings.register_profile("deterministic", derandomize=True, deadline=None, max_examples=50, print_blob=True)
settings.load_profile("deterministic")


@pytest.fixture(autouse=True)
def _seeded() -> Iterator[None]:
    """Seed torch's global generator, and leave it as it was found."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        yield


@pytest.fixture
def generator() -> torch.Generator:
    return torch.Generator().manual_seed(0)
