"""Samples of a nuScenes-format root: tables and sensor files, without maps or ground truth."""

from pathlib import Path

from gsmap.datasets.annotations.record import MapSample
from mapdata.nuscenes.tables import LIDAR, NuScenesTables


def versions_in(root: Path) -> list[str]:
    """Return the version folders of a nuScenes-format root; none if it is no such root."""
    return sorted(path.parent.name for path in root.glob("*/scene.json"))


def read_nuscenes(root: Path, version: str | None = None) -> list[MapSample]:
    """Read all samples that have a LIDAR_TOP key frame, whose frame they are in.

    Args:
        root: Data root.
        version: Version folder, such as ``v1.0-mini``; the only one by default.

    Raises:
        ValueError: If there is no such version or several, or a table is damaged.
    """
    found = versions_in(root)
    if version is None and len(found) > 1:
        raise ValueError(f"{root} holds several versions, {found}: name one with --version.")
    if version is not None and version not in found:
        raise ValueError(f"{root} holds no version {version!r}, but {found}.")
    tables = NuScenesTables(version or found[0], root, max_sweeps=10)
    return [
        tables.read(record, scene)
        for scene in tables.scene
        for record in tables.samples_of(scene)
        if LIDAR in record["data"]
    ]
