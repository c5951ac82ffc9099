"""Fixtures of the converters' tests."""

from pathlib import Path

import pytest

from gsmap.converters.nuscenes.convert import NuScenesOptions


@pytest.fixture
def options(minicity_root: Path, tmp_path: Path) -> NuScenesOptions:
    return NuScenesOptions(minicity_root, "v1.0-trainval", out_dir=tmp_path / "out")
