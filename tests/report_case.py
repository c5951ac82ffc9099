"""A small annotation file with images and two result files, for the tests of the report page."""

import json
from pathlib import Path

import cv2
import numpy as np

from gsmap.datasets.annotations.file import write_annotations
from gsmap.datasets.annotations.record import AnnotationMeta, CameraRecord, MapInstance, MapSample

STRANGE = "</script><img src=x onerror=alert(1)>${data}"
CLASSES = ("divider", "ped_crossing", "boundary")
RING = [[-4.0, 8], [4, 8], [4, 12], [-4, 12], [-4, 8]]
FRAMES = 6


def cameras(folder: Path) -> list[CameraRecord]:
    """A camera that looks ahead and one that looks back, 1.5 m above the ground at z = -1.84."""
    (folder / "images").mkdir(parents=True, exist_ok=True)
    intrinsics = np.array([[80.0, 0, 80], [0, 80, 45], [0, 0, 1]])
    records = []
    for name, ahead in (("CAM_BACK", -1.0), ("CAM_FRONT", 1.0)):
        cv2.imwrite(str(folder / f"images/{name}.jpg"), np.full((90, 160, 3), 90, np.uint8))
        cam_from_frame = np.eye(4)
        cam_from_frame[:3, :3] = [[ahead, 0, 0], [0, 0, -1], [0, ahead, 0]]
        cam_from_frame[1, 3] = -0.34
        record = CameraRecord(name, f"images/{name}.jpg", 160, 90, intrinsics, cam_from_frame)
        records.append(record)
    return records


def write_case(folder: Path, frame: str = "lidar") -> tuple[Path, dict[str, Path]]:
    """Write the files: each sample has a divider, a crossing and a boundary.

    ``good`` finds the divider (0.9), shifted by 0.1 m a sample, and the boundary (0.5), and has one
    false divider (0.3); it has Gaussians. ``poor`` finds the boundary alone, and has none.
    """
    truth = [
        MapInstance(0, np.array([[0.0, -20], [0, 20]])),
        MapInstance(1, np.array(RING)),
        MapInstance(2, np.array([[5.0, -20], [5, 20]])),
    ]
    records, mounting = cameras(folder), np.eye(4)
    mounting[2, 3] = 1.84
    samples = [
        MapSample(
            f"t{i}",
            STRANGE,
            "town",
            10**9 * i,
            records,
            np.eye(4),
            instances=truth,
            ego_from_frame=mounting,
        )
        for i in range(FRAMES)
    ]
    path = folder / "case.arrow"
    meta = AnnotationMeta("case", frame, "val", CLASSES, (-15.0, 15.0), (-30.0, 30.0))
    write_annotations(path, meta, samples)
    good, poor = [], []
    for i in range(FRAMES):
        found = [
            vector("divider", 0.9, [[0.4 * i, y] for y in range(-20, 21, 4)]),
            vector("boundary", 0.5, [[5.1, -20], [5.1, 20]]),
            vector("divider", 0.3, [[-9, -20], [-9, 20]]),
        ]
        good.append({"sample_token": f"t{i}", "vectors": found})
        plain = {k: v for k, v in found[1].items() if not k.startswith("gaussian")}
        poor.append({"sample_token": f"t{i}", "vectors": [plain]})
    results = {"good": folder / "good.json", STRANGE: folder / "poor.json"}
    for file, content in zip(results.values(), (good, poor), strict=True):
        file.write_text(json.dumps({"results": content}))
    return path, results


def vector(class_name: str, score: float, points: list[list[float]]) -> dict:
    return {
        "pts": points,
        "cls_name": class_name,
        "confidence_level": score,
        "gaussian_scales": [[2.0, 0.5]] * len(points),
        "gaussian_rotations": [np.pi / 2] * len(points),
    }


def write_changes_case(path: Path) -> Path:
    """Changes near the vehicle at the origin, and one of another map."""
    rows: list[tuple[str, str, list, dict]] = [
        ("divider", "moved", [[1.0, -50], [1, 50]], {"moved_m": 1.02, "moved_std_m": 0.05}),
        ("ped_crossing", "removed", RING, {"passes_not_seen": 2, "passes_in_view": 3}),
        ("boundary", "added", [[400.0, 0], [410, 0]], {"confidence": 0.2}),
        (STRANGE, "added", [[0.0, 0], [9, 0]], {"map": "village"}),
    ]
    features = []
    for name, kind, points, more in rows:
        geometry = {"type": "LineString", "coordinates": points}
        properties = {"class": name, "change": kind, "map": "town", **more}
        features.append({"type": "Feature", "geometry": geometry, "properties": properties})
    path.write_text(json.dumps({"type": "FeatureCollection", "crs": None, "features": features}))
    return path
