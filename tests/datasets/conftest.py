"""Building a data set, and a data set to damage."""

import shutil
from pathlib import Path

import pytest


@pytest.fixture(scope="module")
def build():
    from mmdet3d.registry import DATASETS
    from mmengine.registry import init_default_scope

    import gsmap.registered  # noqa: F401

    init_default_scope("mmdet3d")
    return lambda **config: DATASETS.build({"type": "VectorizedMapDataset", **config})


@pytest.fixture
def copied_root(minicity_root: Path, minicity_annotations: dict[str, Path], tmp_path: Path) -> Path:
    """A copy whose files a test may damage."""
    root = tmp_path / "root"
    shutil.copytree(minicity_root / "samples", root / "samples")
    for path in minicity_annotations.values():
        shutil.copy(path, root)
    return root
