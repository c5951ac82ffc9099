"""Fixtures of the converters' tests."""

import shutil
from pathlib import Path

import pytest

from mapdata.nuscenes.convert import NuScenesOptions


@pytest.fixture
def options(minicity_root: Path, tmp_path: Path) -> NuScenesOptions:
    return NuScenesOptions(minicity_root, "v1.0-trainval", out_dir=tmp_path / "out")


@pytest.fixture
def damaged_root(options: NuScenesOptions, tmp_path: Path) -> Path:
    """A copy of the data set without images and sweeps, for a test to damage."""
    root = tmp_path / "root"
    for folder in ("maps", "v1.0-trainval", "can_bus"):
        shutil.copytree(options.root / folder, root / folder)
    return root
