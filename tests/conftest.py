"""Fixtures shared by all tests."""

import os
from pathlib import Path

import pytest

REPO = Path(__file__).resolve().parents[1]


@pytest.fixture(scope="session")
def shared_dir() -> Path:
    """Folder with reference data outside the project (``GSMAP_SHARED``); skips without it."""
    path = Path(os.environ.get("GSMAP_SHARED", REPO.parent / "shared"))
    if not path.is_dir():
        pytest.skip(f"no reference data at {path}: set GSMAP_SHARED")
    return path


@pytest.fixture(scope="session")
def golden_dir(shared_dir: Path) -> Path:
    """Reference inputs and outputs of earlier systems."""
    return shared_dir / "golden"
