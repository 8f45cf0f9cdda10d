"""What every room's tests share: one seeded generator a test, and the recordings that may lie beside the project."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import Phase, settings

# The same examples in every run, however slow the machine; one that fails is told as it is, not shrunk for minutes.
settings.register_profile("sonofix", deadline=None, derandomize=True, phases=(Phase.explicit, Phase.generate))
settings.load_profile("sonofix")

SHARED = Path(__file__).parents[1].parent / "shared"


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(20240229)


def _present(folder: Path) -> Path:
    if not folder.is_dir():
        pytest.skip(f"no recordings at {folder}")
    return folder


@pytest.fixture(scope="session")
def captures() -> Path:
    """Folder of made-up recordings with exact truth; the test is skipped where it is absent."""
    return _present(SHARED / "captures")


@pytest.fixture(scope="session")
def data() -> Path:
    """Folder of real recordings; the test is skipped where it is absent."""
    return _present(SHARED / "data")
