"""One small MiniCity data set for all tests of this folder."""

from pathlib import Path

import pytest
from nuscenes.nuscenes import NuScenes

from minicity.generate import generate

SIZE = (320, 180)


@pytest.fixture(scope="session")
def small_root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("minicity") / "root"
    assert generate(
        root, scenes=3, seed=28, image_size=SIZE, samples_per_scene=2, workers=0, progress=False
    )
    return root


@pytest.fixture(scope="session")
def nusc(small_root: Path) -> NuScenes:
    return NuScenes("v1.0-trainval", str(small_root), verbose=False)
